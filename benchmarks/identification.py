"""Identification on the logs of a real SO-101, and its speed beside MuJoCo's own tool.

    python -m benchmarks identification --logs LOGS --sections folds,sysid

LOGS is a folder of SAGE motions (github.com/isaac-sim2real/sage, output/real/so101/custom), by default that of the
environment variable REJOINT_SO101. Times are processor seconds of the whole process.
"""

import contextlib
import io
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import mujoco
import mujoco.rollout
import numpy as np
import typer

from rejoint.arms import Arm, load_arm
from rejoint.logs.exclusions import find_exclusions, table_height
from rejoint.logs.importing import import_logs
from rejoint.logs.runlog import RunLog
from rejoint.twin.fit import SCALES, Problem, fit
from rejoint.twin.identify import FITTED, LogSettings, identify_logs
from rejoint.twin.judge import TIMESTEP, Candidate, Errors, judge, predict_logs
from rejoint.twin.parameters import Layout, TwinParameters, pack, unknown_prior, unpack, vector_names
from rejoint.twin.replay import FOLDS, Replay, cut_windows, thin
from rejoint.twin.replay import folds as fold_numbers
from rejoint.twin.structure import OPTIONAL, Structure, rough_fit
from rejoint.twin.table import twin_spec


def read_logs(folder: Path, arm: Arm) -> list[RunLog]:
    """Import a folder of SAGE motions."""
    with tempfile.TemporaryDirectory() as place:
        return sorted(import_logs(folder, arm, out=Path(place) / "logs").logs, key=lambda log: log.label)


def mm_deg(errors: Errors) -> str:
    parts = [errors.free, errors.contact, errors.all]
    return " | ".join("   -      -" if p is None else f"{1e3 * p.tcp:5.2f} {np.degrees(p.joint):6.3f}" for p in parts)


HEADER = f"{'':28} free mm    deg | contact    deg | all mm    deg"


def folds(arm: Arm, logs: Sequence[RunLog]) -> None:
    """Every motion is held out once."""
    errors, number = {"free": [], "contact": [], "all": []}, fold_numbers(arm, logs, 0)
    for k in range(FOLDS):
        names = tuple(log.label for log, own in zip(logs, number, strict=True) if own == k)
        start = time.process_time()
        found = identify_logs(arm, logs, LogSettings(hold_out=names))
        seconds = time.process_time() - start
        print(f"\nfold {k}: {len(found.fitted)} motions fitted, others judged, all fitted: {seconds:.1f} s of one core")
        print(HEADER)
        for motion in found.judgement.motions:
            print(f"{motion.motion:28} {mm_deg(motion.errors[FITTED])}")
            for part, some in errors.items():
                some.append(getattr(motion.errors[FITTED], part))
        for name, mean in found.judgement.mean.items():
            print(f"{'mean, ' + name:28} {mm_deg(mean)}", flush=True)
    for part, some in errors.items():
        tcp, deg = np.array([(1e3 * e.tcp, np.degrees(e.joint)) for e in some if e is not None]).T
        print(
            f"\n{part}, {len(tcp)} motions, each held out once: TCP {tcp.mean():.2f} mm "
            f"(median {np.median(tcp):.2f}), joints {deg.mean():.3f} deg (median {np.median(deg):.3f})"
        )


def sysid(arm: Arm, logs: Sequence[RunLog], seconds: float = 80.0) -> None:
    """Our fit beside mujoco.sysid's: same windows, same model, same start, five parameters per joint."""
    from mujoco import sysid as tool

    if not hasattr(tool, "optimize"):  # without its extra the module imports, and is empty
        print('mujoco.sysid is not installed; to compare with it: pip install "mujoco[sysid]"')
        return
    kept = {log.label for log in logs[::FOLDS]}
    seen, unseen = [log for log in logs if log.label not in kept], [log for log in logs if log.label in kept]
    excluded = find_exclusions(arm, seen, table_height(arm, seen))
    windows = thin(cut_windows(excluded, 8.0), seconds)
    structure = Structure(belief=unknown_prior(arm))
    frozen, mean = (*OPTIONAL, "delay", "stiction"), structure.prior.mean.copy()
    mean[Layout(arm.joints).at("delay")], mean[Layout(arm.joints).at("stiction")] = 0.0, 1.0
    problem = Problem(Replay(arm, windows, TIMESTEP), structure.prior, frozen)
    start = time.process_time()
    rough = np.where(problem.frozen, mean, rough_fit(problem))
    ours = unpack(fit(problem, rough, 8, SCALES).vector)
    ours_s = time.process_time() - start
    sequences, params = sysid_problem(tool, arm, problem, unpack(mean))
    start = time.process_time()
    with contextlib.redirect_stdout(io.StringIO()):  # it tells every iteration, asked to or not
        found, _ = tool.optimize(
            initial_params=params,
            residual_fn=tool.build_residual_fn(models_sequences=[sequences], n_threads=1),
            optimizer="mujoco",
            verbose=False,
            max_iters=20,
        )
    sysid_s = time.process_time() - start
    values = {name: np.exp(found[name].value) for name in ("stiffness", "damping", "coulomb", "armature")}
    base = unpack(mean)
    theirs = TwinParameters(
        **values,
        offset=found["offset"].value,
        torque_limit=base.torque_limit,
        delay=base.delay,
        ramp_speed=base.ramp_speed,
    )
    both = [Candidate(name="ours", parameters=ours), Candidate(name="sysid", parameters=theirs)]
    judgement = judge(arm, predict_logs(arm, both, unseen), unseen)
    print(f"{len(windows)} windows, {problem.replay.seconds:.0f} s")
    for name, taken in (("ours", ours_s), ("sysid", sysid_s)):
        print(f"{name:6} {taken:6.1f} s of one core | held out: {mm_deg(judgement.mean[name])}")
    losses = problem.residuals(np.vstack([pack(ours), pack(theirs)]))
    print(
        f"root mean square on the windows: ours {np.degrees(np.sqrt(np.mean(losses[0] ** 2))):.3f}, "
        f"sysid {np.degrees(np.sqrt(np.mean(losses[1] ** 2))):.3f} deg"
    )


def sysid_problem(tool, arm: Arm, problem: Problem, start: TwinParameters):
    """State the same problem in the terms of mujoco.sysid: logarithms, one parameter for all joints of a kind."""
    spec = twin_spec(arm)
    spec.option.timestep = TIMESTEP
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
    for joint in arm.joint_names:
        spec.joint(joint).solref_friction = [2.0 * TIMESTEP, 1.0]
        spec.add_sensor(
            name=f"{joint}_pos", type=mujoco.mjtSensor.mjSENS_JOINTPOS, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=joint
        )
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
        log = w.log
        time = replay.time[replay.window == index]
        grid = np.arange(int(time[-1] / TIMESTEP)) * TIMESTEP
        row = np.clip(np.searchsorted(log.time, log.time[w.first] + grid, side="right") - 1, 0, len(log) - 1)
        velocity = (log.position[min(w.first + 2, len(log) - 1)] - log.position[max(w.first - 2, 0)]) / (
            log.time[min(w.first + 2, len(log) - 1)] - log.time[max(w.first - 2, 0)]
        )
        measured = tool.TimeSeries.from_names(time, log.position[w.first : w.last], model)
        parts = (
            f"window{index}",
            tool.create_initial_state(model, log.position[w.first], velocity, np.zeros(0)),
            tool.TimeSeries(grid, log.command[row]),
            measured,
        )
        for kept, part in zip(sequences, parts, strict=True):
            kept.append(part)
    return tool.ModelSequences("so101", spec, *sequences), params


SECTIONS = {"folds": folds, "sysid": sysid}


def main(
    logs: Annotated[Path | None, typer.Option(envvar="REJOINT_SO101", exists=True)] = None, sections: str = "sysid"
) -> None:
    """Run ``sections`` on a folder of a real SO-101's motions."""
    if logs is None:
        print("left out: make bench LOGS=FOLDER, --logs or REJOINT_SO101 names the motions")
        return
    arm = load_arm("so101")
    found = read_logs(logs, arm)
    print(f"{len(found)} motions in {logs}; errors in mm and degrees: free space | contact | all samples", flush=True)
    for name in sections.split(","):
        SECTIONS[name](arm, found)
