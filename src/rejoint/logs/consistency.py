"""Consistency checks of logs.

Impossible numbers raise an error; unlikely ones go to `Doubts`; others give a note. All thresholds are chosen.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path

import numpy as np

from rejoint.arms import Arm
from rejoint.logs.runlog import TWO_TURNS, Array, RunLog
from rejoint.logs.track import RecordedMotion, Track
from rejoint.system.errors import FileError, InputError

FORCED = "forced"
"""Key in ``extra`` of overridden reasons"""

_BETWEEN = " | "


@dataclass(frozen=True, kw_only=True)
class Doubts:
    """Collects failed checks of a log."""

    force: bool = False
    """import all the same"""
    reasons: list[str] = field(default_factory=list)
    """overridden failures"""

    def stop(self, path: Path, problem: str, remedy: str) -> None:
        """Raise FileError, or store the problem by force."""
        if not self.force:
            raise FileError(path, problem, f"{remedy}; or go on with --force, which keeps this reason in the log")
        if problem not in self.reasons:
            self.reasons.append(problem)

    @property
    def kept(self) -> dict[str, str]:
        """Entry of ``extra``."""
        return {FORCED: _BETWEEN.join(self.reasons)} if self.reasons else {}


def forced_reasons(extra: dict[str, str]) -> tuple[str, ...]:
    """Reasons of `Doubts.kept`."""
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
        if not np.ptp(log.position, axis=0).any():
            continue
        key = sha256(np.concatenate([log.position, log.command]).tobytes()).digest()
        if key in first:
            found[name] = first[key]
        else:
            first[key] = name
    return found


def refuse_copies(logs: Sequence[RunLog], what: str) -> None:
    """Raise InputError for duplicates."""
    found = copies((log.label, log) for log in logs)
    if found:
        name, original = next(iter(found.items()))
        more = f" (and {len(found) - 1} more)" * (len(found) > 1)
        raise InputError(
            f"{what}: {name} holds the same readings as {original}{more}, and would count as evidence of its own; "
            "remove the copies"
        )


BELIEVED = (0.0, 0.3)
"""[s] plausible lags (a low-cost arm: 0.06 to 0.16 s)"""

SEARCHED = 1.0
"""[s] to both sides"""

_WINDOW = 0.2
"""[s] of a velocity: hides encoder steps"""
_GRID = (0.01, 0.05)
"""[s] finest and coarsest step"""
SHORTEST = 4.0
"""[s] of a log with a lag"""
_MOVING = 0.005
"""[rad/s] rms speed of a command"""

SURE = 1.05
"""Unexplained part at the best plausible lag over the best of all, at an end of the plausible range (44 motions of a
real arm: 1.00)"""
SURE_OF_ANOTHER = 1.5
"""The same inside the range (measured: up to 1.10)"""

_OVERLAP = 0.5
"""Least share of motion in the overlap"""
_UNLIKE = 0.5
"""Unexplained part of a usable lag"""

_JUMP = np.radians(2.0)
"""[rad] of a command's step in one row"""
_STEPPING = 0.8
"""Stepped share of travel"""
_REST = 1.0
"""[s] without commands around a step"""
_BEGUN = 0.05
"""Travel share of a moving joint: above encoder noise"""
_FEWEST_STEPS = 3


@dataclass(frozen=True, kw_only=True)
class Lag:
    """Lag of states behind commands."""

    best: float
    """[s] negative: states come first"""
    sure: bool
    """False: a plausible lag explains as well"""

    @property
    def believed(self) -> bool:
        """Whether the lag is plausible."""
        return BELIEVED[0] <= self.best <= BELIEVED[1]


def find_lag(time: Array, position: Array, command: Array) -> Lag | None:
    """Lag of positions (T, n) [rad] behind commands at ``time`` (T,) [s]; None: too short or no motion."""
    if len(time) < 10 or time[-1] - time[0] < SHORTEST:
        return None
    step = float(np.clip(np.median(np.diff(time)), *_GRID))
    even = np.arange(time[0], time[-1], step)
    if len(even) > 1_000_000:  # (chosen) of what a day of logging shows, some hours tell as much
        even = even[:1_000_000]
    held = command[np.searchsorted(time, even, side="right") - 1]
    moved = np.stack([np.interp(even, time, one) for one in position.T], axis=1)
    stepping = [_is_stepping(one, step) for one in held.T if np.ptp(one) > _JUMP]
    if stepping and all(stepping):
        return _of_steps(moved, held, step)
    return _of_velocities(moved, held, step, float(np.median(np.diff(time))))


def _of_velocities(moved: Array, held: Array, step: float, period: float) -> Lag | None:
    width = max(round(max(_WINDOW, 4 * period) / step), 2)
    speed, asked = ((one[width:] - one[:-width]) / (width * step) for one in (moved, held))
    reach = min(round(SEARCHED / step), len(speed) // 2)
    lags = np.arange(-reach, reach + 1)
    told = [joint for joint in range(asked.shape[1]) if np.sqrt(np.mean(asked[:, joint] ** 2)) > _MOVING]
    unexplained, weight = np.zeros(len(lags)), 0.0
    for one, other in ((speed[:, joint], asked[:, joint]) for joint in told):
        whole = np.array([one @ one, other @ other])
        for index, lag in enumerate(lags.tolist()):
            later, sooner = one[max(lag, 0) : len(one) + min(lag, 0)], other[max(-lag, 0) : len(one) - max(lag, 0)]
            power = np.array([later @ later, sooner @ sooner])
            follows = 0.0  # where motion is shifted out of the log, nothing is left to compare
            if (power > _OVERLAP * whole).all():
                follows = max(float(later @ sooner), 0.0) ** 2 / max(float(np.prod(power)), 1e-12)
            unexplained[index] += whole[0] * (1.0 - follows)
        weight += float(whole[0])
    if not weight:
        return None
    return _chosen(step * lags.astype(float), unexplained / weight, tolerance=max(step, 0.5 * period))


def _chosen(lags: Array, unexplained: Array, tolerance: float) -> Lag:
    alike = bool(unexplained.min() < _UNLIKE)
    unexplained = unexplained + 1e-4  # a perfect fit is no infinitely better one
    best = int(np.argmin(unexplained))
    believed = (lags > BELIEVED[0] - tolerance - 1e-9) & (lags < BELIEVED[1] + tolerance + 1e-9)
    inside = int(np.flatnonzero(believed)[np.argmin(unexplained[believed])])
    edge = inside in (np.flatnonzero(believed)[0], np.flatnonzero(believed)[-1])
    ratio = unexplained[inside] / unexplained[best]
    if believed[best]:
        return Lag(best=float(np.clip(lags[best], *BELIEVED)), sure=True)
    return Lag(best=float(lags[best]), sure=alike and bool(ratio > (SURE if edge else SURE_OF_ANOTHER)))


def _is_stepping(command: Array, step: float) -> bool:
    """Whether a command (T,) mostly steps and rests."""
    change = np.abs(np.diff(command))
    jumps = np.flatnonzero(change > _JUMP)
    if not len(jumps):
        return False
    near = np.diff(jumps) * step < 0.1
    alone = ~np.concatenate([[False], near]) & ~np.concatenate([near, [False]])
    return bool(change[jumps[alone]].sum() > _STEPPING * change.sum())


def _of_steps(moved: Array, held: Array, step: float) -> Lag | None:
    reach, rest = round(SEARCHED / step), round(_REST / step)
    shares = []
    for joint in range(held.shape[1]):
        change = np.abs(np.diff(held[:, joint]))
        steps = np.flatnonzero(change > _JUMP) + 1
        changes = np.flatnonzero(change > 0) + 1
        for at in steps:
            others = changes[changes != at]
            if at < reach + rest or at + reach >= len(held) or (np.abs(others - at) < max(reach, rest)).any():
                continue
            start, way = moved[at - reach, joint], moved[at - reach : at + reach + 1, joint]
            if abs(way[-1] - start) > _JUMP:
                shares.append((way - start) / (way[-1] - start))
    if len(shares) < _FEWEST_STEPS:
        return None
    begun = np.flatnonzero(np.median(shares, axis=0) > _BEGUN)
    best = float((begun[0] - reach) * step) if len(begun) else SEARCHED
    return Lag(best=best, sure=not BELIEVED[0] - step < best < BELIEVED[1] + step)


RATES = (1.0, 10_000.0)
"""[Hz] of logs"""
SLOWEST = 10.0
"""[Hz] for friction and lag"""
LOST = 0.05
"""share of repeated stamps of a coarse clock"""
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
GAP_PERIODS = 5.0
"""median periods of a gap"""
LIMIT_MARGIN = 0.35
"""[rad] beyond calibration and zero offsets"""
GEAR_REMEDY = "give gear, sign and zero of each joint: --map JOINT=THEIRS/RATIO+OFFSET"
_OR_LOG = ", or take the times of recording (--stamp log)"
_TIME_REMEDY = "set the time unit (--time-unit, or the column's name where that says one), or take another file"
FEWEST_VALUES = 20
"""Different readings for a step"""
FEWEST_STEPS = 10
"""Steps spanned by readings"""
ON, OFF = 0.9, 0.6
"""on a grid, and off it (1: all readings)"""
BITS = range(10, 22)
"""of encoders"""


def clean(track: Track, doubts: Doubts) -> tuple[Track, list[str]]:
    """Check numbers and clock; returns a track without doubled stamps, and notes."""
    _check_finite(track)
    if len(track) < 2:
        raise FileError(track.path, f"{track.what}: {len(track)} sample(s), a log needs at least 2", "record it again")
    steps = np.diff(track.time)
    if (steps < 0).any():
        late = int(np.argmax(steps < 0)) + 1
        raise FileError(
            track.path,
            f"{track.what}, {track.where(late)}: the clock goes back by {-steps[late - 1]:.6g} s",
            "cut the file where the clock was set" + _OR_LOG * track.place.startswith("topic"),
        )
    notes = []
    fresh = np.concatenate([[True], steps > 0])
    lost = int((~fresh).sum())
    if lost:
        if lost > LOST * len(track) and fresh[1:].any():
            doubts.stop(
                track.path,
                f"{track.what}: the clock counts in steps of {np.median(steps[steps > 0]):.3g} s, and "
                f"{lost} of {len(track)} samples ({100 * lost / len(track):.0f} %) have the stamp of the one before "
                "and are lost",
                "record finer stamps",
            )
        first = track.where(int(np.argmin(fresh)))
        notes.append(f"{track.what}: {lost} samples with a doubled stamp left out, first at {first}")
        track = track.take(fresh)
    return track, notes + _check_rate(track, doubts)


def _check_finite(track: Track) -> None:
    if not np.isfinite(track.time).all():
        row = int(np.argmin(np.isfinite(track.time)))
        raise FileError(track.path, f"{track.what}, {track.where(row)}: the time is not a number", "mend or cut it")


def _check_rate(track: Track, doubts: Doubts) -> list[str]:
    if len(track) < 2:
        raise FileError(track.path, f"{track.what}: all samples have the same stamp", _TIME_REMEDY)
    steps = np.diff(track.time)
    period = float(np.median(steps))
    rate = 1.0 / period
    sparse = track.what == "command"  # a command may stand for as long as it likes
    if rate > RATES[1] or (rate < RATES[0] and not sparse):
        raise FileError(
            track.path,
            f"{track.what}: one sample in {period:.3g} s, expected {RATES[0]:g} to {RATES[1]:g} Hz",
            _TIME_REMEDY,
        )
    if sparse:
        return []
    if rate < 0.99 * SLOWEST:
        doubts.stop(
            track.path,
            f"{track.what}: {rate:.2g} samples in a second, expected at least {SLOWEST:g}: too few to "
            "show friction or lag",
            "record faster",
        )
    gaps = steps > GAP_PERIODS * period
    if not gaps.any():
        return []
    worst = int(np.argmax(steps))
    return [
        f"{track.what}: {int(gaps.sum())} gap(s) longer than {GAP_PERIODS:g} periods of {period:.3g} s, "
        f"the longest {steps[worst]:.3g} s before {track.where(worst + 1)}"
    ]


def check_angles(motion: RecordedMotion, arm: Arm, doubts: Doubts) -> list[str]:
    """Check angles against unit and limits."""
    _check_turns(motion, arm, doubts)
    notes = _check_limits(motion.state, arm, doubts)
    extent = float(np.abs(motion.state.value).max())
    if motion.angle_unit == "deg" and np.rad2deg(extent) <= 2 * np.pi:
        doubts.stop(
            motion.state.path,
            f"state: no angle is beyond {np.rad2deg(extent):.3g} deg; the values are surely radians",
            "set --angle-unit rad, or correct the column's name where that says a unit",
        )
    notes += _spikes(motion.state, doubts)
    _check_speed(motion.state, arm, doubts)
    _check_jumps(motion.state, doubts)
    if not (np.ptp(motion.state.value, axis=0) > 0).any():
        notes.append("state: no joint moves in this log")
    return notes


def binary_turns(values: Array) -> int | None:
    """Return encoder bits of readings (T, n) [rad], or None."""
    for bits in BITS:
        step = 2 * np.pi / 2**bits
        told = [one for joint in values.T if len(one := np.unique(np.round(joint, 12))) >= FEWEST_VALUES]
        if told and np.median([on_grid(one, step) for one in told]) > ON:
            return int(bits)
    return None


def on_grid(values: Array, step: float) -> float:
    """Share of values on multiples of a step; 0: few steps."""
    if np.ptp(values) < FEWEST_STEPS * step:
        return 0.0
    return float(np.abs(np.mean(np.exp(2j * np.pi * values / step))))


def _check_turns(motion: RecordedMotion, arm: Arm, doubts: Doubts) -> None:
    state = motion.state
    bits = binary_turns(np.rad2deg(state.value)) if motion.angle_unit == "deg" else None
    if bits is not None:
        doubts.stop(
            state.path,
            f"state: the values come in steps of 2 pi / {2**bits}: they are radians, not degrees; "
            f"up to {np.rad2deg(np.abs(state.value).max()):.4g} rad are angles of the motors, before their gear",
            GEAR_REMEDY,
        )
    for track in motion.tracks:
        far = np.abs(track.value)
        if (far <= TWO_TURNS).all():
            continue
        row, joint = np.unravel_index(int(np.argmax(far)), far.shape)
        bits = binary_turns(track.value) if motion.angle_unit == "rad" else None
        gear = max(float((np.ptp(track.value, axis=0) / (arm.upper - arm.lower)).max()), 1.0)
        cause = f"angles of the motors, before a gear of {gear:.2g} or more"
        cause = f"degrees, or {cause}" if bits is None else f"{cause}, for they come in steps of 2 pi / {2**bits}"
        unit = cause if motion.angle_unit == "rad" else "in another unit"
        raise FileError(
            track.path,
            f"{track.what}, {track.where(int(row))}: {track.columns[joint]} is "
            f"{track.value[row, joint]:.4g} rad, beyond two turns; the values are {unit}",
            f"set --angle-unit, correct the column's name, or {GEAR_REMEDY}" if bits is None else GEAR_REMEDY,
        )


def _check_speed(state: Track, arm: Arm, doubts: Doubts) -> None:
    if len(state) < SPEED_ROWS * 4:
        return
    speed = np.abs(state.value[SPEED_ROWS:] - state.value[:-SPEED_ROWS])
    speed /= (state.time[SPEED_ROWS:] - state.time[:-SPEED_ROWS])[:, None]
    usual = np.percentile(speed, 90, axis=0)
    joint = int(np.argmax(usual / arm.max_speed))
    if usual[joint] > TOO_FAST * arm.max_speed[joint]:
        doubts.stop(
            state.path,
            f"{state.what}: {state.columns[joint]} moves at {usual[joint]:.3g} rad/s and more in a tenth "
            f"of the log, joint {arm.joint_names[joint]} at up to {arm.max_speed[joint]:.3g}",
            _TIME_REMEDY,
        )


def _check_jumps(state: Track, doubts: Doubts) -> None:
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
        state.path,
        f"{state.what}: {int(found.any(axis=1).sum())} time(s) joints are elsewhere in the next sample, "
        f"farthest {state.columns[joint]} by {way[row + 1, joint]:.3g} rad in {steps[row + 1, 0]:.3g} s at "
        f"{state.where(row + 2)}: no joint moves so",
        "cut the file there, or mend the values",
    )


def _spikes(state: Track, doubts: Doubts) -> list[str]:
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
        far = float(np.mean(excess[:, joint] > LIMIT_MARGIN))
        if far > FAR_OUT:
            doubts.stop(
                state.path,
                f"{state.what}: {state.columns[joint]} is far outside the limits of joint {name} "
                f"({arm.lower[joint]:.3g} to {arm.upper[joint]:.3g} rad) in {100 * far:.0f} % of the samples, by up to "
                f"{worst:.3g} rad",
                "check unit, joint order and zero posture (--angle-unit, --map)",
            )
        if beyond.any():
            notes.append(
                f"state: {state.columns[joint]} is beyond the limits of joint {name} in {int(beyond.sum())} samples, "
                f"by up to {worst:.3g} rad"
            )
    return notes


FAR = 0.1
"""[rad] command travel for duplicates"""
LAGS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3)
"""[s] of states behind commands"""
RELATED = (0.3, 0.9)
"""correlations: unrelated, and related"""
MUCH_BETTER = (0.95, 5.0)
"""of exchanged joints: correlation, and how much closer to 1"""
RESTING = 1e-3
"""[rad] rms at rest: below a 12-bit encoder's step"""
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


def check_agreement(state: Track, command: Array, doubts: Doubts) -> list[str]:
    """Check states against the commands ``(T, n)`` [rad] in force; returns notes.

    FileError for exchanged joints; `Doubts` for duplicates, implausible lags and scales.
    """
    notes = _check_order(state, command)
    _check_copies(state, command, doubts)
    _check_still(state, command, doubts)
    notes += _check_scale(state, command, doubts)
    return notes + _check_lag(state, command, doubts)


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
                state.path,
                f"the state of {name} follows the command of {state.columns[best]} "
                f"(correlation {highest[joint, best]:.2f}), not its own ({own:.2f})",
                "give the true joint order of states and commands",
            )
        if lowest[joint, joint] < -RELATED[1]:
            notes.append(
                f"state: {name} moves against its command (correlation {lowest[joint, joint]:.2f}); "
                "is its axis turned around?"
            )
    return notes


def _correlations(state: Track, command: Array) -> tuple[Array, Array]:
    """Lowest and highest correlation over `LAGS`, states (rows) with commands."""
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


def _check_still(state: Track, command: Array, doubts: Doubts) -> None:
    far = np.abs(state.value - command)
    left = np.max(far - np.minimum.accumulate(far, axis=0), axis=0)
    for joint in np.flatnonzero((left > LEFT) & (np.ptp(command, axis=0) == 0.0)):
        doubts.stop(
            state.path,
            f"the command of {state.columns[joint]} never changes, yet it moves away from it by "
            f"{left[joint]:.3g} rad: not this command moved the arm",
            "give what was sent, or leave the columns of the commands out",
        )


def _check_copies(state: Track, command: Array, doubts: Doubts) -> None:
    period = float(np.median(np.diff(state.time)))
    reach = min(int(np.clip(round(BELIEVED[1] / period), 1, 50)), len(state) // 2)
    copied: dict[str, int] = {}
    far = np.ptp(command, axis=0) > FAR  # a good arm follows a hair's breadth exactly
    for lag in sorted(range(-reach, reach + 1), key=abs):
        later = slice(max(lag, 0), len(state) + min(lag, 0))
        sooner = slice(max(-lag, 0), len(state) + min(-lag, 0))
        asked, found = command[sooner], state.value[later]
        moving = np.abs(np.diff(asked, axis=0, prepend=asked[:1])) > SAME
        same = moving & (np.abs(asked - found) <= SAME) & far
        counts, of = same.sum(axis=0), moving.sum(axis=0)
        for joint, name in enumerate(state.columns):
            if of[joint] >= FEWEST_MOVING and counts[joint] > COPIED * of[joint]:
                copied.setdefault(name, lag)
    if copied:
        lag = next(iter(copied.values()))
        when = "in the same row" if lag == 0 else f"{abs(lag)} row(s) {'later' if lag > 0 else 'earlier'}"
        doubts.stop(
            state.path,
            f"the states of {_named(list(copied), len(state.columns))} are copies of the "
            f"commands, {when}: such a log shows no arm",
            "record what the encoders say and what was sent",
        )


def _named(joints: list[str], of: int) -> str:
    return "all joints" if len(joints) == of else ", ".join(joints)


def _check_scale(state: Track, command: Array, doubts: Doubts) -> list[str]:
    if len(state) < FEWEST_MOVING:
        return []
    notes = []
    _, follows = _correlations(state, command)
    travel, asked = np.std(state.value, axis=0), np.std(command, axis=0)
    error = state.value - command
    apart, spread = np.median(error, axis=0), np.ptp(np.percentile(error, (10, 90), axis=0), axis=0)
    for joint, name in enumerate(state.columns):
        if follows[joint, joint] > RELATED[1]:
            gain = float(travel[joint] / max(asked[joint], 1e-9))
            if not 1 / GAIN < gain < GAIN:
                doubts.stop(
                    state.path,
                    f"{name} moves {gain:.3g} times as far as its command: not one unit",
                    "give states and commands in one unit",
                )
        if abs(apart[joint]) > APART:
            said = f"{name} is {np.rad2deg(apart[joint]):.0f} deg from its command (median)"
            if spread[joint] < abs(apart[joint]) / 2 and travel[joint] > FOLLOWED * asked[joint]:
                doubts.stop(state.path, said, "check unit, joint order and zero of states and commands")
            notes.append(f"state: {said}: a weak servo, or another zero")
    return notes


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
    cause = (
        "states are stamped before their commands or on another clock, or both are exchanged"
        if lag.best < 0
        else ("commands are goals that something else moves to, or the clocks differ")
    )
    doubts.stop(
        state.path,
        f"the states follow their commands best {at} them, expected {BELIEVED[0]:g} to "
        f"{BELIEVED[1]:g} s after: {cause}",
        "record both with the stamps of one clock",
    )
    return []
