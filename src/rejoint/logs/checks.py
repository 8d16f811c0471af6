"""What must hold for a track of samples before anybody fits a model to it.

An error is raised where the numbers cannot be what they are said to be, by `Doubts` where they hardly can be; a
note is returned where they can, but the user should know. Every threshold is chosen, none is a property of a robot.
"""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm
from rejoint.logs.doubts import Doubts
from rejoint.logs.runlog import TWO_TURNS
from rejoint.logs.track import RecordedMotion, Track
from rejoint.system.errors import FileError

RATES = (1.0, 10_000.0)
"""[Hz] chosen: slower is no log of a moving arm, faster no control loop."""
SLOWEST = 10.0
"""[Hz] chosen: below it a reversal of a hobby arm, half a second, has too few samples to show friction or lag."""
LOST = 0.05
"""chosen: share of samples with the stamp of the one before from which the clock counts as too coarse."""
SPIKE = 0.05
"""[rad] chosen: of a single reading off the line between its neighbours; a hobby arm at its fastest has half of it
where it reverses within 20 ms."""
SPIKED = 0.2
"""chosen: share of the readings that jump out and back from which they are no damaged digits, but two arms in one."""
SHARPEST = 400.0
"""[rad/s^2] chosen: acceleration that no joint has, ten times the largest that a servo of an SO-101 can be set to."""
TOO_FAST, SPEED_ROWS = 4.0, 5
"""chosen: how much faster than its servo a joint may seem, over that many rows."""
LEAP = 5.0
"""[encoder steps] chosen: by which a joint moves on after rows that repeat each other, where a slow one makes one."""
FAR_OUT = 0.05
"""chosen: share of samples beyond a limit by more than `LIMIT_MARGIN` from which unit or zero are doubted."""
GAP_PERIODS = 5.0
"""chosen: steps of more median periods than this count as gaps."""
LIMIT_MARGIN = 0.35
"""[rad] chosen: about 20 deg; calibration and zero offsets explain less."""
_OR_LOG = ", or take the times of recording (--stamp log)"
_TIME_REMEDY = "set the time unit (--time-unit, or the column's name where that says one), or take another file"


def clean(track: Track, doubts: Doubts) -> tuple[Track, list[str]]:
    """Check numbers and clock of a track; returns it without doubled stamps, and notes."""
    _check_finite(track)
    if len(track) < 2:
        raise FileError(track.path, f"{track.what}: {len(track)} sample(s), a log needs at least 2", "record it again")
    steps = np.diff(track.time)
    if (steps < 0).any():
        late = int(np.argmax(steps < 0)) + 1
        raise FileError(
            track.path, f"{track.what}, {track.where(late)}: the clock goes back by {-steps[late - 1]:.6g} s",
            "cut the file where the clock was set" + _OR_LOG * track.place.startswith("topic"),
        )  # fmt: skip
    notes = []
    fresh = np.concatenate([[True], steps > 0])
    lost = int((~fresh).sum())
    if lost:
        if lost > LOST * len(track) and fresh[1:].any():
            doubts.stop(
                track.path, f"{track.what}: the clock counts in steps of {np.median(steps[steps > 0]):.3g} s, and "
                f"{lost} of {len(track)} samples ({100 * lost / len(track):.0f} %) have the stamp of the one before "
                "and are lost", "record finer stamps",
            )  # fmt: skip
        first = track.where(int(np.argmin(fresh)))
        notes.append(f"{track.what}: {lost} samples with a doubled stamp left out, first at {first}")
        track = track.take(fresh)
    return track, notes + _check_rate(track, doubts)


def _check_finite(track: Track) -> None:
    if not np.isfinite(track.time).all():
        row = int(np.argmin(np.isfinite(track.time)))
        raise FileError(track.path, f"{track.what}, {track.where(row)}: the time is not a number", "mend or cut it")
    good = np.isfinite(track.value)
    if not good.all():
        row, joint = (int(i) for i in np.argwhere(~good)[0])
        raise FileError(
            track.path, f"{track.what}, {track.where(row)}: {track.columns[joint]} is {track.value[row, joint]}, "
            f"one of {int((~good).sum())} values that are not finite", "mend the values or cut the rows",
        )  # fmt: skip


def _check_rate(track: Track, doubts: Doubts) -> list[str]:
    if len(track) < 2:
        raise FileError(track.path, f"{track.what}: all samples have the same stamp", _TIME_REMEDY)
    steps = np.diff(track.time)
    period = float(np.median(steps))
    rate = 1.0 / period
    sparse = track.what == "command"  # a command may stand for as long as it likes
    if rate > RATES[1] or (rate < RATES[0] and not sparse):
        raise FileError(
            track.path, f"{track.what}: one sample in {period:.3g} s, expected {RATES[0]:g} to {RATES[1]:g} Hz",
            _TIME_REMEDY,
        )  # fmt: skip
    if sparse:
        return []
    if rate < 0.99 * SLOWEST:
        doubts.stop(
            track.path, f"{track.what}: {rate:.2g} samples in a second, expected at least {SLOWEST:g}: too few to "
            "show friction or lag", "record faster",
        )  # fmt: skip
    gaps = steps > GAP_PERIODS * period
    if not gaps.any():
        return []
    worst = int(np.argmax(steps))
    return [
        f"{track.what}: {int(gaps.sum())} gap(s) longer than {GAP_PERIODS:g} periods of {period:.3g} s, "
        f"the longest {steps[worst]:.3g} s before {track.where(worst + 1)}"
    ]


def check_angles(motion: RecordedMotion, arm: Arm, doubts: Doubts) -> list[str]:
    """Compare the angles with what they are said to be and with the limits of the arm."""
    for track in motion.tracks:
        if (np.abs(track.value) > TWO_TURNS).any():
            row, joint = np.unravel_index(int(np.argmax(np.abs(track.value))), track.value.shape)
            found = float(track.value[row, joint])
            guess = "the values are surely degrees" if motion.angle_unit == "rad" else "the unit is surely wrong"
            raise FileError(
                track.path, f"{track.what}, {track.where(int(row))}: {track.columns[joint]} is {found:.4g} rad, "
                f"beyond two turns; {guess}", "set --angle-unit, or correct the column's name where that says a unit",
            )  # fmt: skip
    notes = _check_limits(motion.state, arm, doubts)
    extent = float(np.abs(motion.state.value).max())
    if motion.angle_unit == "deg" and np.rad2deg(extent) <= 2 * np.pi:
        doubts.stop(
            motion.state.path, f"state: no angle is beyond {np.rad2deg(extent):.3g} deg; the values are surely radians",
            "set --angle-unit rad, or correct the column's name where that says a unit",
        )  # fmt: skip
    notes += _spikes(motion.state, doubts)
    _check_speed(motion.state, arm, doubts)
    _check_jumps(motion.state, doubts)
    _check_renewal(motion.state, arm, doubts)
    if not (np.ptp(motion.state.value, axis=0) > 0).any():
        notes.append("state: no joint moves in this log")
    return notes


def _check_speed(state: Track, arm: Arm, doubts: Doubts) -> None:
    """Compare how fast joints move with what their servos can do: another unit of time shows here."""
    if len(state) < SPEED_ROWS * 4:
        return
    speed = np.abs(state.value[SPEED_ROWS:] - state.value[:-SPEED_ROWS])
    speed /= (state.time[SPEED_ROWS:] - state.time[:-SPEED_ROWS])[:, None]
    usual = np.percentile(speed, 90, axis=0)
    joint = int(np.argmax(usual / arm.max_speed))
    if usual[joint] > TOO_FAST * arm.max_speed[joint]:
        doubts.stop(
            state.path, f"{state.what}: {state.columns[joint]} moves at {usual[joint]:.3g} rad/s and more in a tenth "
            f"of the log, joint {arm.joint_names[joint]} at up to {arm.max_speed[joint]:.3g}", _TIME_REMEDY,
        )  # fmt: skip


def _check_jumps(state: Track, doubts: Doubts) -> None:
    """Look for joints that stand elsewhere from one row to the next, and hardly move before and after."""
    if len(state) < SPEED_ROWS:
        return
    way, steps = np.diff(state.value, axis=0), np.diff(state.time)[:, None]
    far, steps = np.abs(way), np.maximum(steps, float(np.median(steps)))
    around = np.maximum(far[:-2], far[2:])
    fresh = (way[:-2] != 0).any(axis=1, keepdims=True)  # readings that stood still catch up with the arm
    back = np.abs(state.value[3:] - state.value[1:-2]) < 0.5 * far[1:-1]  # such a reading is told on its own
    back |= np.abs(state.value[2:-1] - state.value[:-3]) < 0.5 * far[1:-1]
    found = (far[1:-1] > SPIKE + 0.25 * SHARPEST * steps[1:-1] ** 2 + 3.0 * around) & fresh & ~back
    if not found.any():
        return
    row, joint = (int(i) for i in np.unravel_index(int(np.argmax(np.where(found, far[1:-1], 0.0))), found.shape))
    doubts.stop(
        state.path, f"{state.what}: {int(found.any(axis=1).sum())} time(s) joints are elsewhere in the next sample, "
        f"farthest {state.columns[joint]} by {way[row + 1, joint]:.3g} rad in {steps[row + 1, 0]:.3g} s at "
        f"{state.where(row + 2)}: no joint moves so", "cut the file there, or mend the values",
    )  # fmt: skip


def _check_renewal(state: Track, arm: Arm, doubts: Doubts) -> None:
    """Look for readings that are repeated from row to row and renewed too seldom: rows promise more than there is."""
    change = np.abs(np.diff(state.value, axis=0)).max(axis=1)
    renewed = np.flatnonzero(change > 0)
    if len(renewed) < SPEED_ROWS:
        return
    waited = np.diff(state.time[renewed + 1])
    leap = (change[renewed[1:]] > LEAP * arm.encoder_step) & (np.diff(renewed) > 1)
    travel = change[renewed[1:]]
    if travel[leap].sum() <= 0.5 * travel.sum():
        return
    rate = 1.0 / float(np.median(waited[leap]))
    if rate < 0.99 * SLOWEST:
        doubts.stop(
            state.path, f"{state.what}: the readings are repeated from row to row and renewed only {rate:.2g} times a "
            f"second, expected at least {SLOWEST:g}: too few to show friction or lag", "record faster",
        )  # fmt: skip


def _spikes(state: Track, doubts: Doubts) -> list[str]:
    """Find single readings that jump out and back: damaged digits, or a bus that was misread."""
    if len(state) < 3:
        return []
    before, value, after = state.value[:-2], state.value[1:-1], state.value[2:]
    out = np.abs(value - 0.5 * (before + after))
    found = (out > SPIKE) & (np.abs(after - before) < 0.5 * out)
    if not found.any():
        return []
    row, joint = (int(i) for i in np.unravel_index(int(np.argmax(np.where(found, out, 0.0))), found.shape))
    said = (
        f"state: {int(found.sum())} single reading(s) jump out and back, the farthest by {out[row, joint]:.3g} rad in "
        f"{state.where(row + 1)}, {state.columns[joint]}"
    )
    if len(found) >= 4 * SPEED_ROWS and found.mean() > SPIKED:
        doubts.stop(state.path, f"{said}: as if the samples of two arms took turns", "give each arm a file of its own")
    return [f"{said}; is the file damaged?"]


def _check_limits(state: Track, arm: Arm, doubts: Doubts) -> list[str]:
    notes = []
    excess = np.maximum(state.value - arm.upper, arm.lower - state.value)
    for joint, name in enumerate(arm.joint_names):
        beyond, worst = excess[:, joint] > 0, float(excess[:, joint].max())
        if np.mean(excess[:, joint] > LIMIT_MARGIN) > 0.5:
            raise FileError(
                state.path, f"{state.what}: {state.columns[joint]} is mostly outside the limits of joint {name} "
                f"({arm.lower[joint]:.3g} to {arm.upper[joint]:.3g} rad, by up to {worst:.3g} rad)",
                "check unit, joint order and zero posture (--angle-unit, --joints)",
            )  # fmt: skip
        far = float(np.mean(excess[:, joint] > LIMIT_MARGIN))
        if far > FAR_OUT:
            doubts.stop(
                state.path, f"{state.what}: {state.columns[joint]} is far outside the limits of joint {name} "
                f"({arm.lower[joint]:.3g} to {arm.upper[joint]:.3g} rad) in {100 * far:.0f} % of the samples, by up to "
                f"{worst:.3g} rad", "check unit, joint order and zero posture (--angle-unit, --joints)",
            )  # fmt: skip
        if beyond.any():
            notes.append(
                f"state: {state.columns[joint]} is beyond the limits of joint {name} in {int(beyond.sum())} samples, "
                f"by up to {worst:.3g} rad"
            )
    return notes
