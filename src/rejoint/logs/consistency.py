"""Consistency checks of logs.

Impossible numbers are errors, unlikely ones doubts, others notes. Thresholds are chosen.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import compress
from typing import NamedTuple, TypeAlias

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.logs.columns import FEWEST, NORMALISED_MOST, ZEROS, RecordedMotion, turn_bits, unit_by_steps
from rejoint.logs.exclusions import correlations
from rejoint.logs.joints import ImportOptions
from rejoint.logs.runlog import TWO_TURNS, RunLog
from rejoint.system.errors import FileError, InputError
from rejoint.system.numbers import interpolated

PLAUSIBLE = (0.0, 0.3)
"""[s] (a low-cost arm: 0.06 to 0.16 s)"""
SEARCHED = 1.0
"""[s] to both sides; without other commands around a step"""
FARTHEST = 10.0
"""[s] likewise, by velocities"""
SHORTEST = 4.0
"""[s] of a log with a lag"""

_ROWS_MOST = 1_000_000
"""Looked at: some hours show as much as a day"""
_WINDOW = 0.2
"""[s] of a velocity: hides encoder steps"""
_GRID = (0.01, 0.05)
"""[s] finest and coarsest step"""
_MOVING, _CHANGING = 0.005, 0.3
"""[rad/s] least change of a command's speed, and over its mean: a ramp shows no lag"""
_SURE = 1.05, 1.5
"""Unexplained part at the best plausible lag over the best of all, at an end of the plausible range, and inside it (44
motions of a real arm: 1.00, and up to 1.10)"""
_OVERLAP = 0.5
"""Least share of motion in the overlap"""
_UNLIKE = 0.5
"""Unexplained part of a usable lag"""
_EXACT = 1e-3
"""Unexplained part of a lag that explains all (a real cobot: 0.00008 at 0 s, 0.00005 at -0.04 s)"""
_JUMP = np.radians(2.0)
"""[rad] of a command's step in one row"""
_BEGUN = 0.05
"""Travel share of a moving joint: above encoder noise"""
_FEWEST_STEPS = 3


class Lag(NamedTuple):
    """Lag of states behind commands."""

    best: float
    """[s] negative: states come first"""
    sure: bool
    """False: a plausible lag explains as well"""

    @property
    def plausible(self) -> bool:
        """Whether such a lag is usual."""
        return PLAUSIBLE[0] <= self.best <= PLAUSIBLE[1]


def find_lag(time: Array, position: Array, command: Array) -> Lag | None:
    """Lag of positions (T, n) [rad] behind commands at ``time`` (T,) [s]; None: too short or no motion."""
    if len(time) < 10 or time[-1] - time[0] < SHORTEST:
        return None
    period = np.median(np.diff(time))
    step = float(np.clip(period, *_GRID))
    even = np.arange(time[0], time[-1], step)[:_ROWS_MOST]
    held = command[np.searchsorted(time, even, side="right") - 1]
    moved = interpolated(even, time, position)
    speeds = _of_velocities(moved, held, step, period)
    doubted = speeds is not None and speeds.plausible  # an answer to the step before may have been taken for this one's
    return _of_steps(moved, held, step, doubted) or speeds


def _of_velocities(moved: Array, held: Array, step: float, period: float) -> Lag | None:
    """Lag by what the command's velocity leaves unexplained of the joints', at each lag."""
    from scipy.signal import fftconvolve  # here, since it takes a second to load

    width = max(round(max(_WINDOW, 4 * period) / step), 2)
    speed, asked = ((one[width:] - one[:-width]) / (width * step) for one in (moved, held))
    joints = np.std(asked, axis=0) > np.maximum(_CHANGING * np.abs(np.mean(asked, axis=0)), _MOVING)
    speed, asked, ones = speed[:, joints], asked[:, joints], np.ones((len(speed), joints.sum()))
    if not speed.any():
        return None
    reach = min(round(FARTHEST / step), len(speed) // 2)
    later, sooner = np.stack([speed, speed**2, ones]), np.stack([asked, ones, asked**2])
    sums = fftconvolve(later, sooner[:, ::-1], axes=1)[:, len(speed) - 1 - reach : len(speed) + reach]
    power, whole = sums[1:], sums[1:, reach]
    follows = np.maximum(sums[0], 0.0) ** 2 / np.maximum(power.prod(axis=0), 1e-12)
    # where motion is shifted out of the log, nothing is left to compare
    follows[(power <= _OVERLAP * whole[:, None]).any(axis=0)] = 0.0
    unexplained = (1.0 - follows) @ whole[0] / whole[0].sum()
    lags, tolerance = step * np.arange(-reach, reach + 1.0), max(step, 0.5 * period) + 1e-9
    usual = np.clip(lags, *PLAUSIBLE)
    near = np.flatnonzero(np.abs(lags - usual) < tolerance)
    inside = near[np.argmin(unexplained[near])]
    if not unexplained.min() < _UNLIKE <= unexplained[inside]:  # motion that repeats resembles its other rounds, too
        unexplained[np.abs(lags) > SEARCHED] = 1.0
    best, share = np.argmin(unexplained), unexplained + _EXACT
    if best in near:
        return Lag(float(usual[best]), sure=True)
    surely = share[inside] > share[best] * _SURE[inside not in (near[0], near[-1])]
    return Lag(float(lags[best]), sure=bool(surely and unexplained[best] < _UNLIKE))


def _of_steps(moved: Array, held: Array, step: float, doubted: bool) -> Lag | None:
    """Lag by lone steps of commands, `_FEWEST_STEPS` where it is ``doubted``."""
    reach, shares = round(SEARCHED / step), []
    for way, asked in zip(moved.T, held.T, strict=True):
        change = np.diff(asked)
        changes = np.flatnonzero(change) + 1
        gaps = np.diff(changes, prepend=0, append=len(held) - 1)
        alone = (gaps[:-1] >= (1 + doubted) * reach) & (gaps[1:] >= reach)
        for at in changes[alone & (np.abs(change[changes - 1]) > _JUMP)]:
            near = way[at - reach : at + reach + 1] - way[at - reach]
            if abs(near[-1]) > _JUMP:
                shares.append(near / near[-1])
    if len(shares) < (_FEWEST_STEPS if doubted else 1):
        return None
    best = step * (int(np.argmax(np.median(shares, axis=0) > _BEGUN)) - reach)
    sure = len(shares) >= _FEWEST_STEPS and not PLAUSIBLE[0] - step < best < PLAUSIBLE[1] + step
    return Lag(best=best, sure=sure)


FORCED, BETWEEN = "forced", " | "
"""Key in ``extra`` of overridden reasons, and what parts them"""


Remark: TypeAlias = tuple[str, str]
"""A doubt about a log and its remedy; or a note, without one"""


def kept_remarks(log: RunLog) -> list[str]:
    """Return what the import kept in a log."""
    forced = [f"imported by force, although {one}" for one in log.extra.get(FORCED, "").split(BETWEEN) if one]
    return [*filter(None, [log.extra.get(ZEROS)]), *forced]


def remarks_on(logs: Sequence[RunLog]) -> list[str]:
    """Kept remarks with their logs' names."""
    found: dict[str, list[str]] = {}
    for log in logs:
        for remark in kept_remarks(log):
            found.setdefault(remark, []).append(log.label)
    return [
        f"{labels[0]}{f' and {len(labels) - 1} more' * (len(labels) > 1)}: {remark}" for remark, labels in found.items()
    ]


def states_alone(logs: Sequence[RunLog], what: str) -> bool:
    """Whether no log holds commands; InputError if some do."""
    bare = [log.label for log in logs if not log.commanded]
    if bare and len(bare) < len(logs):
        raise InputError(
            f"{what}: {len(bare)} of {len(logs)} logs hold no commands ({bare[0]}{', ...' * (len(bare) > 1)}); put "
            "them into a folder of their own"
        )
    return bool(bare)


def require_commands(logs: Sequence[RunLog], what: str) -> None:
    """Raise InputError for logs without commands."""
    if states_alone(logs, what):
        raise InputError(
            f"{what}: these logs hold no commands, and without them stiffness, friction, lag and zeros cannot be told; "
            "record what is sent as well"
        )


def copies(logs: Iterable[tuple[str, RunLog]]) -> dict[str, str]:
    """Return logs that repeat an earlier one, with its name."""
    first: dict[bytes, str] = {}
    moving = ((name, log) for name, log in logs if np.ptp(log.position, axis=0).any())
    keys = {name: np.concatenate([log.position, log.command]).tobytes() for name, log in moving}
    return {name: first[key] for name, key in keys.items() if first.setdefault(key, name) != name}


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
_TIME_REMEDY = "set the time unit (--time-unit, or the column's name where that says one), or take another file"


def clean(motion: RecordedMotion) -> tuple[RecordedMotion, list[Remark]]:
    """Check the clock; returns the motion without doubled stamps, and remarks. FileError."""
    steps, rows, found = np.diff(motion.time), len(motion), []
    if not (steps >= 0).all():
        late = int(np.argmin(steps >= 0)) + 1
        raise FileError(
            motion.path,
            f"state, {motion.where(late)}: the clock goes back by {-steps[late - 1]:.6g} s",
            "cut the file where the clock was set, or in a bag take the times of recording (--stamp log)",
        )
    fresh = np.append(True, steps > 0)[:rows]
    other = np.any(np.diff(motion.position, axis=0), axis=1)
    gone, lost, steps = (other & ~fresh[1:]).sum(), (~fresh).sum(), steps[steps > 0]
    if rows - lost < FEWEST:
        raise FileError(
            motion.path,
            f"state: {rows - lost} sample(s), a log needs at least {FEWEST} with stamps of their own",
            _TIME_REMEDY,
        )
    period = np.median(steps)
    if not RATES[0] <= 1.0 / period <= RATES[1]:
        raise FileError(
            motion.path, f"state: one sample in {period:.3g} s, expected {RATES[0]:g} to {RATES[1]:g} Hz", _TIME_REMEDY
        )
    if period * 0.99 * SLOWEST > 1.0:
        said = f"state: {1 / period:.2g} samples in a second, expected at least {SLOWEST:g}"
        found.append((f"{said}: too few to show friction or lag", "record faster"))
    if gone > LOST * rows:
        said = f"state: {gone} of {rows} samples have the stamp of the one before and are lost"
        found.append((said, "record finer stamps"))
    if lost:
        said = f"state: {lost} samples with a doubled stamp left out, first at {motion.where(int(np.argmin(fresh)))}"
        found.append((said, ""))
        motion = motion.take(fresh)
    return motion, found


GEAR_REMEDY = "give gear, sign and zero of each joint: --map JOINT=THEIRS/RATIO+OFFSET"


def check_units(motion: RecordedMotion, arm: Arm, options: ImportOptions) -> Iterator[Remark]:
    """Check the declared unit of angles; FileError."""
    angles, unit = motion.position, motion.angle_unit
    extent, read = np.rad2deg(np.abs(angles).max()), np.rad2deg(angles)
    wide = (np.ptp(read, axis=0) - arm.upper + arm.lower).max() > 2 * LIMIT_MARGIN  # as radians
    if unit == "deg" and extent <= 2 * np.pi and not (wide or turn_bits(angles)):
        said = f"state: no angle is beyond {extent:.3g} deg; the values may be radians"
        yield said, "set --angle-unit rad, or correct the column's name where that says a unit"
    elif unit == "deg" and (bits := turn_bits(read)):
        said = f"state: the values come in steps of 2 pi / {2**bits}: they are radians, not degrees"
        yield f"{said}; up to {extent:.4g} rad are angles of the motors, before their gear", GEAR_REMEDY
    for what, values in motion.angles.items():
        size = np.abs(values) * ~arm.endless
        row, joint = _largest(size)
        if size[row, joint] <= TWO_TURNS:
            continue
        gear = max((np.ptp(values, axis=0) * ~arm.endless / (arm.upper - arm.lower)).max(), 1.0)
        cause = f"degrees, or angles of the motors, before a gear of {gear:.2g} or more"
        raise FileError(
            motion.path,
            f"{what}, {motion.where(row)}: {arm.joint_names[joint]} is {values[row, joint]:.4g} rad, "
            f"beyond two turns; the values are {cause if unit == 'rad' else 'in another unit'}",
            f"set --angle-unit, correct the column's name, or {GEAR_REMEDY}",
        )
    # no other program normalises, and other encoders have other steps
    lerobot, declared = motion.extra.get("format") == "lerobot", options.angle_unit
    if declared in ("deg", "normalised") and (options.calibration is not None or lerobot):
        raw = read if motion.half is None else angles / motion.half * 100.0
        kind, why = unit_by_steps(raw)
        if kind is None and lerobot and np.abs(raw).max() <= NORMALISED_MOST:
            yield "nothing in the file tells degrees from normalised values: compare with what the arm did", ""
        if kind not in (None, declared):
            yield f"the states are {kind}, but --angle-unit says {declared}: {why}", f"set --angle-unit {kind}"


SPIKE = 0.05
"""[rad] of a reading off its neighbours"""
SPIKED = 0.2
"""largest share of such readings"""
MISREAD = 16
"""rows in which a bus may fail"""
SHARPEST = 400.0
"""[rad/s^2] ten times an SO-101's limit"""
TOO_FAST, SPEED_ROWS = 30.0, 5
"""times the servo's speed, over rows"""
WRAP = 1.0
"""[rad] of a step that the end of a turn may hide"""
FAR_OUT = 0.05
"""share of samples for a doubtful unit or zero"""
LIMIT_MARGIN = 0.35
"""[rad] beyond calibration and zero offsets"""


def without_spikes(motion: RecordedMotion) -> tuple[RecordedMotion, list[Remark]]:
    """Leave out readings that no joint could reach and leave; remarks say so, or doubt all."""
    value, took, far, turns = motion.position, np.diff(motion.time)[:, None], np.zeros(len(motion)), 0.0
    step = np.abs(np.diff(value, axis=0))
    changes = [motion.time[1:][one > 0.0] for one in step.T]  # slower than rows where readings are repeated
    fresh = [np.median(np.diff(one)) if len(one) > 2 else 0.0 for one in changes]
    most = SPIKE + SHARPEST / 4 * np.maximum(took, fresh) ** 2
    around = np.pad(step, ((1, 1), (0, 0)))
    alone = (step > most) & (np.maximum(around[2:], around[:-2]) < 0.5 * step)  # no swift motion
    for count in range(1, min(MISREAD, len(step) - 1) + 1):
        out = np.minimum(step[:-count], step[count:])
        back = np.abs(value[count + 1 :] - value[: -count - 1]) < 0.5 * out
        if count == 1:
            turns = (back & (out > SPIKE)).mean()
        back &= (out > np.minimum(most[:-1], most[1:])) if count == 1 else alone[:-count] & alone[count:]
        size = (out * back).max(axis=1)
        for row in range(1, count + 1):
            np.maximum(far[row : row + len(size)], size, out=far[row : row + len(size)])
    rows, row, said = far > 0.0, int(far.argmax()), "joints jump out and back"
    if rows.any():
        joint = motion.columns[step[row - 1].argmax()]
        said += f", by up to {far[row]:.3g} rad, in {motion.where(row)}, {joint}"
    if len(motion) > 4 * SPEED_ROWS and (rows.mean() > LOST or turns > SPIKED):
        said = f"state: in {100 * max(rows.mean(), turns):.0f} % of the samples {said}: as if two arms took turns"
        return motion, [(said, "give each arm a file of its own, or mend the values")]
    if not rows.any():
        return motion, []
    return motion.take(~rows), [(f"state: {rows.sum()} sample(s) left out, where {said}", "")]


def unwrapped(motion: RecordedMotion, arm: Arm) -> tuple[RecordedMotion, list[Remark]]:
    """Join angles that pass the end of a turn, and shift those that a turn brings within limits; so their commands."""
    wraps = (np.abs(np.abs(np.diff(motion.position, axis=0)) - 2 * np.pi) < WRAP).any(axis=0)
    position, command = np.where(wraps, np.unwrap(motion.position, axis=0), motion.position), motion.command
    turns = np.zeros(arm.joints)
    for turn in (2 * np.pi, -2 * np.pi):
        gained = _within(arm, position + turn) - _within(arm, position)
        turns = np.where(~arm.endless & (gained > 1.0 - FAR_OUT), turn, turns)
    position, wraps = position + turns, wraps | (turns != 0.0)
    if not wraps.any():
        return motion, []
    if command is not None:
        changes = np.diff(command, axis=0, append=np.inf) != 0
        rows = np.where(changes, np.arange(len(command))[:, None], len(command))
        last = np.minimum.accumulate(rows[::-1], axis=0)[::-1]
        turns = np.round((np.take_along_axis(position, last, axis=0) - command) / (2 * np.pi))
        motion = replace(motion, command=command + 2 * np.pi * np.where(wraps, turns, 0.0))
    said = f"state: {', '.join(compress(motion.columns, wraps))}: joined at the ends of turns, or turned into limits"
    return replace(motion, position=position), [(said, "")]


def _within(arm: Arm, position: Array) -> Array:
    """Share (n,) of positions (T, n) [rad] within the limits, with their margin."""
    inside = (position > arm.lower - LIMIT_MARGIN) & (position < arm.upper + LIMIT_MARGIN)
    return inside.mean(axis=0)


def check_states(motion: RecordedMotion, arm: Arm) -> Iterator[Remark]:
    """Check angles against limits and speeds of the arm."""
    for what, values in motion.angles.items():
        excess = np.maximum(values - arm.upper, arm.lower - values) * ~arm.endless
        far, worst = (excess > LIMIT_MARGIN).mean(axis=0), excess.max(axis=0)
        for joint in np.flatnonzero(worst > 0):
            said = (
                f"{what}: {motion.columns[joint]} is beyond the limits of joint {arm.joint_names[joint]} "
                f"({arm.lower[joint]:.3g} to {arm.upper[joint]:.3g} rad) in "
                f"{100 * (excess[:, joint] > 0).mean():.3g} % of the samples, by up to {worst[joint]:.3g} rad"
            )
            remedy = f"check unit, joint order and zero posture (--angle-unit), or {GEAR_REMEDY}"
            yield said, remedy if what == "state" and far[joint] > FAR_OUT else ""
    if len(motion) >= SPEED_ROWS:
        yield from _check_motion(motion, arm)


def _check_motion(motion: RecordedMotion, arm: Arm) -> Iterator[Remark]:
    value, time = motion.position, motion.time[:, None]
    way, steps = np.diff(value, axis=0), np.diff(time, axis=0)
    if len(motion) > 4 * SPEED_ROWS:
        speed = np.abs(value[SPEED_ROWS:] - value[:-SPEED_ROWS]) / (time[SPEED_ROWS:] - time[:-SPEED_ROWS])
        usual = np.percentile(speed, 90, axis=0)
        joint = int(np.argmax(usual / arm.max_speed))
        if usual[joint] > TOO_FAST * arm.max_speed[joint]:
            yield (
                f"state: {motion.columns[joint]} moves at {usual[joint]:.3g} rad/s and more in a tenth of the log, "
                f"joint {arm.joint_names[joint]} at up to {arm.max_speed[joint]:.3g}",
                f"give the arm's speeds in its file, if these are not its own; else {_TIME_REMEDY}",
            )
    far, steps = np.abs(way), np.maximum(steps, np.median(steps))
    speed, took = far / steps, np.maximum(steps[:-2], steps[1:-1])  # a late stamp lengthens the step before
    jumped = far[1:-1] > SPIKE + (0.25 * SHARPEST * took + 3.0 * np.maximum(speed[:-2], speed[2:])) * took
    jumped &= far[:-2].any(axis=1, keepdims=True)  # readings that stood still catch up with the arm
    if jumped.any():
        row, joint = _largest(far[1:-1] * jumped)
        yield (
            f"state: {jumped.any(axis=1).sum()} time(s) joints are elsewhere in the next sample, farthest "
            f"{motion.columns[joint]} by {way[row + 1, joint]:.3g} rad in {took[row, 0]:.3g} s at "
            f"{motion.where(row + 2)}: no joint moves so",
            "cut the file there, or mend the values",
        )


def _largest(size: Array) -> tuple[int, int]:
    row, joint = np.unravel_index(np.argmax(size), size.shape)
    return int(row), int(joint)


FAR = 0.1
"""[rad] travel for duplicates and exchanged joints"""
RELATED = (0.3, 0.9)
"""correlations: unrelated, and related"""
MUCH_BETTER = (0.95, 5.0)
"""of exchanged or turned joints: correlation; and how much closer to 1"""
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
SCATTERED = 5.0
"""Scatter in such an error"""


def check_agreement(motion: RecordedMotion, off: Sequence[int]) -> Iterator[Remark]:
    """Check states against the commands in force, but those of joints that are ``off``.

    Exchanged joints, duplicates, implausible lags and scales.
    """
    state, command = motion.position, np.asarray(motion.command)
    yield from _check_copies(motion, command)
    lowest, highest = correlations(motion.time, state, command)
    far = np.minimum.outer(np.ptp(state, axis=0), np.ptp(command, axis=0)) > FAR / 2
    on = [joint for joint in range(state.shape[1]) if joint not in off]
    for joint in on:
        name, own, best = motion.columns[joint], highest[joint, joint], np.argmax(highest[joint])
        other = highest[joint, best]
        better = other > MUCH_BETTER[0] and 1 - own > MUCH_BETTER[1] * (1 - other)
        # whose own state follows its command as well stays where it is
        if ((own < RELATED[0] and other > RELATED[1]) or better) and highest[best, best] < other and far[joint, best]:
            yield (
                f"the state of {name} follows the command of {motion.columns[best]} (correlation {other:.2f}), not its "
                f"own ({own:.2f})",
                "give the true joint order of states and commands",
            )
    lag = find_lag(motion.time, state, command)
    if lag and not lag.plausible:
        yield (
            f"the states follow their commands best after {lag.best:.2g} s, expected {PLAUSIBLE[0]:g} to "
            f"{PLAUSIBLE[1]:g}: perhaps clocks differ, both are exchanged, the controller feeds speed forward, or "
            "commands are goals that something else moves to",
            "record both with the stamps of one clock" if lag.sure else "",
        )
        if lag.sure:
            return  # what follows compares the two
    late = np.searchsorted(motion.time, motion.time - (lag.best if lag and lag.plausible else 0.0), side="right") - 1
    error = state - command[np.maximum(late, 0)]
    gains = np.std(state, axis=0) / np.maximum(np.std(command, axis=0), 1e-9)
    for joint in on:
        name, own = motion.columns[joint], highest[joint, joint]
        if own < RELATED[0] and lowest[joint, joint] < -RELATED[1]:
            said = f"state: {name} moves against its command (correlation {lowest[joint, joint]:.2f})"
            remedy = GEAR_REMEDY if lowest[joint, joint] < -MUCH_BETTER[0] else ""
            yield f"{said}, as if its axis were turned around", remedy
        left = np.abs(error[:, joint])
        left -= np.minimum.accumulate(left)
        if left.max() > LEFT and not np.ptp(command[:, joint]):
            said = f"the command of {name} never changes, yet it moves away from it by {left.max():.3g} rad"
            remedy = "give what was sent, or leave the columns of the commands out"
            yield f"{said}: not this command moved the arm", remedy
        if len(motion) < FEWEST_MOVING:
            continue
        gain = gains[joint]
        if own > RELATED[1] and not 1 / GAIN < gain < GAIN:
            said = f"{name} moves {gain:.3g} times as far as its command: not one unit"
            yield said, "give states and commands in one unit"
        apart, scattered = np.median(error[:, joint]), np.std(state[:, joint]) * np.sqrt(max(1.0 - own**2, 0.0))
        if abs(apart) > APART / 2:
            said = f"{name} is {np.rad2deg(apart):.0f} deg from its command (median): a weak servo, or another zero"
            everywhere = abs(apart) > APART and SCATTERED * scattered < abs(apart) and gain > FOLLOWED
            remedy = "check unit, joint order and zero of states and commands (--map JOINT=THEIRS+OFFSET)"
            yield said, remedy if everywhere else ""


def _check_copies(motion: RecordedMotion, command: Array) -> Iterator[Remark]:
    rows = len(motion)
    reach = min(int(np.clip(round(PLAUSIBLE[1] / np.median(np.diff(motion.time))), 1, 50)), rows // 2)
    changing = np.abs(np.diff(command, axis=0, prepend=command[:1])) > SAME
    changing &= np.ptp(command, axis=0) > FAR  # a good arm follows a hair's breadth exactly
    for lag in sorted(range(-reach, reach + 1), key=abs):
        later, sooner = (slice(max(one, 0), rows + min(one, 0)) for one in (lag, -lag))
        moving = changing[sooner]
        same = moving & (np.abs(command[sooner] - motion.position[later]) <= SAME)
        copied = (same.sum(axis=0) > COPIED * moving.sum(axis=0)) & (moving.sum(axis=0) >= FEWEST_MOVING)
        if copied.any():
            names = ", ".join(np.array(motion.columns)[copied])
            said = f"the states of {names} are copies of the commands, {lag} row(s) later: such a log shows no arm"
            yield said, "record what the encoders say and what was sent"
            return
