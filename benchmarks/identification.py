"""Identification on the logs of an SO-101, and its speed beside MuJoCo's own tools.

    python -m benchmarks.identification LOGS [folds] [one] [halves] [wall] [sysid] [rollout]

LOGS is a folder of SAGE motions (github.com/isaac-sim2real/sage, output/real/so101/custom). Without names
everything is run. `make bench` runs the last two, on real logs where it is given some, else on those of an
emulated arm. Times are processor seconds of the whole process, so they hardly depend on other load; but for those of
`wall`, which wants two idle cores.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import mujoco.rollout
import numpy as np

from benchmarks import logs as sources
from rejoint.arms import Arm, load_arm
from rejoint.logs.exclusions import find_exclusions, table_height
from rejoint.logs.runlog import RunLog
from rejoint.twin.fit import SCALES, Fit, Problem, fit
from rejoint.twin.fromlogs import FITTED, identify_logs
from rejoint.twin.holdout import HoldOut
from rejoint.twin.holdout import folds as fold_numbers
from rejoint.twin.judge import NO_TWIN, TIMESTEP, Candidate, Errors, judge
from rejoint.twin.model import friction_solref, twin_spec
from rejoint.twin.motionfit import LogSettings, fit_motions, independent
from rejoint.twin.parameters import Layout, TwinParameters, pack, unpack, vector_names
from rejoint.twin.replay import Replay
from rejoint.twin.segments import free_windows, thin
from rejoint.twin.structure import LIMITS, rough_fit, simplest
from rejoint.twin.uncertainty import uncertainty
from rejoint.twin.unknown import unknown_prior

FOLDS = 4
HALVINGS = 4
GIVEN = LogSettings(threads=1, stictions=(1.25,))
"""For `halves`: how much joints stick is given"""


def mm_deg(errors: Errors) -> str:
    parts = [errors.free, errors.contact, errors.all]
    return " | ".join("   -      -" if p is None else f"{1e3 * p.tcp:5.2f} {np.degrees(p.joint):6.3f}" for p in parts)


HEADER = f"{'':28} free mm    deg | contact    deg | all mm    deg"


def folds(arm: Arm, logs: Sequence[RunLog]) -> None:
    """Every motion is held out once."""
    whole, per_motion, number = [], {"free": [], "contact": [], "all": []}, fold_numbers(arm, logs, FOLDS)
    for k in range(FOLDS):
        start, stages = time.process_time(), []

        def note(_share: float, stage: str, start: float = start, stages: list = stages) -> None:
            stages.append((stage, time.process_time() - start))

        names = tuple(log.label for log, own in zip(logs, number, strict=True) if own == k)
        settings = LogSettings(threads=1, hold_out=HoldOut(names=names))
        found = identify_logs(arm, logs, settings, note)
        mean = found.judgement.mean
        at = dict(stages)
        judged = at["done"] - at["held-out motions"]
        print(f"\nfold {k}: {len(found.fitted)} motions fitted in {at['done'] - judged:.1f} s of one core, "
              f"stiction {found.twin.stiction:g}, {found.twin.table}")  # fmt: skip
        for name in ("stiffness", "damping", "coulomb", "armature", "offset", "delay"):
            print(f"  {name:10} {np.array2string(np.atleast_1d(getattr(found.twin.parameters, name)), precision=4)}")
        print(HEADER)
        for motion in found.judgement.motions:
            print(f"{motion.motion:28} {mm_deg(motion.errors[FITTED])}")
        for name, errors in mean.items():
            print(f"{'mean, ' + name:28} {mm_deg(errors)}", flush=True)
        whole.append(mean[FITTED])
        for part, errors in per_motion.items():
            errors += [getattr(m.errors[FITTED], part) for m in found.judgement.motions]
    for part, errors in per_motion.items():
        tcp = 1e3 * np.array([e.tcp for e in errors if e is not None])
        deg = np.degrees([e.joint for e in errors if e is not None])
        print(f"\n{part}, {len(tcp)} motions, each held out once: TCP {tcp.mean():.2f} mm "
              f"(median {np.median(tcp):.2f}), joints {deg.mean():.3f} deg (median {np.median(deg):.3f})")  # fmt: skip
    for k, errors in enumerate(whole):
        print(f"fold {k}: {mm_deg(errors)}")


def wall(arm: Arm, logs: Sequence[RunLog]) -> None:
    """How long one waits for a fit on two cores, stage by stage, without the judgement."""
    stages = [("exclusions", time.perf_counter())]

    def note(_share: float, stage: str) -> None:
        if stages[-1][0] != stage:
            stages.append((stage, time.perf_counter()))

    identify_logs(arm, logs, LogSettings(threads=2), note)
    judged = [name for name, _ in stages].index("held-out motions")
    for (name, start), (_, end) in itertools.pairwise(stages[: judged + 1]):
        print(f"{name:40} {end - start:5.1f} s")
    print(f"{'together':40} {stages[judged][1] - stages[0][1]:5.1f} s")


def one(arm: Arm, logs: Sequence[RunLog]) -> None:
    """Fit the multisine motion alone, judge on all the others."""
    alone = [log for log in logs if log.label == "multisine"]
    others = [log for log in logs if log.label != "multisine"]
    start = time.process_time()
    found = identify_logs(arm, alone, LogSettings(threads=1))
    seconds = time.process_time() - start
    judgement = judge(arm, [Candidate.of(FITTED, found.twin)], others)
    print(f"multisine alone: {seconds:.1f} s of one core, stiction {found.twin.stiction:g}, {len(others)} others")
    print(HEADER)
    for name in (NO_TWIN, FITTED):
        print(f"{'mean, ' + name:28} {mm_deg(judgement.mean[name])}")
    tcp = [1e3 * m.errors[FITTED].free.tcp for m in judgement.motions if m.errors[FITTED].free]
    print(f"median over the motions: {np.median(tcp):.2f} mm; worst: {judgement.worst.motion}, {max(tcp):.1f} mm")
    known = judgement.repeatability
    if known is not None:
        print(f"the arm's own repeatability: {1e3 * known.tcp:.2f} mm ({1e3 * known.lowest:.2f} to "
              f"{1e3 * known.highest:.2f}) in {len(known.motions)} motions that repeat")  # fmt: skip


def halves(arm: Arm, logs: Sequence[RunLog]) -> None:
    """Whether intervals from disjoint halves of the motions agree as often as they claim."""
    rng, agree, plain, tests = np.random.default_rng(2), 0, 0, 0  # seeds 0, 1, 10, 11 have served to choose the method
    names, by_kind = vector_names(arm.joint_names), {}
    for _ in range(HALVINGS):
        order = rng.permutation(len(logs))
        sides = []
        for part in (order[::2], order[1::2]):
            chosen = [logs[i] for i in sorted(part)]
            problem, found, _ = fit_motions(arm, chosen, find_exclusions(arm, chosen, table_height(arm, chosen)), GIVEN)
            knowledge = uncertainty(problem, found, independent(problem))
            sides.append((found.vector, knowledge, independent_rows(problem, found)))
        (x, a, u), (y, b, v) = sides
        stiffness = Layout(arm.joints).at("stiffness")
        group = float(np.exp(np.mean(x[stiffness]) - np.mean(y[stiffness])))
        print(f"  mean stiffness of one half over the other: {group:.3f}")
        known = a.identified & b.identified
        gap, sigma = np.abs(x - y), np.sqrt(np.diag(a.covariance) + np.diag(b.covariance))
        agree += int((gap < 1.96 * sigma)[known].sum())
        plain += int((gap < 1.96 * np.sqrt(u + v))[known].sum())
        tests += int(known.sum())
        for i in np.flatnonzero(known):
            by_kind.setdefault(names[i].partition(".")[0], []).append((gap[i] / sigma[i], sigma[i] / np.sqrt(2)))
        print(f"  {agree} of {tests} so far", flush=True)
    print(f"95 % intervals of disjoint halves agree in {agree} of {tests} tests: {100 * agree / tests:.0f} %")
    print(f"the same with every row taken as independent: {100 * plain / tests:.0f} %")
    for kind, values in by_kind.items():
        z, sigma = np.array(values).T
        print(f"  {kind:10} {100 * np.mean(z < 1.96):4.0f} % of {len(z)}, median 1 sigma {np.median(sigma):.4f}")


def independent_rows(problem: Problem, found: Fit) -> np.ndarray:
    """Variances (k,) by the inverse curvature alone, every row taken as independent of the others."""
    x, up = found.vector, problem.inward(found.vector, np.ones(len(found.vector)))
    residuals = problem.residuals(np.vstack([x, problem.perturbations(x, up)]))
    jacobian = problem.jacobian(residuals[0], residuals[1:], up)
    weights = replace(found.weights, correlation=np.ones(problem.joints))
    curvature, _ = problem.system(jacobian, residuals[0], weights)
    return np.diag(np.linalg.inv(curvature + problem.prior.precision))


def sysid(arm: Arm, logs: Sequence[RunLog], seconds: float = 80.0) -> None:
    """Our fit beside mujoco.sysid's: same windows, same model, same start, five parameters per joint."""
    from mujoco import sysid as tool

    if not hasattr(tool, "optimize"):  # without its extra the module imports, and is empty
        print('mujoco.sysid is not installed; to compare with it: pip install "mujoco[sysid]"')
        return
    kept = {log.label for log in logs[::FOLDS]}
    seen, unseen = [log for log in logs if log.label not in kept], [log for log in logs if log.label in kept]
    excluded = find_exclusions(arm, seen, table_height(arm, seen))
    windows = thin(free_windows(seen, excluded, 8.0), seen, seconds)
    structure = simplest(unknown_prior(arm), 1.0)
    frozen, mean = (*LIMITS, "delay"), structure.prior.mean.copy()
    mean[vector_names(arm.joint_names).index("delay")] = 0.0
    problem = Problem(Replay(arm, seen, windows, TIMESTEP, 1, 1.0), structure.prior, frozen)
    start = time.process_time()
    rough = np.where(problem.frozen, mean, rough_fit(problem))
    ours = unpack(fit(problem, rough, 8, SCALES).vector, arm.joints)
    ours_s = time.process_time() - start
    sequences, params = sysid_problem(tool, arm, problem, unpack(mean, arm.joints))
    start = time.process_time()
    with contextlib.redirect_stdout(io.StringIO()):  # it tells every iteration, asked to or not
        found, _ = tool.optimize(
            initial_params=params, residual_fn=tool.build_residual_fn(models_sequences=[sequences], n_threads=1),
            optimizer="mujoco", verbose=False, max_iters=20,
        )  # fmt: skip
    sysid_s = time.process_time() - start
    values = {name: np.exp(found[name].value) for name in ("stiffness", "damping", "coulomb", "armature")}
    base = unpack(mean, arm.joints)
    theirs = TwinParameters(
        **values, offset=found["offset"].value, torque_limit=base.torque_limit, delay=base.delay,
        ramp_speed=base.ramp_speed,
    )  # fmt: skip
    judgement = judge(
        arm,
        [
            Candidate(name="ours", parameters=ours, stiction=1.0),
            Candidate(name="sysid", parameters=theirs, stiction=1.0),
        ],
        unseen,
    )
    print(f"{len(windows)} windows, {sum(float(problem.replay.times(i)[-1]) for i in range(len(windows))):.0f} s")
    for name, taken in (("ours", ours_s), ("sysid", sysid_s)):
        print(f"{name:6} {taken:6.1f} s of one core | held out: {mm_deg(judgement.mean[name])}")
    losses = problem.residuals(np.vstack([pack(ours), pack(theirs)]))
    print(f"root mean square on the windows: ours {np.degrees(np.sqrt(np.mean(losses[0] ** 2))):.3f}, "
          f"sysid {np.degrees(np.sqrt(np.mean(losses[1] ** 2))):.3f} deg")  # fmt: skip


def sysid_problem(tool, arm: Arm, problem: Problem, start: TwinParameters):
    """State the same problem in the terms of mujoco.sysid: logarithms, one parameter for all joints of a kind."""
    spec = twin_spec(arm)
    spec.option.timestep = TIMESTEP
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
    for joint in arm.joint_names:
        spec.joint(joint).solref_friction = friction_solref(np.array(TIMESTEP))
        spec.add_sensor(name=f"{joint}_pos", type=mujoco.mjtSensor.mjSENS_JOINTPOS,
                        objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=joint)  # fmt: skip
        spec.actuator(joint).forcelimited = False

    def servo(spec: mujoco.MjSpec, name: str, gain: float | None = None, offset: float | None = None) -> None:
        actuator = spec.actuator(name)
        k = actuator.gainprm[0] if gain is None else gain
        shift = actuator.biasprm[0] / actuator.gainprm[0] if offset is None else offset
        actuator.gainprm[0], actuator.biasprm[0], actuator.biasprm[1] = k, k * shift, -k

    def each(change: Callable[[mujoco.MjSpec, str, float], object], log: bool = True):
        def modify(spec, parameter):
            for joint, value in zip(arm.joint_names, np.atleast_1d(parameter.value), strict=True):
                change(spec, joint, float(np.exp(value) if log else value))

        return modify

    prior, n = problem.prior, arm.joints
    modifiers = {
        "stiffness": each(lambda s, j, v: servo(s, j, gain=v)),
        "damping": each(lambda s, j, v: setattr(s.joint(j), "damping", [v, 0.0, 0.0])),
        "coulomb": each(lambda s, j, v: setattr(s.joint(j), "frictionloss", v)),
        "armature": each(lambda s, j, v: setattr(s.joint(j), "armature", v)),
        "offset": each(lambda s, j, v: servo(s, j, offset=v), log=False),
    }
    params = tool.ParameterDict()
    names = [name.partition(".")[0] for name in vector_names(arm.joint_names)]
    for name, modifier in modifiers.items():
        place = slice(names.index(name), names.index(name) + n)
        params.add(tool.Parameter(name, pack(start)[place], prior.lower[place], prior.upper[place], modifier=modifier))
    model, replay = spec.compile(), problem.replay
    sequences = ([], [], [], [])
    for index, w in enumerate(replay.windows):
        log = replay.logs[w.log]
        grid = np.arange(int(replay.times(index)[-1] / TIMESTEP)) * TIMESTEP
        row = np.clip(np.searchsorted(log.time, log.time[w.first] + grid, side="right") - 1, 0, len(log) - 1)
        velocity = (log.position[min(w.first + 2, len(log) - 1)] - log.position[max(w.first - 2, 0)]) / (
            log.time[min(w.first + 2, len(log) - 1)] - log.time[max(w.first - 2, 0)]
        )
        measured = tool.TimeSeries.from_names(replay.times(index), log.position[w.first : w.last], model)
        parts = (f"window{index}", tool.create_initial_state(model, log.position[w.first], velocity, np.zeros(0)),
                 tool.TimeSeries(grid, log.command[row]), measured)  # fmt: skip
        for kept, part in zip(sequences, parts, strict=True):
            kept.append(part)
    return tool.ModelSequences("so101", spec, *sequences), params


def rollout(arm: Arm, logs: Sequence[RunLog]) -> None:
    """Candidate-seconds per second of our replay beside mujoco.rollout on the same windows and models."""
    log = max(logs, key=lambda log: (log.label == "multisine", log.time[-1] - log.time[0]))
    windows = free_windows([log], find_exclusions(arm, [log], None), 8.0)
    parameters = unpack(simplest(unknown_prior(arm), 1.0).prior.mean, arm.joints)
    count = 16
    for stiction in (1.0, 1.25):
        replay = Replay(arm, [log], windows, TIMESTEP, 1, stiction)
        candidates = parameters.repeat(count)
        replay.predict(candidates)
        start = time.process_time()
        replay.predict(candidates)
        taken = time.process_time() - start
        print(f"ours, stiction {stiction:4}: {count * replay.steps * TIMESTEP * len(windows) / taken:6.0f} s/s")
    from rejoint.twin.model import twin_model

    model = twin_model(arm, parameters, TIMESTEP)
    sims = count * len(windows)
    states = np.zeros((sims, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    states[:, 1 : 1 + arm.joints] = np.tile([log.position[w.first] for w in windows], (count, 1))
    row = np.linspace(0, len(log) - 1, replay.steps).astype(int)
    control = np.tile(log.command[row][None], (sims, 1, 1))
    models, data = [model] * sims, [mujoco.MjData(model)]
    mujoco.rollout.rollout(models, data, states, control)
    start = time.process_time()
    mujoco.rollout.rollout(models, data, states, control)
    taken = time.process_time() - start
    print(f"mujoco.rollout:      {sims * replay.steps * TIMESTEP / taken:6.0f} s/s (simulation alone)")


SECTIONS = {"folds": folds, "one": one, "halves": halves, "wall": wall, "sysid": sysid, "rollout": rollout}


def bench(given: Path | None) -> None:
    """Run what stands beside MuJoCo's tools, on the best logs there are."""
    arm = load_arm("so101")
    said, logs = sources.find(given, arm)
    print(f"{len(logs)} motions of {said}; errors in mm and degrees: free space | contact | all samples", flush=True)
    for section in (sysid, rollout):
        section(arm, logs)


def main() -> None:
    parser = argparse.ArgumentParser(description="Identification on the logs of a real SO-101.")
    parser.add_argument("logs", type=Path, help="folder of SAGE motions")
    parser.add_argument("sections", nargs="*", choices=[*SECTIONS, []], help="what to run; all by default")
    options = parser.parse_args()
    arm = load_arm("so101")
    logs = sources.read(options.logs, arm)
    for name in options.sections or SECTIONS:
        print(f"\n== {name} ==", flush=True)
        SECTIONS[name](arm, logs)


if __name__ == "__main__":
    main()
