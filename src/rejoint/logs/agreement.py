"""What must hold between the states of a log and its commands: the same joints move, the same way, a little later."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from rejoint.logs.doubts import Doubts
from rejoint.logs.lag import BELIEVED, SEARCHED, SHORTEST, find_lag
from rejoint.logs.runlog import Array
from rejoint.logs.track import Track
from rejoint.system.errors import FileError

STALE_SECONDS = 0.5
"""[s] chosen: several times the lag of a hobby servo."""
STALE_TRAVEL = 0.1
"""[rad] chosen: more than friction holds back in the worst joint known to the project."""
LAGS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3)
"""[s] chosen: lags at which states are compared with commands."""
RELATED = (0.3, 0.9)
"""chosen: correlations below which a state does not follow a command, and above which it surely does."""
MUCH_BETTER = (0.95, 5.0)
"""chosen: correlation with another command, and how much closer to 1 than with its own, by which a state is that of
another joint though all joints move alike; in 44 motions of a real low-cost arm no joint has such another."""
RESTING = 1e-3
"""[rad] chosen: below one step of a 12-bit encoder, a joint that moves less (rms) is at rest."""
SAME = 1e-5
"""[rad] chosen: what rounding in a file leaves of a copied number; no encoder repeats its command so closely."""
COPIED = 0.9
"""chosen: share of the rows of a moving joint that repeat the command from which the joint counts as copied."""
FEWEST_MOVING = 20
"""Rows in which a joint moves, below which nothing is said about copies (chosen)"""
GAIN = 10.0
"""chosen: a joint that moves this much farther than its command, or less, has another unit; friction takes up to 0.75
of a small motion of a real low-cost arm."""
STRIDE = 0.2
"""[s] chosen: between rows in which a joint's distance from a command that never changes is looked at."""
STANDING = 2.0
"""[s] chosen: for which a command stands, several times what a servo needs to arrive."""
LEFT = 0.3
"""[rad] chosen: by which a joint may leave such a command: other joints load it, and it may touch something; on a table
the elbow of a real low-cost arm is pushed 0.2 rad away."""
APART = 0.5
"""[rad] chosen: median distance of a joint from its command that no sag explains: another zero, or another joint."""


def check_agreement(state: Track, command: Array, doubts: Doubts) -> list[str]:
    """Compare states with the commands ``(T, n)`` [rad] in force; returns notes.

    FileError where the joints are mixed up; by `Doubts` where states are copies of commands, come before
    them or too late, or differ from them as no servo would.
    """
    notes = _check_order(state, command)
    _check_copies(state, command, doubts)
    notes += _check_still(state, command, doubts)
    _check_scale(state, command, doubts)
    return notes + _check_lag(state, command, doubts) + _stale(state, command)


def _check_order(state: Track, command: Array) -> list[str]:
    notes = []
    lowest, highest = _correlations(state, command)
    for joint, name in enumerate(state.columns):
        own, best = highest[joint, joint], int(np.argmax(highest[joint]))
        better = best != joint and highest[joint, best] > MUCH_BETTER[0]
        better = better and 1 - own > MUCH_BETTER[1] * (1 - highest[joint, best])
        if own >= RELATED[0] and not better:
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
    return notes


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


def _check_still(state: Track, command: Array, doubts: Doubts) -> list[str]:
    """Look for joints that leave a command which stands: something else than this command moved them."""
    rows = np.unique(np.searchsorted(state.time, np.arange(state.time[0], state.time[-1], STRIDE)))
    time, far, sent = state.time[rows], np.abs(state.value[rows] - command[rows]), command[rows]
    never, found = [], []
    for joint, name in enumerate(state.columns):
        edges = [0, *(np.flatnonzero(np.diff(sent[:, joint])) + 1).tolist(), len(rows)]
        for first, last in pairwise(edges):
            if last - first < STANDING / STRIDE:
                continue
            part = far[first:last, joint]
            left = float(np.max(part - np.minimum.accumulate(part)))
            if left > LEFT:
                found.append((left, name, float(time[first])))
                if np.ptp(command[:, joint]) == 0.0:
                    never.append(name)
    if not found:
        return []
    left, name, start = max(found)
    if never:
        doubts.stop(
            state.path, f"the commands of {_named(never, len(state.columns))} never change, yet {name} moves away from "
            f"its own by {left:.3g} rad: not these commands moved the arm",
            "give what was sent, or leave the columns of the commands out",
        )  # fmt: skip
    return [
        f"state: while its command stands, from {start:.6g} s on, {name} moves away from it by {left:.3g} rad: without "
        "torque, by hand, or by commands that are not in the file?"
    ]


def _check_copies(state: Track, command: Array, doubts: Doubts) -> None:
    period = float(np.median(np.diff(state.time)))
    reach = min(int(np.clip(round(BELIEVED[1] / period), 1, 50)), len(state) // 2)
    copied: dict[str, int] = {}
    for lag in sorted(range(-reach, reach + 1), key=abs):
        later = slice(max(lag, 0), len(state) + min(lag, 0))
        sooner = slice(max(-lag, 0), len(state) + min(-lag, 0))
        asked, found = command[sooner], state.value[later]
        moving = np.abs(np.diff(asked, axis=0, prepend=asked[:1])) > SAME
        same = moving & (np.abs(asked - found) <= SAME)
        counts, of = same.sum(axis=0), moving.sum(axis=0)
        for joint, name in enumerate(state.columns):
            if of[joint] >= FEWEST_MOVING and counts[joint] > COPIED * of[joint]:
                copied.setdefault(name, lag)
    if copied:
        lag = next(iter(copied.values()))
        when = "in the same row" if lag == 0 else f"{abs(lag)} row(s) {'later' if lag > 0 else 'earlier'}"
        doubts.stop(
            state.path, f"the states of {_named(list(copied), len(state.columns))} are copies of the "
            f"commands, {when}: such a log shows no arm", "record what the encoders say and what was sent",
        )  # fmt: skip


def _named(joints: list[str], of: int) -> str:
    return "all joints" if len(joints) == of else ", ".join(joints)


def _check_scale(state: Track, command: Array, doubts: Doubts) -> None:
    """Compare how far joints move and where they are with their commands."""
    _, follows = _correlations(state, command)
    travel, asked = np.std(state.value, axis=0), np.std(command, axis=0)
    apart = np.median(state.value - command, axis=0)
    if len(state) < FEWEST_MOVING:
        return
    for joint, name in enumerate(state.columns):
        if follows[joint, joint] > RELATED[1]:
            gain = float(travel[joint] / max(asked[joint], 1e-9))
            if not 1 / GAIN < gain < GAIN:
                doubts.stop(
                    state.path, f"{name} moves {gain:.3g} times as far as its command: not one unit",
                    "give states and commands in one unit",
                )  # fmt: skip
        if abs(apart[joint]) > APART:
            doubts.stop(
                state.path, f"{name} is {np.rad2deg(apart[joint]):.0f} deg from its command (median)",
                "check unit, joint order and zero of states and commands",
            )  # fmt: skip


def _check_lag(state: Track, command: Array, doubts: Doubts) -> list[str]:
    lag = find_lag(state.time, state.value, command)
    if lag is None:
        long = bool(state.time[-1] - state.time[0] >= SHORTEST)
        return ["state: nothing moves fast enough to tell whether states and commands have one clock"] * long
    if lag.believed:
        return []
    at = f"{abs(lag.best):.2g} s {'before' if lag.best < 0 else 'after'}"
    at += " or more" if abs(lag.best) > SEARCHED - 0.06 else ""
    if not lag.sure:
        return [
            f"state: follows its commands best {at} them, expected {BELIEVED[0]:g} to {BELIEVED[1]:g} s after; this "
            "motion does not tell surely whether the clocks differ"
        ]
    cause = "states are stamped before their commands or on another clock, or both are exchanged" if lag.best < 0 else (
        "commands are goals that something else moves to, or the clocks differ"
    )  # fmt: skip
    doubts.stop(
        state.path, f"the states follow their commands best {at} them, expected {BELIEVED[0]:g} to "
        f"{BELIEVED[1]:g} s after: {cause}", "record both with the stamps of one clock",
    )  # fmt: skip
    return []


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
