"""What must hold for a track of samples before anybody fits a model to it.

An error is raised where the numbers cannot be what they are said to be; a note is returned where they can,
but the user should know. Every threshold is chosen, none is a property of a robot.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from rejoint.arms import Arm
from rejoint.logs.runlog import Array
from rejoint.logs.track import RecordedMotion, Track
from rejoint.system.errors import FileError

TWO_TURNS = 4.0 * np.pi
"""[rad] chosen: no joint of a serial arm is logged further from its zero; a log in degrees nearly always is."""
RATES = (1.0, 10_000.0)
"""[Hz] chosen: slower is no log of a moving arm, faster no control loop."""
GAP_PERIODS = 5.0
"""chosen: steps of more median periods than this count as gaps."""
LIMIT_MARGIN = 0.35
"""[rad] chosen: about 20 deg; calibration and zero offsets explain less."""
STALE_SECONDS = 0.5
"""[s] chosen: several times the lag of a hobby servo."""
STALE_TRAVEL = 0.1
"""[rad] chosen: more than friction holds back in the worst joint known to the project."""
LAGS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3)
"""[s] chosen: lags at which states are compared with commands."""
RELATED = (0.3, 0.9)
"""chosen: correlations below which a state does not follow a command, and above which it surely does."""
RESTING = 1e-3
"""[rad] chosen: below one step of a 12-bit encoder, a joint that moves less (rms) is at rest."""

_TIME_REMEDY = "set the time unit (--time-unit), or take another file"


def clean(track: Track) -> tuple[Track, list[str]]:
    """Check numbers and clock of a track; returns it without doubled stamps, and notes."""
    _check_finite(track)
    if len(track) < 2:
        raise FileError(track.path, f"{track.what}: {len(track)} sample(s), a log needs at least 2", "record it again")
    steps = np.diff(track.time)
    if (steps < 0).any():
        late = int(np.argmax(steps < 0)) + 1
        raise FileError(
            track.path, f"{track.what}, {track.where(late)}: the clock goes back by {-steps[late - 1]:.6g} s",
            "cut the file where the clock was set",
        )  # fmt: skip
    notes = []
    fresh = np.concatenate([[True], steps > 0])
    if not fresh.all():
        first = track.where(int(np.argmin(fresh)))
        notes.append(f"{track.what}: {int((~fresh).sum())} samples with a doubled stamp left out, first at {first}")
        track = track.take(fresh)
    return track, notes + _check_rate(track)


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


def _check_rate(track: Track) -> list[str]:
    if len(track) < 2:
        raise FileError(track.path, f"{track.what}: all samples have the same stamp", _TIME_REMEDY)
    steps = np.diff(track.time)
    period = float(np.median(steps))
    if not RATES[0] <= 1.0 / period <= RATES[1]:
        raise FileError(
            track.path, f"{track.what}: one sample in {period:.3g} s, expected {RATES[0]:g} to {RATES[1]:g} Hz",
            _TIME_REMEDY,
        )  # fmt: skip
    gaps = steps > GAP_PERIODS * period
    if not gaps.any():
        return []
    worst = int(np.argmax(steps))
    return [
        f"{track.what}: {int(gaps.sum())} gap(s) longer than {GAP_PERIODS:g} periods of {period:.3g} s, "
        f"the longest {steps[worst]:.3g} s before {track.where(worst + 1)}"
    ]


def check_angles(motion: RecordedMotion, arm: Arm) -> list[str]:
    """Compare the angles with what they are said to be and with the limits of the arm."""
    for track in (motion.state, motion.command):
        if (np.abs(track.value) > TWO_TURNS).any():
            row, joint = np.unravel_index(int(np.argmax(np.abs(track.value))), track.value.shape)
            found = float(track.value[row, joint])
            guess = "the values are surely degrees" if motion.angle_unit == "rad" else "the unit is surely wrong"
            raise FileError(
                track.path, f"{track.what}, {track.where(int(row))}: {track.columns[joint]} is {found:.4g} rad, "
                f"beyond two turns; {guess}", "set --angle-unit, or the unit in the column name",
            )  # fmt: skip
    notes = _check_limits(motion.state, arm)
    extent = float(np.abs(motion.state.value).max())
    if motion.angle_unit == "deg" and np.rad2deg(extent) <= 2 * np.pi:
        notes.append(
            f"state: no angle is beyond {np.rad2deg(extent):.3g} deg; set --angle-unit rad if the file holds radians"
        )
    if not (np.ptp(motion.state.value, axis=0) > 0).any():
        notes.append("state: no joint moves in this log")
    return notes


def _check_limits(state: Track, arm: Arm) -> list[str]:
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
        if beyond.any():
            notes.append(
                f"state: {state.columns[joint]} is beyond the limits of joint {name} in {int(beyond.sum())} samples, "
                f"by up to {worst:.3g} rad"
            )
    return notes


def check_agreement(state: Track, command: Array) -> list[str]:
    """Compare states with the commands ``(T, n)`` [rad] in force: the same joints should move, the same way."""
    notes = []
    lowest, highest = _correlations(state, command)
    for joint, name in enumerate(state.columns):
        own, best = highest[joint, joint], int(np.argmax(highest[joint]))
        if own >= RELATED[0]:
            continue
        if highest[joint, best] > RELATED[1]:
            raise FileError(
                state.path, f"the state of {name} follows the command of {state.columns[best]} "
                f"(correlation {highest[joint, best]:.2f}), not its own ({own:.2f})",
                "give the true joint order of states and commands",
            )  # fmt: skip
        if lowest[joint, joint] < -RELATED[1]:
            notes.append(
                f"state: {name} moves against its command (correlation {lowest[joint, joint]:.2f}); "
                "is its axis turned around?"
            )
    return notes + _stale(state, command)


def _correlations(state: Track, command: Array) -> tuple[Array, Array]:
    """Lowest and highest correlation over `LAGS` of each state (rows) with each command; 0 where one rests."""
    period = float(np.median(np.diff(state.time)))
    n, rows = state.value.shape[1], len(state)
    found = []
    for lag in sorted({round(lag / period) for lag in LAGS}):
        # over little of the log any two smooth motions look alike
        if rows - lag >= max(20, 0.8 * rows):
            moved = np.concatenate([state.value[lag:], command[: rows - lag]], axis=1)
            moved = moved - moved.mean(axis=0)
            scale = np.linalg.norm(moved, axis=0)
            scale[scale < RESTING * np.sqrt(len(moved))] = np.inf
            found.append((moved.T @ moved / np.outer(scale, scale))[:n, n:])
    if not found:
        return np.zeros((n, n)), np.ones((n, n))
    return np.min(found, axis=0), np.max(found, axis=0)


def _stale(state: Track, command: Array) -> list[str]:
    """Find stretches in which no reading changes while the command moves on."""
    changes = np.flatnonzero((np.diff(state.value, axis=0) != 0).any(axis=1)) + 1
    edges = np.concatenate([[0], changes, [len(state)]])
    found = []
    for start, end in pairwise(edges.tolist()):
        lasts = state.time[end - 1] - state.time[start]
        # what the arm is told in its last moments before it moves, it may not have answered yet
        answered = np.searchsorted(state.time, state.time[end - 1] - LAGS[-1])
        travel = np.ptp(command[start:answered], axis=0).max() if lasts > STALE_SECONDS else 0.0
        if travel > STALE_TRAVEL:
            found.append((float(lasts), float(state.time[start])))
    if not found:
        return []
    lasts, begin = max(found)
    return [
        f"state: the readings freeze {len(found)} time(s) while the command moves on, "
        f"longest for {lasts:.3g} s from {begin:.6g} s"
    ]
