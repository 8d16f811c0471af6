"""Consistency checks of logs.

Impossible numbers raise an error; unlikely ones are doubts in `LogFindings`; others give a note. All thresholds
without a source are chosen.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from hashlib import sha256

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm
from rejoint.logs.columns import RecordedMotion, Track
from rejoint.logs.exclusions import correlations
from rejoint.logs.joints import ImportOptions
from rejoint.logs.lag import PLAUSIBLE, SEARCHED, SHORTEST, find_lag
from rejoint.logs.runlog import TWO_TURNS, Array, RunLog
from rejoint.logs.units import FEWEST_STEPS, FEWEST_VALUES, OFF, ON, on_grid, turn_bits, unit_by_steps
from rejoint.system.errors import FileError, InputError

FORCED = "forced"
"""Key in ``extra`` of overridden reasons"""

_BETWEEN = " | "


@dataclass(frozen=True, kw_only=True)
class LogFindings:
    """What the checks of a log found."""

    force: bool = False
    """import all the same"""
    notes: list[str] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)
    """overridden doubts"""

    def doubt(self, track: Track, problem: str, remedy: str) -> None:
        """Raise FileError, or store the problem by force."""
        if not self.force:
            raise FileError(track.path, problem, f"{remedy}; or go on with --force, which keeps this reason in the log")
        if problem not in self.reasons:
            self.reasons.append(problem)

    @property
    def extra(self) -> dict[str, str]:
        """Entry of a log's ``extra``."""
        return {FORCED: _BETWEEN.join(self.reasons)} if self.reasons else {}


def forced_reasons(extra: dict[str, str]) -> tuple[str, ...]:
    """Reasons of `LogFindings.extra`."""
    return tuple(extra[FORCED].split(_BETWEEN)) if extra.get(FORCED) else ()


def forced_remarks(logs: Sequence[RunLog]) -> list[str]:
    """Name logs imported by force."""
    found: dict[str, list[str]] = {}
    for log in logs:
        for reason in forced_reasons(log.extra):
            found.setdefault(reason, []).append(log.label)
    return [
        f"{labels[0]}{f' and {len(labels) - 1} more' * (len(labels) > 1)}: imported by force, although {reason}"
        for reason, labels in found.items()
    ]


def states_alone(logs: Sequence[RunLog], what: str) -> bool:
    """Whether no log holds commands; InputError if some do."""
    bare = [log.label for log in logs if not log.commanded]
    if bare and len(bare) < len(logs):
        raise InputError(
            f"{what}: {len(bare)} of {len(logs)} logs hold no commands ({bare[0]}{', ...' * (len(bare) > 1)}); "
            "put them into a folder of their own"
        )
    return bool(bare)


def require_commands(logs: Sequence[RunLog], what: str) -> None:
    """Raise InputError for logs without commands."""
    if states_alone(logs, what):
        raise InputError(
            f"{what}: these logs hold no commands, and without them stiffness, friction, lag and zeros cannot be told; "
            "record what is sent as well (`replay` takes states alone)"
        )


def copies(logs: Iterable[tuple[str, RunLog]]) -> dict[str, str]:
    """Return logs that repeat an earlier one, with its name."""
    first: dict[bytes, str] = {}
    found: dict[str, str] = {}
    for name, log in logs:
        if np.ptp(log.position, axis=0).any():
            key = sha256(np.concatenate([log.position, log.command]).tobytes()).digest()
            if first.setdefault(key, name) != name:
                found[name] = first[key]
    return found


def refuse_copies(logs: Sequence[RunLog], what: str) -> None:
    """Raise InputError for duplicates."""
    for name, original in copies((log.label, log) for log in logs).items():
        raise InputError(
            f"{what}: {name} holds the same readings as {original}, and would count as evidence of its own; "
            "remove the copies"
        )


RATES = (1.0, 10_000.0)
"""[Hz] of logs"""
SLOWEST = 10.0
"""[Hz] for friction and lag"""
LOST = 0.05
"""share of repeated stamps of a coarse clock"""
GAP_PERIODS = 5.0
"""median periods of a gap"""
_TIME_REMEDY = "set the time unit (--time-unit, or the column's name where that says one), or take another file"


def clean(track: Track, found: LogFindings) -> Track:
    """Check a clock; returns the track without doubled stamps. FileError."""
    what, steps = track.what, np.diff(track.time)
    if not np.isfinite(track.time).all():
        at = track.where(int(np.argmin(np.isfinite(track.time))))
        raise FileError(track.path, f"{what}, {at}: the time is not a number", "mend or cut it")
    if (steps < 0).any():
        late = int(np.argmax(steps < 0)) + 1
        raise FileError(
            track.path,
            f"{what}, {track.where(late)}: the clock goes back by {-steps[late - 1]:.6g} s",
            "cut the file where the clock was set, or in a bag take the times of recording (--stamp log)",
        )
    fresh = np.concatenate([[True], steps > 0])[: len(track)]
    lost = int((~fresh).sum())
    if len(track) - lost < 2:
        said = f"{what}: {len(track) - lost} sample(s), a log needs at least 2 with stamps of their own"
        raise FileError(track.path, said, _TIME_REMEDY)
    steps = steps[fresh[1:]]
    period = float(np.median(steps))
    if lost > LOST * len(track):
        said = f"{what}: {lost} of {len(track)} samples have the stamp of the one before and are lost"
        found.doubt(track, said, "record finer stamps")
    if lost:
        first = track.where(int(np.argmin(fresh)))
        found.notes.append(f"{what}: {lost} samples with a doubled stamp left out, first at {first}")
        track = track.take(fresh)
    sparse = what == "command"  # a command may stand for as long as it likes
    if period * RATES[1] < 1.0 or (period * RATES[0] > 1.0 and not sparse):
        expected = f"expected {RATES[0]:g} to {RATES[1]:g} Hz"
        raise FileError(track.path, f"{what}: one sample in {period:.3g} s, {expected}", _TIME_REMEDY)
    if period * 0.99 * SLOWEST > 1.0 and not sparse:
        said = f"{what}: {1 / period:.2g} samples in a second, expected at least {SLOWEST:g}"
        found.doubt(track, f"{said}: too few to show friction or lag", "record faster")
    gaps = int((steps > GAP_PERIODS * period).sum())
    if gaps and not sparse:
        worst = int(np.argmax(steps))
        found.notes.append(
            f"{what}: {gaps} gap(s) longer than {GAP_PERIODS:g} periods of {period:.3g} s, "
            f"the longest {steps[worst]:.3g} s before {track.where(worst + 1)}"
        )
    return track


GEAR_REMEDY = "give gear, sign and zero of each joint: --map JOINT=THEIRS/RATIO+OFFSET"
_MISREAD = {
    "degrees were read as radians": 180.0 / np.pi,
    "radians were read as degrees": np.pi / 180.0,
    "turns were read as radians": 0.5 / np.pi,
    "turns were read as degrees": np.pi / 180.0 * 0.5 / np.pi,
}
"""Factor of an encoder's step"""


def check_units(motion: RecordedMotion, arm: Arm, options: ImportOptions, found: LogFindings) -> None:
    """Check the declared unit of angles."""
    state, unit = motion.state, motion.angle_unit
    extent = float(np.rad2deg(np.abs(state.value).max()))
    gear = max(float((np.ptp(state.value, axis=0) / (arm.upper - arm.lower)).max()), 1.0)
    motors = f"angles of the motors, before a gear of {gear:.2g} or more"
    if unit == "deg" and (bits := turn_bits(np.rad2deg(state.value))):
        said = f"state: the values come in steps of 2 pi / {2**bits}: they are radians, not degrees"
        found.doubt(state, f"{said}; up to {extent:.4g} rad are angles of the motors, before their gear", GEAR_REMEDY)
    for track in motion.tracks:
        far = np.abs(track.value)
        if (far <= TWO_TURNS).all():
            continue
        row, joint = np.unravel_index(int(np.argmax(far)), far.shape)
        bits = turn_bits(track.value) if unit == "rad" else None
        cause = f"degrees, or {motors}" if bits is None else f"{motors}, for they come in steps of 2 pi / {2**bits}"
        raise FileError(
            track.path,
            f"{track.what}, {track.where(int(row))}: {track.columns[joint]} is {track.value[row, joint]:.4g} rad, "
            f"beyond two turns; the values are {cause if unit == 'rad' else 'in another unit'}",
            f"set --angle-unit, correct the column's name, or {GEAR_REMEDY}" if bits is None else GEAR_REMEDY,
        )
    if unit == "deg" and extent <= 2 * np.pi:
        found.doubt(
            state,
            f"state: no angle is beyond {extent:.3g} deg; the values are surely radians",
            "set --angle-unit rad, or correct the column's name where that says a unit",
        )
    # no other program normalises, and other encoders have other steps
    lerobot = motion.extra.get("format") == "lerobot"
    if options.angle_unit in ("deg", "normalised") and (lerobot or options.calibration is not None):
        _check_declared(motion, options.angle_unit, found, lerobot=lerobot)
    if motion.half is None:  # else its steps are those of the calibration
        _check_steps(state, arm, found)


def _check_declared(motion: RecordedMotion, declared: str, found: LogFindings, *, lerobot: bool) -> None:
    state = motion.state
    raw = np.rad2deg(state.value) if motion.half is None else state.value / motion.half * 100.0
    kind, why = unit_by_steps(raw)
    if kind is None and lerobot and np.abs(raw).max() <= 101.0:
        found.notes.append("nothing in the file tells degrees from normalised values: compare with what the arm did")
    if kind not in (None, declared):
        said = {"deg": "degrees", "normalised": "normalised values (-100 to 100)"}[str(kind)]
        remedy = f"set --angle-unit {kind}" + " with --calibration" * (kind == "normalised")
        found.doubt(state, f"the states are {said}, but --angle-unit says {declared}: {why}", remedy)


def _check_steps(state: Track, arm: Arm, found: LogFindings) -> None:
    for title, column in zip(state.columns, state.value.T, strict=True):
        values = np.unique(np.round(column, 9))
        if len(values) < FEWEST_VALUES or on_grid(values, arm.encoder_step) > OFF:
            continue
        # Readings whose zero was moved are on no grid of one zero, yet on any much finer one: it must be used as well.
        for misread, factor in _MISREAD.items():
            step = arm.encoder_step * factor
            if on_grid(values, step) > ON and np.percentile(np.diff(values), 10) < FEWEST_STEPS * step:
                said = f"the states of {title} come in steps of {step:.3g} rad, where the encoders of this arm have "
                found.doubt(state, f"{said}{arm.encoder_step:.3g}: as if {misread}", "declare their unit")


SPIKE = 0.05
"""[rad] of a reading off its neighbours"""
SPIKED = 0.2
"""largest share of such readings"""
SHARPEST = 400.0
"""[rad/s^2] ten times an SO-101's limit"""
TOO_FAST, SPEED_ROWS = 4.0, 5
"""times the servo's speed, over rows"""
FAR_OUT = 0.05
"""share of samples for a doubtful unit or zero"""
LIMIT_MARGIN = 0.35
"""[rad] beyond calibration and zero offsets"""


def check_states(motion: RecordedMotion, arm: Arm, found: LogFindings) -> None:
    """Check angles against limits and speeds of the arm."""
    state = motion.state
    excess = np.maximum(state.value - arm.upper, arm.lower - state.value)
    for joint, name in enumerate(arm.joint_names):
        far, worst = float(np.mean(excess[:, joint] > LIMIT_MARGIN)), float(excess[:, joint].max())
        beyond = f"state: {state.columns[joint]} is beyond the limits of joint {name}"
        if far > FAR_OUT:
            found.doubt(
                state,
                f"{beyond} ({arm.lower[joint]:.3g} to {arm.upper[joint]:.3g} rad) in {100 * far:.0f} % of "
                f"the samples, by up to {worst:.3g} rad",
                "check unit, joint order and zero posture (--angle-unit, --map)",
            )
        if worst > 0:
            found.notes.append(f"{beyond} in {int((excess[:, joint] > 0).sum())} samples, by up to {worst:.3g} rad")
    if len(state) >= SPEED_ROWS:
        _check_motion(state, arm, found)
    if not np.ptp(state.value, axis=0).any():
        found.notes.append("state: no joint moves in this log")


def _check_motion(state: Track, arm: Arm, found: LogFindings) -> None:
    """Find single readings that jump out, steps to elsewhere, and speeds beyond the servos'."""
    value, steps = state.value, np.diff(state.time)[:, None]
    way = np.diff(value, axis=0)
    out = np.abs(way[:-1] - way[1:]) / 2
    single = (out > SPIKE) & (np.abs(value[2:] - value[:-2]) < 0.5 * out)
    if single.any():
        row, joint = _largest(out, single)
        said = (
            f"state: {int(single.sum())} single reading(s) jump out and back, the farthest by {out[row, joint]:.3g} rad"
            f" in {state.where(row + 1)}, {state.columns[joint]}"
        )
        if len(state) > 4 * SPEED_ROWS and single.mean() > SPIKED:
            found.doubt(state, f"{said}: as if the samples of two arms took turns", "give each arm a file of its own")
        found.notes.append(f"{said}; is the file damaged?")
    if len(state) > 4 * SPEED_ROWS:
        over = state.time[SPEED_ROWS:] - state.time[:-SPEED_ROWS]
        usual = np.percentile(np.abs(value[SPEED_ROWS:] - value[:-SPEED_ROWS]) / over[:, None], 90, axis=0)
        joint = int(np.argmax(usual / arm.max_speed))
        if usual[joint] > TOO_FAST * arm.max_speed[joint]:
            found.doubt(
                state,
                f"state: {state.columns[joint]} moves at {usual[joint]:.3g} rad/s and more in a tenth of the log, "
                f"joint {arm.joint_names[joint]} at up to {arm.max_speed[joint]:.3g}",
                _TIME_REMEDY,
            )
    far, steps = np.abs(way), np.maximum(steps, float(np.median(steps)))[1:-1]
    jumped = far[1:-1] > SPIKE + 0.25 * SHARPEST * steps**2 + 3.0 * np.maximum(far[:-2], far[2:])
    jumped &= far[:-2].any(axis=1, keepdims=True)  # readings that stood still catch up with the arm
    if jumped.any():
        row, joint = _largest(far[1:-1], jumped)
        found.doubt(
            state,
            f"state: {int(jumped.any(axis=1).sum())} time(s) joints are elsewhere in the next sample, farthest "
            f"{state.columns[joint]} by {way[row + 1, joint]:.3g} rad in {steps[row, 0]:.3g} s at "
            f"{state.where(row + 2)}: no joint moves so",
            "cut the file there, or mend the values",
        )


def _largest(size: Array, chosen: NDArray[np.bool_]) -> tuple[int, int]:
    row, joint = np.unravel_index(int(np.argmax(np.where(chosen, size, 0.0))), size.shape)
    return int(row), int(joint)


FAR = 0.1
"""[rad] command travel for duplicates"""
RELATED = (0.3, 0.9)
"""correlations: unrelated, and related"""
MUCH_BETTER = (0.95, 5.0)
"""of exchanged joints: correlation, and how much closer to 1"""
SAME = 1e-5
"""[rad] rounding of a copied number"""
COPIED = 0.9
"""share of copied rows of a copied joint"""
FEWEST_MOVING = 20
"""Moving rows"""
GAIN = 10.0
"""travel over command of another unit (a real arm's friction: 0.75)"""
LEFT = 0.3
"""[rad] from a constant command (a table pushes a real elbow by 0.2)"""
FOLLOWED = 0.7
"""Travel over the command's"""
APART = 0.5
"""[rad] median following error beyond any sag"""


def check_agreement(state: Track, command: Array, found: LogFindings) -> None:
    """Check states against the commands ``(T, n)`` [rad] in force.

    FileError for exchanged joints; doubts for duplicates, implausible lags and scales.
    """
    lowest, highest = correlations(state.time, state.value, command)
    error = state.value - command
    _check_copies(state, command, found)
    for joint, name in enumerate(state.columns):
        own, best = highest[joint, joint], int(np.argmax(highest[joint]))
        other = highest[joint, best]
        better = best != joint and other > MUCH_BETTER[0] and 1 - own > MUCH_BETTER[1] * (1 - other)
        if (own < RELATED[0] and other > RELATED[1]) or better:
            raise FileError(
                state.path,
                f"the state of {name} follows the command of {state.columns[best]} (correlation {other:.2f}), not its "
                f"own ({own:.2f})",
                "give the true joint order of states and commands",
            )
        if own < RELATED[0] and lowest[joint, joint] < -RELATED[1]:
            found.notes.append(
                f"state: {name} moves against its command (correlation {lowest[joint, joint]:.2f}); "
                "is its axis turned around?"
            )
        asked, far = command[:, joint], np.abs(error[:, joint])
        left = float((far - np.minimum.accumulate(far)).max())
        if left > LEFT and not np.ptp(asked):
            found.doubt(
                state,
                f"the command of {name} never changes, yet it moves away from it by {left:.3g} rad: not this command "
                "moved the arm",
                "give what was sent, or leave the columns of the commands out",
            )
        if len(state) < FEWEST_MOVING:
            continue
        gain = float(np.std(state.value[:, joint]) / np.maximum(np.std(asked), 1e-9))
        if own > RELATED[1] and not 1 / GAIN < gain < GAIN:
            said = f"{name} moves {gain:.3g} times as far as its command: not one unit"
            found.doubt(state, said, "give states and commands in one unit")
        low, apart, high = np.percentile(error[:, joint], (10, 50, 90))
        if abs(apart) > APART:
            said = f"{name} is {np.rad2deg(apart):.0f} deg from its command (median)"
            if high - low < abs(apart) / 2 and gain > FOLLOWED:
                found.doubt(state, said, "check unit, joint order and zero of states and commands")
            found.notes.append(f"state: {said}: a weak servo, or another zero")
    _check_lag(state, command, found)


def _check_copies(state: Track, command: Array, found: LogFindings) -> None:
    reach = int(np.clip(round(PLAUSIBLE[1] / float(np.median(np.diff(state.time)))), 1, 50))
    reach = min(reach, len(state) // 2)
    changing = np.abs(np.diff(command, axis=0, prepend=command[:1])) > SAME
    changing &= np.ptp(command, axis=0) > FAR  # a good arm follows a hair's breadth exactly
    for lag in sorted(range(-reach, reach + 1), key=abs):
        later, sooner = (slice(max(one, 0), len(state) + min(one, 0)) for one in (lag, -lag))
        moving = changing[sooner]
        same = moving & (np.abs(command[sooner] - state.value[later]) <= SAME)
        copied = (same.sum(axis=0) > COPIED * moving.sum(axis=0)) & (moving.sum(axis=0) >= FEWEST_MOVING)
        if copied.any():
            names = [name for name, one in zip(state.columns, copied, strict=True) if one]
            when = f"{abs(lag)} row(s) {'later' if lag > 0 else 'earlier'}" if lag else "in the same row"
            found.doubt(
                state,
                f"the states of {'all joints' if copied.all() else ', '.join(names)} are copies of the commands, "
                f"{when}: such a log shows no arm",
                "record what the encoders say and what was sent",
            )
            return


def _check_lag(state: Track, command: Array, found: LogFindings) -> None:
    lag = find_lag(state.time, state.value, command)
    if lag is None:
        if state.time[-1] - state.time[0] >= SHORTEST:
            found.notes.append("state: nothing moves fast enough to tell whether states and commands have one clock")
    elif not lag.plausible:
        at = f"{abs(lag.best):.2g} s {'before' if lag.best < 0 else 'after'}"
        at += " or more" * (abs(lag.best) > SEARCHED - 0.06)
        said = f"best {at} them, expected {PLAUSIBLE[0]:g} to {PLAUSIBLE[1]:g} s after"
        if not lag.sure:
            shows = "this motion does not tell surely whether the clocks differ"
            found.notes.append(f"state: follows its commands {said}; {shows}")
            return
        cause = "commands are goals that something else moves to, or the clocks differ"
        if lag.best < 0:
            cause = "states are stamped before their commands or on another clock, or both are exchanged"
        remedy = "record both with the stamps of one clock"
        found.doubt(state, f"the states follow their commands {said}: {cause}", remedy)
