"""States and commands on their own clocks become the rows of a run log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rejoint.arms import Arm
from rejoint.logs.agreement import check_agreement
from rejoint.logs.checks import check_angles, clean
from rejoint.logs.doubts import Doubts
from rejoint.logs.options import ImportOptions
from rejoint.logs.runlog import Array, RunLog
from rejoint.logs.track import Points, RecordedMotion, Track
from rejoint.logs.units import check_normalised, check_steps
from rejoint.system.errors import FileError

_EPOCH = 1e8
"""[s] chosen: three years; a robot's clock that reads more counts from 1970, where a float64 resolves 0.2 us."""

NO_COMMANDS = (
    "holds no commands: it is good for `diagnose` and `replay` of the states alone; stiffness, friction, lag and "
    "zeros, and so a twin, cannot be told"
)


def to_log(motion: RecordedMotion, arm: Arm, options: ImportOptions | None = None) -> tuple[RunLog, list[str]]:
    """Check a motion and put it on the clock of its states.

    Row k holds state k and the command in force at that time: the last one stamped no later (zero-order
    hold). States before the first command are left out, since nobody knows what the arm was told then.
    Raises FileError where the two tracks cannot belong together; where it is doubted, unless ``options``
    force it, and then the log keeps the reasons.
    """
    options = options or ImportOptions()
    doubts = Doubts(force=options.force)
    state, notes = clean(motion.state, doubts)
    command, more = (None, [NO_COMMANDS]) if motion.command is None else clean(motion.command, doubts)
    motion = _near_zero(replace(motion, state=state, command=command, notes=(*motion.notes, *notes, *more)))
    if motion.command is not None:
        _check_one_clock(motion.state, motion.command)
    notes = [*motion.notes, *check_angles(motion, arm, doubts), *check_normalised(motion, arm, options, doubts)]
    check_steps(motion, arm, doubts)
    state, commanded = motion.state, np.full(motion.state.value.shape, np.nan)
    if motion.command is not None:
        state, commanded, more = _joined(state, motion.command)
        notes += [*more, *check_agreement(state, commanded, doubts)]
    notes += [f"imported by force, although {reason}" for reason in doubts.reasons]
    log = RunLog(
        arm=arm.name, joint_names=arm.joint_names, robot=motion.robot, label=motion.name,
        time=state.time, position=state.value, command=commanded,
        target=_at(state.time, motion.points.get("target")), true_tcp=_at(state.time, motion.points.get("true_tcp")),
        extra=motion.extra | doubts.kept,
    )  # fmt: skip
    return log, notes


def _joined(state: Track, command: Track) -> tuple[Track, Array, list[str]]:
    """Return the states from the first command on, the command (T, n) [rad] in force at each, and notes."""
    held = np.searchsorted(command.time, state.time, side="right") - 1
    known = held >= 0
    notes = []
    if not known.all():
        notes.append(f"state: {int((~known).sum())} samples before the first command left out")
    state, held = state.take(known), held[known]
    return state, command.value[held], notes + _phase_notes(state, command, held)


def _near_zero(motion: RecordedMotion) -> RecordedMotion:
    """Count from the first second of the log where the clock counts from 1970."""
    start = float(motion.state.time[0])
    if start < _EPOCH:
        return motion
    origin = float(np.floor(start))
    points = {name: Points(time=p.time - origin, value=p.value) for name, p in motion.points.items()}
    return replace(
        motion, state=motion.state.shifted(origin), points=points,
        command=None if motion.command is None else motion.command.shifted(origin),
        extra=motion.extra | {"clock_origin_s": f"{origin:.0f}"},
    )  # fmt: skip


def _check_one_clock(state: Track, command: Track) -> None:
    common = min(state.time[-1], command.time[-1]) - max(state.time[0], command.time[0])
    shorter = min(state.time[-1] - state.time[0], command.time[-1] - command.time[0])
    if common < 0.5 * shorter:
        raise FileError(
            state.path, f"states last from {state.time[0]:.6f} to {state.time[-1]:.6f} s, commands from "
            f"{command.time[0]:.6f} to {command.time[-1]:.6f} s: not one clock",
            "record both on one clock, or take the times of recording (stamp log) for MCAP",
        )  # fmt: skip
    if command.time[0] >= state.time[-1]:
        raise FileError(state.path, "no state after the first command", "take a longer log")


def _phase_notes(state: Track, command: Track, held: np.ndarray) -> list[str]:
    notes = []
    if len(state) < 2:
        raise FileError(state.path, f"{len(state)} state(s) after the first command, a log needs 2", "record it again")
    inside = command.time <= state.time[-1]
    unseen = int(inside.sum()) - len(np.unique(held))
    if unseen > 0:
        notes.append(f"command: {unseen} of {len(command)} were replaced before the next state and are not in the log")
    age = state.time - command.time[held]
    if (age > 0).any():
        notes.append(
            f"command: not stamped with the states; a row's command is {1e3 * np.median(age):.3g} ms old "
            f"(median, at most {1e3 * age.max():.3g} ms)"
        )
    return notes


def _at(time: Array, points: Points | None) -> Array:
    """Points (T, 3) at the given times; NaN where no point has exactly that stamp."""
    values = np.full((len(time), 3), np.nan)
    if points is not None and len(points.time):
        order = np.argsort(points.time, kind="stable")
        near = np.minimum(np.searchsorted(points.time[order], time), len(order) - 1)
        same = points.time[order][near] == time
        values[same] = points.value[order][near[same]]
    return values
