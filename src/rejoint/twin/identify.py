"""Identification: a twin with intervals from logs, judged on motion that the fit has not seen.

Of an excitation every fourth window is held out. In other logs only free motion counts, whole motions are held out,
and priors are wide. After the judgement all motions are fitted, the table last.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import compress

import numpy as np

from rejoint.arms import Arm, Array, Index, Mask, gravity_torque, tcp_position
from rejoint.control.correction import rms, tool_error
from rejoint.diagnosis.measurement import sag_doubt
from rejoint.diagnosis.segments import ExcitationLog, join_logs
from rejoint.logs.columns import ZEROS
from rejoint.logs.exclusions import (
    Exclusions,
    answered,
    find_exclusions,
    powered,
    recorded_gain,
    table_height,
    velocity,
)
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.progress import Progress, no_progress
from rejoint.system.records import value_type
from rejoint.system.statistics import NORMAL95
from rejoint.twin.fit import CLUSTER, SCALES, Fit, Problem, explained, fit, limiting, uncertainty
from rejoint.twin.judge import TIMESTEP, Candidate, judge, predict_logs
from rejoint.twin.parameters import (
    LEAST_FED,
    Prior,
    healthy_parameters,
    is_hobby,
    number,
    pack,
    prior,
    unknown_prior,
    unpack,
)
from rejoint.twin.replay import (
    MOSTLY,
    SHORTEST_STRETCH,
    STILL_SPEED,
    VELOCITY,
    Replay,
    Window,
    cut,
    cut_windows,
    durations,
    farthest,
    part,
    repeated,
    thin,
)
from rejoint.twin.structure import (
    OFTEN,
    TOGETHER,
    Structure,
    decide_compensation,
    drive_torque,
    explored,
    find_acceleration,
    find_structure,
    rough_fit,
    with_both,
    with_limit,
)
from rejoint.twin.twin import NO_TWIN, HeldOut, Judgement, PredictionError, TablePlane, Twin

FITTED, HEALTHY = "fitted twin", "healthy twin"
"""Predictions besides `NO_TWIN`"""

IDENTIFIED = 0.5
"""Sigma over the prior's of an identified parameter; chosen"""

SCALE = ("stiffness", "damping", "coulomb", "armature")
"""Parameters of a joint with one scale, where nothing tells torques"""

SAGLESS = ("delay", "ramp_speed")
"""Parameters that no sag tells"""

FAR_OFF = 0.15
"""[rad] rms distance from commands of a joint that may be soft, or too weak; chosen"""

LIGHT_SAG = 1e-3
"""[rad] sag of a joint whose offset shows without its stiffness; chosen"""

SHORTEST_EXCITATION, SHORTEST = 20.0, 10.0
"""[s] least motion, and least free motion; chosen"""

WINDOW = 8.0
"""[s] between restarts from the measured state in logs of any motion; measured: 1 to 50 s are equal"""

EXCITATION_WINDOW, PIECE, HOLD_OUT = 6.0, 2.0, 4
"""[s] between restarts, the same in the first fit, and one of how many windows is held out; chosen"""

UNSEEN = ("load_friction",)
"""Parameters that an excitation does not tell"""

ITERATIONS, REFINEMENT = 15, 6
"""Most steps of the last descent, for an excitation and for other motion; chosen"""

LEAST_CONTACT = 5.0
"""[s] least contact for a table fit; chosen"""

REFITTED = "errors on held-out motion are those of a fit that had not seen it; the values are fitted to all motions"
REPEATED = "the motions held out repeat those that were fitted: errors on other motion are larger"
UNTRUSTED = (
    "on motion it has not seen the twin does not halve the command's error, or a healthy twin is nearer: do not train "
    "in it"
)
UNJUDGED = "no motion was held out: the errors are those on the motions that were fitted"


CLUSTERED = 8
"""Motions from which intervals rest on them, not on windows; chosen"""

STRIDE = 2.5
"""Finite-difference steps over those for an excitation; measured: smaller ones fit stick-slip"""
FREEDOM = 1.0
"""Degrees of freedom of window errors; chosen"""


@value_type
class LogSettings:
    """Settings of an identification from logs."""

    hold_out: tuple[str, ...] | None = None
    """labels of motions; empty: none; None: drawn"""
    seed: int = 0
    """of the drawn ones"""
    coarse_seconds: float = 50.0
    """[s] for the structure; measured: 100 s are equal"""
    fit_seconds: float = 200.0
    """[s] for the final fit; measured: 400 s are equal, 100 s 3 % worse"""
    far_seconds: float = 40.0
    """[s] of the motion farthest from its commands, which shows limits"""
    contact_seconds: float = 240.0
    """[s] of contact for the table; measured: 80 s are a fifth worse"""


def identify(
    arm: Arm,
    logs: Sequence[RunLog],
    on_progress: Progress = no_progress,
    doubt: str = "",
) -> Twin:
    """Fit a twin to an excitation, the first of ``logs``; ``doubt``: of its sag (`rejoint.diagnosis.diagnosis`).

    InputError for another arm or too little motion.
    """
    seconds = sum(log.duration for log in logs)
    windows = cut(logs, EXCITATION_WINDOW)
    first = [window for window in windows if window.log is logs[0]]
    unseen = first[HOLD_OUT - 1 :: HOLD_OUT]
    seen = [window for window in windows if window not in unseen]
    if seconds < SHORTEST_EXCITATION or not unseen:
        raise InputError(
            f"identification: {seconds:.0f} s of motion, {len(first)} windows of about {EXCITATION_WINDOW:g} s in the "
            f"first log; expected at least {SHORTEST_EXCITATION:.0f} s, and {HOLD_OUT} windows; record a longer log"
        )
    belief = prior(arm) if is_hobby(arm) else Structure(belief=unknown_prior(arm), frozen=UNSEEN).prior
    rows = round(PIECE * sum(len(log) - 1 for log in logs) / seconds)
    pieces = [piece for w in seen for piece in w.split(max(1, round((w.last - w.first) / rows)))]
    on_progress(0.0, "search")
    coarse = Problem(Replay(arm, pieces, TIMESTEP), belief, UNSEEN)
    x = with_limit(coarse, fit(coarse, rough_fit(coarse), ITERATIONS).vector, "torque_limit")
    x = explored(coarse, x, ~explained(coarse.residuals(x[None])[0]))
    on_progress(0.6, "refinement")
    fine = Problem(Replay(arm, seen), belief, UNSEEN)
    found = fit(fine, x, ITERATIONS)
    on_progress(0.9, "intervals")
    held_out = _held_out_windows(replace(fine.replay, windows=unseen), found.vector)
    clusters = np.unique(fine.window + 1j * (fine.replay.time // CLUSTER), return_inverse=True)[1]
    twin = fitted_twin(fine, found, uncertainty(fine, found, clusters), logs, held_out, doubted=doubt)
    return replace(twin, notes=(*twin.notes, *[UNTRUSTED] * (not held_out.trusted), *filter(None, [doubt])))


def _held_out_windows(replay: Replay, vector: Array) -> HeldOut:
    arm, measured = replay.arm, replay.measured
    both = np.vstack([vector, *([pack(healthy_parameters(arm))] if is_hobby(arm) else [])])
    predicted = [replay.commands, *replay.predict(unpack(both))]
    tip = tcp_position(arm, measured)
    no_twin, twin, *healthy = (
        PredictionError(joint=rms(positions - measured), tcp=rms(tool_error(arm, positions, tip)))
        for positions in predicted
    )
    return HeldOut(seconds=replay.seconds, no_twin=no_twin, healthy_twin=healthy[0] if healthy else None, twin=twin)


def fitted_twin(
    problem: Problem,
    found: Fit,
    covariance: Array,
    logs: Sequence[RunLog],
    held_out: HeldOut,
    table: TablePlane | None = None,
    *,
    doubted: str | bool = False,
) -> Twin:
    """Assemble a twin with its intervals by ``covariance`` (k, k); the torques seen in all ``logs`` bound it.

    Where the sag is ``doubted``, as without known zeros, only `SAGLESS` ones are identified.
    """
    replay, belief, at = problem.replay, problem.prior, problem.layout.at
    unreached = ~limiting(problem, found.vector)
    place, vector = at("torque_limit"), found.vector.copy()
    vector[place] = np.where(unreached, belief.upper[place], vector[place])
    parameters = unpack(vector)
    told, sigma = belief.sigma if belief.told is None else belief.told, np.sqrt(np.diag(covariance))
    narrowing = sigma / told
    sagless = np.isin(belief.layout.kind, [number(name) for name in SAGLESS])
    identified = (narrowing < IDENTIFIED) & ~found.at_bound & ~problem.frozen & (sagless | (not doubted))
    silent = problem.powered.sum(axis=0) == 0
    residual, off = problem.residuals(vector[None])[0], ((replay.commands - replay.measured) ** 2).mean(axis=0)
    worse = (residual**2).mean(axis=0) > off  # than the command alone
    worse |= (off > FAR_OFF**2) & unreached & (not is_hobby(replay.arm))  # soft or too weak; of others priors tell
    together = sum(told[at(name)] ** -2 for name in SCALE) ** -0.5  # of their scale, by all priors without data
    mute, vague = (
        np.append(one, False)[problem.owner]
        for one in (silent | worse | ~explained(residual), sigma[at("stiffness")] > together)
    )
    # where an interval goes beyond its bound, only the bound tells where it ends
    identified &= ~mute & ~((vague | (vector + NORMAL95 * sigma > belief.upper)) & belief.layout.is_log)
    held, limit = largest_static_torque(replay.arm, logs, parameters.coulomb), parameters.torque_limit
    identified[place] &= ~unreached & is_hobby(replay.arm)  # others may have any no-load speed
    least = np.exp(vector - NORMAL95 * sigma)[at("stiffness")]
    light = np.abs(problem.gravity) < LIGHT_SAG * least
    # a model too light by half, or more, is another arm's
    identified[at("stiffness")] &= (vector > belief.lower)[at("compensation")]
    identified[at("offset")] &= identified[at("stiffness")] | light  # of unknown stiffness, it holds what is sag
    # below zero it stands for speed that is fed forward, or for late readings; at its bound damping does so too
    identified[at("delay")] &= parameters.delay > 0.0
    # what the sag leaves to either
    identified[at("compensation")] = identified[at("stiffness")] & ~light & (narrowing < IDENTIFIED)[at("compensation")]
    identified[at("damping")] &= ~found.at_bound[at("delay")]
    lower = unpack(belief.lower)
    # a limit that no motion reaches is anything above what was shown
    shown = drive_torque(problem, vector, OFTEN, damping=float(not is_hobby(replay.arm)))  # others may limit the sum
    raised = np.maximum(held, unreached * shown)
    raised = np.clip(raised, lower.torque_limit, 0.99 * limit)
    covariance[place, place] += np.diag((unreached | problem.frozen[place]) * (np.log(limit / raised) / NORMAL95) ** 2)
    twin = Twin(
        arm=replay.arm.name,
        joint_names=replay.arm.joint_names,
        parameters=parameters,
        covariance=covariance,
        lower=pack(replace(lower, torque_limit=raised)),
        upper=belief.upper,
        narrowing=narrowing,
        identified=identified,
        held_out=held_out,
        fit_seconds=replay.seconds,
        acceleration=replay.acceleration,
        table=table,
    )
    return replace(twin, notes=tuple(_notes(twin, light, silent)))


def largest_static_torque(arm: Arm, logs: Sequence[RunLog], coulomb: Array) -> Array:
    """(n,) [N m] largest gravity torque held, less friction."""
    speed = np.concatenate([velocity(log.time, log.position, VELOCITY) for log in logs])
    load = np.abs(gravity_torque(arm, np.concatenate([log.position for log in logs]))) - coulomb
    return np.max(load * (np.abs(speed) < STILL_SPEED), axis=0, initial=0.0)


def _notes(twin: Twin, light: Mask, silent: Mask) -> list[str]:
    notes = []
    low, high = (end.compensation for end in twin.interval)
    if (fed := np.flatnonzero(np.maximum(low, -high) * ~light > LEAST_FED)).size:
        notes.append(
            f"{', '.join(f'{twin.parameters.compensation[j]:.0%} at {twin.joint_names[j]}' for j in fed)} of the "
            "model's gravity do not show: the controller feeds them forward, a spring carries them, or the model is "
            "too heavy; below zero, it is too light, or the arm carries a load"
        )
    if silent.any():
        notes.append(f"replayed where it was, as it never answers: {', '.join(compress(twin.joint_names, silent))}")
    if twin.unknown_scale:
        notes.append(
            f"at most the ratios of stiffness, damping, friction, inertia and torque limit are known, not their common "
            f"scale, so no torques: {', '.join(twin.unknown_scale)}"
        )
    return notes


def identify_logs(
    arm: Arm,
    logs: Sequence[RunLog],
    settings: LogSettings,
    on_progress: Progress = no_progress,
    beside: Sequence[Candidate] = (),
) -> Twin:
    """Fit a twin to logs; judge it, and the candidates ``beside`` it, on held-out motions.

    The returned twin is fitted to all logs; ``held_out`` are the free-space means of its ``judgement``, for a fit to
    the motions ``fitted``. InputError for another arm or too little motion.
    """
    logs = [answered(log) for log in powered(arm, logs)]
    gain = recorded_gain(logs)
    seen, unseen = part(arm, logs, settings.hold_out, settings.seed)
    height = table_height(arm, seen)
    motions = Motions(arm, seen, settings, height, gain)
    every = replace(motions, logs=sorted(logs, key=lambda log: log.label))
    healthy = [Candidate(name=HEALTHY, parameters=healthy_parameters(arm))] if is_hobby(arm) else []

    def judged(problem: Problem, found: Fit) -> tuple[TablePlane | None, Judgement]:
        table = motions.fit_table(problem, found)
        values, acceleration = unpack(found.vector), problem.replay.acceleration
        own = Candidate(name=FITTED, parameters=values, table=table, acceleration=acceleration)
        compared = [replace(one, gain=gain) if one.gain is None else one for one in (own, *healthy, *beside)]
        return table, judge(arm, predict_logs(arm, compared, unseen), unseen, table=height)

    with ThreadPoolExecutor(1) as pool:
        doubting = pool.submit(lambda: sag_doubt(every.data))
        on_progress(0.0, "search")
        structure, start = motions.find_structure(on_progress)
        on_progress(0.5, "fit")
        structure, problem, found = motions.choose(structure, start)
        judging = pool.submit(judged, problem, found)
        on_progress(0.8, "held-out and all motions")
        note, missing = UNJUDGED, [UNJUDGED]
        if settings.hold_out != ():
            alike = bool(np.mean(np.concatenate(repeated(unseen, seen))) > MOSTLY)
            note, missing = REFITTED, [REPEATED] * alike
            belief = replace(every.belief, lower=structure.belief.lower)  # of the delay, as decided
            problem, found = every.settle(replace(structure, belief=belief), found.vector)
        on_progress(0.9, "intervals")
        covariance = uncertainty(problem, found, independent(problem))
        doubt, (table, judgement) = doubting.result(), judging.result()
    doubted = doubt or ZEROS in every.data.log.extra
    twin = fitted_twin(problem, found, covariance, every.logs, _held_out(judgement), table, doubted=doubted)
    return replace(
        twin,
        gain=gain,
        notes=(*twin.notes, note),
        fitted=tuple(log.label for log in seen),
        judgement=replace(judgement, doubts=(*judgement.doubts, *missing, *filter(None, [doubt]))),
    )


@dataclass(frozen=True)
class Motions:
    """Motions to which one twin is fitted, off table and stops."""

    arm: Arm
    logs: Sequence[RunLog]
    settings: LogSettings
    height: float | None = None
    """[m] of the tip on a table; None without contact"""
    gain: Array | None = None
    """(n,) P gain that the stiffness is for"""

    @cached_property
    def excluded(self) -> Sequence[Exclusions]:
        """Contacts, stops and dead readings in each log."""
        return find_exclusions(self.arm, self.logs, self.height)

    @cached_property
    def data(self) -> ExcitationLog:
        """All motions on one clock."""
        return join_logs(self.arm, self.excluded)

    @cached_property
    def windows(self) -> list[Window]:
        """Free motion."""
        return cut_windows(self.excluded, WINDOW)

    @cached_property
    def far(self) -> list[Window]:
        """The free motion in which limits show."""
        return farthest(self.windows, self.settings.far_seconds)

    @property
    def belief(self) -> Prior:
        """Prior by what the sag in these motions tells."""
        return decide_compensation(self.data)

    def problem(self, windows: Sequence[Window], structure: Structure, stride: float = STRIDE) -> Problem:
        """Make the problem of some windows."""
        replay = Replay(self.arm, windows, TIMESTEP, structure.acceleration, self.gain)
        return Problem(replay, structure.prior, structure.frozen, stride, FREEDOM)

    def find_structure(self, on_progress: Progress = no_progress) -> tuple[Structure, Array]:
        """Find a twin's structure, and its optimum (k,) on few windows; InputError for too little motion."""
        seconds = durations(self.windows).sum()
        if seconds < SHORTEST:
            raise InputError(
                f"identification: {seconds:.1f} s of free motion to fit, in stretches of {SHORTEST_STRETCH:g} s and "
                f"more, expected at least {SHORTEST:.0f} s; record longer motions, off table and stops"
            )
        slow = thin(self.windows, self.settings.coarse_seconds)
        simple = Structure(belief=self.belief, acceleration=self.arm.servo_acceleration)
        x = rough_fit(self.problem(slow, simple))
        on_progress(0.3, "structure")
        expected, simple = simple, find_acceleration(partial(self.problem, self.far), simple, x)
        if np.isinf(simple.acceleration) != np.isinf(expected.acceleration):
            x = rough_fit(self.problem(slow, simple))
        return find_structure(partial(self.problem, self.chosen(slow)), simple, x)

    def chosen(self, windows: Sequence[Window]) -> list[Window]:
        """Return some ``windows`` and those in which limits show, in their order."""
        return sorted({*windows, *self.far}, key=self.windows.index)

    def settle(self, structure: Structure, start: Array) -> tuple[Problem, Fit]:
        """Fit windows from all logs, from ``start`` (k,)."""
        problem = self.problem(self.chosen(thin(self.windows, self.settings.fit_seconds)), structure, stride=1.0)
        start = np.where(problem.layout.is_fitted, start, problem.prior.mean)
        return problem, fit(problem, start, REFINEMENT, SCALES)

    def choose(self, structure: Structure, start: Array) -> tuple[Structure, Problem, Fit]:
        """Settle without and with `TOGETHER`; keep those where windows that neither fit has seen are predicted better.

        Each alone gains little: friction that grows with load is wrong at the scale of torques that hides a limit.
        """
        fuller = replace(structure, frozen=tuple(name for name in structure.frozen if name not in TOGETHER))
        if fuller.frozen == structure.frozen:
            return structure, *self.settle(structure, start)
        both = with_both(self.problem(self.far, structure), start)
        with ThreadPoolExecutor(2) as pool:
            (problem, found), (rival, other) = pool.map(self.settle, (structure, fuller), (start, both))
        unseen = [window for window in self.windows if window not in problem.replay.windows]
        fresh = thin(unseen, self.settings.fit_seconds)
        if not fresh:
            return structure, problem, found
        replay = replace(problem.replay, windows=fresh)
        paths = replay.predict(unpack(np.stack([found.vector, other.vector])))
        simple, full = tool_error(self.arm, paths, tcp_position(self.arm, replay.measured)).mean(axis=1)
        return (fuller, rival, other) if full < simple else (structure, problem, found)

    def fit_table(self, problem: Problem, found: Fit) -> TablePlane | None:
        """Fit the table to the motion in contact; None where that is too little."""
        windows = cut_windows(self.excluded, WINDOW, contact=True)
        if self.height is None or durations(windows).sum() < LEAST_CONTACT:
            return None
        from rejoint.twin.table import fit_table  # late: free arms need no MuJoCo

        touching = replace(problem.replay, windows=thin(windows, self.settings.contact_seconds))
        return fit_table(touching, unpack(found.vector), self.height)


def independent(problem: Problem) -> Index:
    """(rows,) numbers of independent motions, or of windows where there are few."""
    motion = problem.replay.motion
    return motion if motion.max() + 1 >= CLUSTERED else problem.window


def _held_out(judgement: Judgement) -> HeldOut:
    def error(name: str) -> PredictionError:
        found = judgement.mean[name].free or judgement.mean[name].all
        if found is None:
            raise InputError("identification: the held-out motions hold no usable row; hold out others")
        return found

    seconds = sum(motion.seconds - motion.contact_seconds - motion.left_out_seconds for motion in judgement.motions)
    healthy = error(HEALTHY) if HEALTHY in judgement.mean else None
    return HeldOut(seconds=seconds, no_twin=error(NO_TWIN), healthy_twin=healthy, twin=error(FITTED))
