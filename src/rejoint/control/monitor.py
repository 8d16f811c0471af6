"""The joint monitor: finds stuck joints and dead encoders.

Constants without a source are chosen.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, gravity_torque, position_kinematics
from rejoint.arms.workspace import length_size
from rejoint.control.controllers.law import between, plain
from rejoint.control.robot import JointState, Mask
from rejoint.logs.runlog import RunLog
from rejoint.system.shell import Late

compiled = Late("rejoint.control.compiled")

TRAVEL = 0.020
"""[m] tool travel of a command beyond a constant reading, for a myCobot 280"""
STICKING = 1.5
"""times the largest sticking"""
STICKS = np.radians(4.0)
"""[rad] sticking of an unknown joint"""
SHORT_LEVER = 0.13
"""[m] joints with shorter levers are not judged without load, for a myCobot 280"""
MOVED = np.radians(2.0)
"""[rad] of a moving joint"""
TURN_ROUND = 0.12
"""[s] of a constant reading before judgement"""
EXCUSED = 0.15
"""[s] for two joints at once"""
ARRIVED = np.radians(1.0)
"""[rad] following error at arrival"""
SETTLED = 30
"""changes of a reading before its sticking is known"""
GAIN, GAIN_SPREAD = 20.0, 2.0
"""[1/rad] and relative deviation of unknown servos (measured)"""
LEAST_GAIN = 3.0
"""[1/rad]"""
OFFSET_SPREAD, UNKNOWN_OFFSET = 0.02, 0.15
"""deviations of the unloaded torque share"""
PULL = 2.0
"""times the allowed push, to pull an overdue joint back"""
_EARLIEST = np.radians(2.0)  # [rad] travel from which levers are computed (chosen: 10 mm at 0.28 m)


@dataclass(frozen=True, kw_only=True, eq=False)
class Knowledge:
    """Load lines of servos, from `servo_lines`."""

    gain: Array
    """(n,) or (B, n) [1/rad] torque share per radian"""
    offset: Array | float = 0.0
    """(n,) [rad] unloaded joint minus command"""
    within: Array | float = 0.2
    """(n,) largest relative error of ``gain``; infinite: unknown"""
    noise: Array | float = OFFSET_SPREAD
    """(n,) deviation of loads from the line"""


def states_of(log: RunLog) -> Iterator[JointState]:
    """Yield the state in each row."""
    for row in range(len(log)):
        rows = slice(row, row + 1)
        load = None if log.servo_load is None else log.servo_load[rows]
        yield JointState(time=log.time[rows], position=log.position[rows], age=np.zeros(1), load=load)


@dataclass(frozen=True, kw_only=True, eq=False)
class Bands:
    """Friction bands from `standing_bands`: pushes at which joints do not move; (n,) or (B, n).

    Lead: command minus reading. Push: lead beyond the balance.
    """

    slope: Array
    """[rad/(N m)] lead per gravity torque"""
    offset: Array
    """[rad] lead without load"""
    reach: Array
    """[rad] lead of the largest torque"""
    width: Array
    """[rad] largest push of a stationary joint; infinite: unknown"""
    lifted: Array | float = 0.0
    """[rad] largest lead against gravity at which the joint moved on; above it the motor may be too weak"""

    def balance(self, arm: Arm, position: Array) -> Array:
        """Leads (..., n) [rad] against gravity at ``position`` (..., n) [rad]."""
        balance: Array = self.slope * gravity_torque(arm, position) + self.offset
        return balance


class Following:
    """Monitors B arms; one `check` per cycle."""

    def __init__(
        self,
        arm: Arm,
        state: JointState,
        sent: Array,
        knowledge: Knowledge | None = None,
        *,
        bands: Bands | None = None,
    ) -> None:
        """Begin at ``state`` after ``sent`` (B, n) [rad]."""
        self._bands = bands
        shape = state.position.shape
        self._arm, self._last = arm, state.time.copy()
        self._tracks = np.zeros(shape, compiled.TRACK)
        self._tracks["position"] = self._tracks["home"] = state.position
        self._tracks["held"] = sent
        self._tracks["reach"] = np.inf if bands is None else bands.reach
        self._tracks["width"] = np.inf if bands is None else bands.width
        self._tracks["stuck"] = 0.0 if bands is None else 2.0 * bands.width  # from one end of the band to the other
        self._tracks["since"] = state.time[:, None]
        self._know(knowledge or Knowledge(gain=np.full(shape, GAIN), within=np.inf))
        self._sent_at = np.repeat(state.time[:, None], compiled.HISTORY, axis=1)
        self._sent = np.repeat(np.asarray(sent, dtype=float)[:, None], compiled.HISTORY, axis=1)
        self._verdict = np.zeros(shape, dtype=np.int64)
        self._nothing = np.zeros(shape)
        self._excused_since, self._excused_last = np.full((2, len(state.time)), -np.inf)
        self._loaded = False

    def _know(self, knowledge: Knowledge) -> None:
        tracks, shape = self._tracks, self._tracks.shape
        given = np.broadcast_to(np.isfinite(knowledge.within), shape)
        gain = np.where(given, knowledge.gain, GAIN)
        spread = np.where(given, knowledge.within, GAIN_SPREAD * compiled.SURE) / compiled.SURE
        tracks["given"], tracks["noise"] = given, knowledge.noise
        tracks["gain"], tracks["p00"] = gain, (spread * gain) ** 2
        tracks["least"] = np.maximum((1.0 - 2.0 * spread) * gain, LEAST_GAIN)
        tracks["offset"] = np.where(given, gain * knowledge.offset, 0.0)
        tracks["p11"] = np.where(given, knowledge.noise, UNKNOWN_OFFSET) ** 2

    def check(self, state: JointState, sent: Array, aimed: Mask) -> Mask | None:
        """Joints (B, n) flagged after ``sent`` (B, n) [rad], or None.

        Travel counts only for arms ``aimed`` (B,) at a target: a diagnosis must find stuck joints.
        """
        self._loaded = state.load is not None
        load = self._nothing if state.load is None else state.load
        balance = self._nothing if self._bands is None else self._bands.balance(self._arm, state.position)
        compiled.watch(
            self._tracks,
            self._sent_at,
            self._sent,
            np.array([state.time, self._last]),
            np.array([state.position, sent, load, balance]),
            self._loaded,
            self._arm.encoder_step,
            self._verdict,
        )
        self._last = state.time.copy()
        worst = self._verdict.max()
        if worst < compiled.UNKNOWN:
            return None
        bad: Mask = self._verdict >= compiled.TURNING
        late: Mask = (self._tracks["late"] > 0) | (self._tracks["strikes"] > 0)
        if self._bands is None:
            travelled, more = self._travelled(state.position, sent)
            late = late | more
            bad = bad | (travelled & aimed[:, None])
        if not bad.any():
            return None
        bad = bad & ~self._excused(bad, late)[:, None]
        return bad if bad.any() else None

    def _excused(self, bad: Mask, late: Mask) -> Mask:
        """Arms (B,) late as a whole: a ``bad`` and another ``late`` joint, (B, n)."""
        now, several = self._last, bad.any(axis=-1) & ((bad | late).sum(axis=-1) > 1)
        begins = several & (now - self._excused_last > EXCUSED)
        self._excused_since = np.where(begins, now, self._excused_since)
        self._excused_last = np.where(several, now, self._excused_last)
        excused: Mask = several & (now - self._excused_since < EXCUSED)
        return excused

    def bound(self, wanted: Array, position: Array, aimed: Mask) -> Array:
        """Keep ``wanted`` (B, n) [rad] within `TRAVEL` of constant readings, without load."""
        if self._loaded:
            return wanted
        held = self._tracks["held"]
        far = (self._tracks["moved"] < MOVED) & (np.abs(wanted - held) > _EARLIEST) & aimed[:, None]
        if not far.any():
            return wanted
        reach = TRAVEL / self._levers(position)
        return np.where(far, np.minimum(np.maximum(wanted, held - reach), held + reach), wanted)

    def believe(self, state: JointState, sent: Array, joints: Mask) -> None:
        """Trust ``joints`` (B, n) again after ``sent`` (B, n) [rad]."""
        tracks, where = self._tracks, joints.any(axis=-1)
        push, width, load = tracks["push"], tracks["width"], self._loads()
        lifted = 0.0 if self._bands is None else self._bands.lifted
        weak = joints & (push * load > 0.0) & (np.abs(load) > lifted)
        tracks["reach"] = np.where(weak, np.minimum(tracks["reach"], np.abs(load) + width), tracks["reach"])
        tracks["width"] = np.where(joints & ~weak, np.maximum(width, np.abs(push) / compiled.MOST), width)
        tracks["position"][where], tracks["held"][where] = state.position[where], sent[where]
        tracks["since"][where] = state.time[where, None]
        for name in ("travel", "pushed", "due", "still", "strikes", "steady", "full", "late"):
            tracks[name][where] = 0
        self._verdict[where] = compiled.FINE
        self._last = np.where(where, state.time, self._last)
        self._sent_at[where] = state.time[where, None]
        self._sent[where] = sent[where, None]

    def balance(self, joints: Mask, sent: Array) -> Array:
        """Return holding commands (B, n) [rad]: ``sent``, or the last equilibrium of ``joints`` (B, n)."""
        return np.where(joints, self._tracks["held"], sent)

    def pulled(self, joints: Mask, sent: Array) -> Array:
        """Commands (B, n) [rad] that move overdue ``joints`` (B, n) back; else `balance`.

        A motor that holds a joint may be too weak to move it on, but never to move it back.
        """
        tracks, overdue = self._tracks, joints & (self._verdict == compiled.OVERDUE)
        width = np.where(overdue, tracks["width"], 0.0)
        pull = PULL * (compiled.MOST * width + np.minimum(compiled.AND, width)) * np.sign(tracks["push"])
        return np.where(overdue, tracks["position"] + self._loads() - pull, self.balance(joints, sent))

    def _loads(self) -> Array:
        """Leads (B, n) [rad] against gravity at the last changed readings."""
        return self._nothing if self._bands is None else self._bands.balance(self._arm, self._tracks["position"])

    def describe(self, b: int, joints: Mask) -> str:
        """Describe the finding on ``joints`` (n,) of arm ``b``, with advice."""
        return "; ".join(self._describe(b, int(j)) for j in np.flatnonzero(joints))

    def _travelled(self, position: Array, sent: Array) -> tuple[Mask, Mask]:
        """Joints (B, n) with commands far from a constant reading."""
        tracks = self._tracks
        travel = np.abs(tracks["travel"])
        stands = self._last[:, None] - tracks["since"] > TURN_ROUND
        away = np.abs(sent - position) > ARRIVED
        asked = (self._verdict == compiled.UNKNOWN) & (travel > _EARLIEST) & stands & away & (tracks["moved"] >= MOVED)
        if not asked.any():
            return asked, asked
        lever = self._levers(position)
        stuck = np.where(tracks["moves"] >= SETTLED, tracks["stuck"], np.maximum(tracks["stuck"], STICKS))
        beyond = travel - STICKING * stuck
        return asked & (lever > SHORT_LEVER) & (beyond > TRAVEL / lever), asked & (beyond > 0.0)

    def _levers(self, position: Array) -> Array:
        """Levers (B, n) [m/rad] of the tool, scaled to the reach of a myCobot 280.

        Joints of a longer arm stick over equal angles, so its tool goes farther.
        """
        levers = np.linalg.norm(position_kinematics(self._arm, position)[1], axis=-2) / length_size(self._arm)
        return np.maximum(levers, 1e-6)

    def _describe(self, b: int, j: int) -> str:
        track, name = self._tracks[b, j], self._arm.joint_names[j]
        seen = (
            f"{name}: the command moved {np.degrees(abs(track['travel'])):.1f} deg in "
            f"{self._last[b] - track['since']:.2f} s, the reading 0"
        )
        if self._verdict[b, j] == compiled.TURNING:
            return (
                f"{seen}; its servo gives {100 * track['load']:.0f} % of its torque, and one that stands would give "
                f"{100 * track['expected']:.0f} %: the joint turns and its encoder is dead; do not drive the arm "
                f"before servo and cable of {name} are replaced"
            )
        if self._verdict[b, j] == compiled.OVERDUE:
            push, width = np.degrees(abs(track["push"])), np.degrees(track["width"])
            seen += f", at a push of {push:.1f} deg, and in its diagnosis it stood up to {width:.1f}"
        return (
            f"{seen}; no load tells whether it is stuck, held or loaded more than in its diagnosis, or its encoder is "
            f"dead; if nothing holds or loads the arm, support it, switch it off, turn {name} by hand and see whether "
            "its reading changes"
        )


FEWEST = 50
"""rows of a line (chosen: two seconds)"""
STILL = 4
"""rows of a constant reading"""
AT_REST = np.radians(0.1)
"""[rad] allowed change of commands (chosen: an encoder count)"""
SURE = 4.0
"""Allowed error of a slope, times residual over spread"""
LEAST_ERROR = 0.01
"""relative, of a slope"""
LEAST_NOISE = 0.001
"""share of the largest torque (chosen: a register's count)"""
HUBER = 2.0
"""Robust deviations beyond which a row counts less"""
_ROUNDS = 20  # of reweighting (chosen: it settles in ten)
PER_MEDIAN = 1.4826
"""Standard deviation over median absolute residual, normal"""


def servo_lines(arm: Arm, logs: Sequence[RunLog]) -> Knowledge | None:
    """Fit the load lines of an arm's servos; None without loads.

    A servo's torque is proportional to its error: loads of stationary joints lie on a line over command minus reading.
    """
    told = [(log, log.servo_load) for log in logs if log.servo_load is not None]
    if not told:
        return None
    rows = [_standing(arm, log, load) for log, load in told]
    lines = [_line(*(np.concatenate([part[k][:, j] for part in rows]) for k in range(3))) for j in range(arm.joints)]
    gain, offset, within, noise = np.array(lines).T
    within = np.where(within < compiled.KNOWN, within, np.inf)
    known = Knowledge(gain=gain, offset=offset / gain, within=within, noise=noise)
    for log, _ in told:
        known = replace(known, within=np.where(_turns(arm, log, known), np.inf, known.within))
    return known if np.isfinite(known.within).any() else None


def _standing(arm: Arm, log: RunLog, load: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Leads and loads (T, n) of a log, and where (T, n) they count."""
    low, high = commands_in_force(log)
    lead = 0.5 * (low + high) - log.position
    moved = np.vstack([np.ones((1, arm.joints), dtype=bool), np.diff(log.position, axis=0) != 0.0])
    last = np.maximum.accumulate(np.where(moved, np.arange(len(log))[:, None], 0), axis=0)
    stands = np.arange(len(log))[:, None] - last >= STILL
    dead = compiled.COUNTS * arm.encoder_step
    told = np.abs(load) < compiled.FULL  # not where it is NaN
    return lead, load, stands & told & (high - low < AT_REST) & (np.abs(lead) > dead)


def commands_in_force(log: RunLog) -> tuple[Array, Array]:
    """Lowest and highest possible command in force (T, n) [rad]."""
    rows = np.arange(len(log))
    oldest = np.searchsorted(log.time, log.time - compiled.SETTLE, side="right") - 1
    low = high = log.command[np.maximum(rows - 1, 0)]
    for back in range(2, compiled.HISTORY + 1):
        command = log.command[np.maximum(np.maximum(rows - back, oldest), 0)]
        low, high = np.minimum(low, command), np.maximum(high, command)
    return low, high


def _line(lead: Array, load: Array, use: NDArray[np.bool_]) -> tuple[float, float, float, float]:
    lead, load = lead[use], load[use]
    unknown = (1.0, 0.0, np.inf, 1.0)
    if len(lead) < FEWEST or np.ptp(lead) == 0.0:
        return unknown
    (slope, offset), noise = robust_fit(np.stack([lead, np.ones_like(lead)], axis=-1), load, LEAST_NOISE)
    if slope <= 0.0:
        return unknown
    return float(slope), float(offset), LEAST_ERROR + SURE * noise / (slope * float(lead.std())), noise


def robust_fit(columns: Array, value: Array, least: float) -> tuple[Array, float]:
    """Coefficients (k,) of ``columns`` (N, k) for ``value`` (N,), and the noise, at least ``least`` (Huber)."""
    weight = np.ones_like(value)
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)
        found = np.linalg.lstsq(columns * root[:, None], value * root)[0]
        off = np.abs(value - columns @ found)
        noise = max(PER_MEDIAN * float(np.median(off)), least)
        weight = np.minimum(1.0, HUBER * noise / np.maximum(off, 1e-12))
    return np.asarray(found), noise


def _turns(arm: Arm, log: RunLog, known: Knowledge) -> NDArray[np.bool_]:
    """Joints (n,) flagged as turning in a healthy arm's log."""
    states = states_of(log)
    following, found = Following(arm, next(states), log.command[:1], known), np.zeros(arm.joints, dtype=bool)
    for row, state in enumerate(states):
        bad = following.check(state, log.command[row : row + 1], np.zeros(1, dtype=bool))
        if bad is not None:
            found |= bad[0]
    return found


HELD = 0.05
"""[s] of a push"""
FEWEST_MOVING = 100
"""moving rows of a balance"""
SLOWEST, FASTEST = 0.04, 0.4
"""[rad/s]"""
AVERAGED = 5
"""rows"""
LEAST_GRAVITY = 0.04
"""smallest fitted range of gravity over the largest"""
REACHES = np.radians(np.geomspace(20.0, 0.3, 30))
"""[rad]; the longest of equals counts"""
WIDER, _OFTEN = 1.25, 12
"""Factor on exceeded bands, and repetitions"""


def standing_bands(arm: Arm, logs: Sequence[RunLog]) -> Bands:
    """Fit the friction bands of an arm's joints; hardly moved joints stay unknown.

    The balance is fitted to slow motion in both directions. The width is the largest push of a joint stationary for
    `HELD`; the reach minimises it.
    """
    logs = [log for log in logs if len(log) > FEWEST]
    slope, offset, lifted, known = _balances(arm, logs)
    endless = np.full(arm.joints, np.inf)
    found = Bands(slope=slope, offset=offset, reach=endless, width=endless, lifted=lifted)
    if not known.any():
        return found
    leads = [_leads(log, found.balance(arm, log.position)) for log in logs]
    reach, width = _narrowest(arm, logs, leads)
    width = np.where(known, width, np.inf)
    for _ in range(_OFTEN):
        late = np.zeros(arm.joints, dtype=bool)
        for log, lead in zip(logs, leads, strict=True):
            late |= _overdue(log, _push(lead, reach), width)
        if not late.any():
            break
        width = np.where(late, WIDER * width, width)
    return replace(found, reach=reach, width=np.where(late, np.inf, width))


Leads = tuple[Array, Array, Array]
"""Lowest and highest lead (T, n) [rad], and the balance"""


def _leads(log: RunLog, balance: Array) -> Leads:
    low, high = commands_in_force(log)
    return low - log.position, high - log.position, balance


def _push(leads: Leads, reach: Array) -> Array:
    """Least pushes (T, n) [rad] away from the balance."""
    low, high, balance = leads
    least, most = (between(lead, -reach, reach) - balance for lead in (low, high))
    return np.maximum(least, 0.0) + np.minimum(most, 0.0)


def _balances(arm: Arm, logs: Sequence[RunLog]) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Slope (n,) [rad/(N m)] and offset (n,) [rad] of the balance, what was lifted, and where (n,) they are known."""
    slope, offset, known = np.zeros(arm.joints), np.zeros(arm.joints), np.zeros(arm.joints, dtype=bool)
    if not logs:
        return slope, offset, offset, known
    parts = [_in_motion(arm, log) for log in logs]
    lead, gravity, speed, moving = (np.concatenate([part[k] for part in parts]) for k in range(4))
    loaded = np.ptp(gravity, axis=0) > LEAST_GRAVITY * np.ptp(gravity, axis=0).max()
    for j in range(arm.joints):
        use = moving[:, j].astype(bool)
        known[j] = np.count_nonzero(use) >= FEWEST_MOVING
        if known[j]:
            columns = [loaded[j] * gravity[use, j], np.ones(use.sum()), np.sign(speed[use, j]), speed[use, j]]
            slope[j], offset[j] = robust_fit(np.stack(columns, axis=-1), lead[use, j], 1e-6)[0][:2]
    slope = np.where(loaded, slope, 0.0)
    against = moving * np.sign(speed) * (slope * gravity + offset)
    return slope, offset, against.max(axis=0, initial=0.0), known


def _in_motion(arm: Arm, log: RunLog) -> tuple[Array, Array, Array, Array]:
    """Mean lead, gravity torque, speed (T, n), and slow motion (1 or 0)."""
    low, high = commands_in_force(log)
    speed = np.gradient(log.position, log.time, axis=0)
    mean = np.ones(AVERAGED) / AVERAGED
    speed = np.stack([np.convolve(speed[:, j], mean, "same") for j in range(arm.joints)], axis=-1)
    slow = (np.abs(speed) > SLOWEST) & (np.abs(speed) < FASTEST)
    return 0.5 * (low + high) - log.position, gravity_torque(arm, log.position), speed, slow.astype(float)


def _narrowest(arm: Arm, logs: Sequence[RunLog], leads: Sequence[Leads]) -> tuple[Array, Array]:
    """Reach and width (n,) [rad] of the narrowest bands."""
    pairs = list(zip(logs, leads, strict=True))
    held = [[_held(log, _push(lead, np.full(arm.joints, tried))) for log, lead in pairs] for tried in REACHES]
    width = np.maximum(np.max(held, axis=1), arm.encoder_step)
    best = np.argmax(REACHES[:, None] / width, axis=0)
    return REACHES[best], width[best, np.arange(arm.joints)]


def _held(log: RunLog, push: Array) -> Array:
    """Largest push (n,) [rad] of joints stationary for `HELD`."""
    readings = 1 + max(1, round(HELD / float(np.median(np.diff(log.time)))))
    stands = np.vstack([np.zeros((1, push.shape[1]), dtype=bool), np.diff(log.position, axis=0) == 0.0])
    windows = np.lib.stride_tricks.sliding_window_view(np.where(stands, push, 0.0), readings, axis=0)
    return np.asarray(np.maximum(windows.min(axis=-1), -windows.max(axis=-1)).max(axis=0))


def _overdue(log: RunLog, push: Array, width: Array) -> NDArray[np.bool_]:
    tracks, found = np.zeros(len(width), compiled.TRACK), np.zeros(len(width), dtype=bool)
    tracks["width"] = width
    compiled.fill_overdue(tracks, plain(log.time), plain(log.position), plain(push), found)
    return found
