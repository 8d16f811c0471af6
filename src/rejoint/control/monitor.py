"""The joint monitor: finds stuck joints and dead encoders.

Constants without a source are chosen.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rejoint.arms import Arm, Array, Mask, gravity_torque, levers, tcp_position
from rejoint.arms.workspace import length_size
from rejoint.control.correction import tool_error
from rejoint.control.robot import JointState
from rejoint.logs.runlog import RunLog
from rejoint.system.records import entity
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
FAR, AWAY, PUSHED, DROP = *np.radians([30.0, 20.0, 4.0]), 0.10
"""[rad] off its goal, moved away from it, and pushed towards it, and [m] of a myCobot 280's tool, of a falling joint"""
NEARER = np.radians(1.0)
"""[rad] by which a joint comes nearer"""
PULL = 2.0
"""times the allowed push, to pull an overdue joint back"""
_EARLIEST = np.radians(2.0)  # [rad] travel from which levers are computed (chosen: 10 mm at 0.28 m)


@entity
class Bands:
    """Friction bands from `standing_bands`: pushes at which joints do not move; (n,) or (B, n). By default unknown.

    Lead: command minus reading. Push: lead beyond the balance.
    """

    slope: Array | float = 0.0
    """[rad/(N m)] lead per gravity torque"""
    offset: Array | float = 0.0
    """[rad] lead without load"""
    reach: Array | float = np.inf
    """[rad] lead of the largest torque"""
    width: Array | float = np.inf
    """[rad] largest push of a stationary joint; infinite: unknown"""
    stood: Array | float = 0.0
    """[rad] the same, also where the balance is unknown"""
    lifted: Array | float = 0.0
    """[rad] largest lead against gravity at which the joint moved on; above it the motor may be too weak"""

    def balance(self, arm: Arm, position: Array) -> Array:
        """Leads (..., n) [rad] against gravity at ``position`` (..., n) [rad]."""
        return self.slope * gravity_torque(arm, position) + self.offset


class Following:
    """Monitors B arms; one `check` per cycle."""

    def __init__(self, arm: Arm, state: JointState, sent: Array, bands: Bands | None = None) -> None:
        """Begin at ``state`` after ``sent`` (B, n) [rad]."""
        count, joints = state.position.shape
        self._arm, self._bands, self._last = arm, bands or Bands(), np.zeros(count)
        self._tracks = np.zeros((count, joints), compiled.TRACK)
        self._tracks["home"] = state.position
        self._tracks["reach"], self._tracks["width"] = self._bands.reach, self._bands.width
        self._sent_at, self._sent = np.zeros((count, compiled.HISTORY)), np.zeros((count, compiled.HISTORY, joints))
        self._verdict = np.zeros((count, joints), dtype=np.int64)
        self._excused_since, self._excused_last = np.full((2, count), -np.inf)
        self._anchor = state.position  # (B, n) [rad] where the joints came nearer their goals
        self.falling = np.full((count, joints), False)
        """(B, n) joints that move away against their commands"""
        self._restart(np.full(count, True), state, sent)

    def _restart(self, where: Mask, state: JointState, sent: Array) -> None:
        """Begin at ``state`` after ``sent`` (B, n) [rad] for the arms in ``where`` (B,)."""
        tracks = self._tracks
        tracks["position"][where], tracks["held"][where] = state.position[where], sent[where]
        tracks["since"][where] = state.time[where, None]
        for name in ("travel", "pushed", "due", "still", "late"):
            tracks[name][where] = 0
        self._verdict[where] = compiled.FINE
        self._anchor = np.where(where[:, None], state.position, self._anchor)
        self._last[where] = state.time[where]
        self._sent_at[where] = state.time[where, None]
        self._sent[where] = sent[where, None]

    def check(self, state: JointState, sent: Array, aimed: Mask, goal: Array | None = None) -> Mask:
        """Joints (B, n) flagged after ``sent`` (B, n) [rad]; falling ones only with a ``goal`` (B, n).

        Travel counts only for arms ``aimed`` (B,) at a target.
        """
        compiled.watch(
            self._tracks,
            self._sent_at,
            self._sent,
            np.array([state.time, self._last]),
            np.array([state.position, sent, state.known_load, self._bands.balance(self._arm, state.position)]),
            self._verdict,
        )
        self._last = state.time.copy()
        if goal is not None:
            self._fall(state.position, sent, goal)
        travelled, more = self._travelled(state.position, sent)
        bad = (self._verdict == compiled.OVERDUE) | self.falling | (travelled & aimed[:, None])
        late = (self._tracks["late"] > 0) | more
        return bad & ~self._excused(bad, late)[:, None]

    def _fall(self, position: Array, sent: Array, goal: Array) -> None:
        """Look for falling joints at a ``position`` after ``sent`` with a ``goal`` (B, n) [rad]."""
        left = goal - position
        way = np.sign(left)
        far = np.abs(left) > FAR
        came = (position - self._anchor) * way
        self._anchor = np.where(~far | (came > NEARER), position, self._anchor)
        self.falling = far & (came < -AWAY) & ((sent - position) * way > PUSHED)
        if self.falling.any():
            off = tool_error(self._arm, position, tcp_position(self._arm, goal))
            self.falling = self.falling & (off[:, None] > DROP * length_size(self._arm))

    @property
    def moved(self) -> Mask:
        """Joints (B, n) that have moved by `MOVED`."""
        return self._tracks["moved"] >= MOVED

    def _excused(self, bad: Mask, late: Mask) -> Mask:
        """Arms (B,) late as a whole: a ``bad`` and another ``late`` joint, (B, n)."""
        now, several = self._last, bad.any(axis=-1) & ((bad | late).sum(axis=-1) > 1)
        self._excused_since = np.where(several & (now - self._excused_last > EXCUSED), now, self._excused_since)
        self._excused_last = np.where(several, now, self._excused_last)
        return several & (now - self._excused_since < EXCUSED)

    def bound(self, wanted: Array, position: Array, aimed: Mask) -> Array:
        """Keep ``wanted`` (B, n) [rad] near constant readings: within `TRAVEL`, or where the joint may still stand."""
        held = self._tracks["held"]
        far = ~self.moved & (np.abs(wanted - held) > _EARLIEST) & aimed[:, None]
        if not far.any():
            return wanted
        reach = TRAVEL / self._levers(position)
        balance = self._bands.balance(self._arm, position)
        stands = compiled.MOST * (self._bands.stood + np.abs(balance)) + 2.0 * compiled.AND  # then it is overdue
        reach = np.clip(stands, reach, reach + STICKING * STICKS)
        return np.where(far, np.clip(wanted, held - reach, held + reach), wanted)

    def believe(self, state: JointState, sent: Array, joints: Mask) -> None:
        """Trust ``joints`` (B, n) again after ``sent`` (B, n) [rad]."""
        tracks, load = self._tracks, self._bands.balance(self._arm, self._tracks["position"])
        push, width = tracks["push"], tracks["width"]
        weak = joints & (push * load > 0.0) & (np.abs(load) > self._bands.lifted)
        tracks["reach"] = np.where(weak, np.minimum(tracks["reach"], np.abs(load) + width), tracks["reach"])
        tracks["width"] = np.where(joints & ~weak, np.maximum(width, np.abs(push) / compiled.MOST), width)
        self._restart(np.logical_or.reduce(joints, axis=-1), state, sent)

    def balance(self, joints: Mask, sent: Array) -> Array:
        """Return holding commands (B, n) [rad]: ``sent``, or the last equilibrium of ``joints`` (B, n)."""
        return np.where(joints, self._tracks["held"], sent)

    def pulled(self, joints: Mask, sent: Array) -> Array:
        """Commands (B, n) [rad] that move overdue ``joints`` (B, n) back; else `balance`.

        A weak motor can move a held joint back.
        """
        tracks, overdue = self._tracks, joints & (self._verdict == compiled.OVERDUE)
        width = np.where(overdue, tracks["width"], 0.0)
        pull = PULL * (compiled.MOST * width + np.minimum(compiled.AND, width)) * np.sign(tracks["push"])
        position = tracks["position"]
        return np.where(overdue, position + self._bands.balance(self._arm, position) - pull, self.balance(joints, sent))

    def _travelled(self, position: Array, sent: Array) -> tuple[Mask, Mask]:
        """Joints (B, n) without a known band whose commands are far from a constant reading."""
        tracks, travel = self._tracks, np.abs(self._tracks["travel"])
        unknown = (self._verdict == compiled.UNKNOWN) & np.isinf(tracks["width"])
        stands = self._last[:, None] - tracks["since"] > TURN_ROUND
        away = np.abs(sent - position) > ARRIVED
        asked = unknown & (travel > _EARLIEST) & stands & away & self.moved
        if not asked.any():
            return asked, asked
        lever = self._levers(position)
        stuck = np.where(tracks["moves"] >= SETTLED, tracks["stuck"], np.maximum(tracks["stuck"], STICKS))
        beyond = travel - STICKING * stuck
        return asked & (lever > SHORT_LEVER) & (beyond > TRAVEL / lever), asked & (beyond > 0.0)

    def _levers(self, position: Array) -> Array:
        """Levers (B, n) [m/rad] of the tool, scaled to the reach of a myCobot 280."""
        return np.maximum(levers(self._arm, position) / length_size(self._arm), 1e-6)

    def describe(self, b: int, j: int) -> str:
        """Describe the finding on joint ``j`` of arm ``b``, with advice."""
        track, name = self._tracks[b, j], self._arm.joint_names[j]
        if self.falling[b, j]:
            return (
                f"{name}: it moves away from its goal; it has no torque, too little for its load, or a wrong "
                "reading, or it swings: support the arm before you switch it off"
            )
        seen = (
            f"{name}: the command moved {np.degrees(abs(track['travel'])):.1f} deg in "
            f"{self._last[b] - track['since']:.2f} s, the reading 0"
        )
        if self._verdict[b, j] == compiled.OVERDUE:
            push, width = np.degrees(abs(track["push"])), np.degrees(track["width"])
            seen += f", at a push of {push:.1f} deg, and by its diagnosis it stands up to {width:.1f}"
        return (
            f"{seen}; it is held or stuck, its load is too heavy or not the declared one, or its encoder is dead: "
            f"support the arm, switch it off, turn {name} by hand and see whether its reading changes"
        )


FEWEST = 50
"""rows of a log that counts (chosen: two seconds)"""


def commands_in_force(log: RunLog) -> tuple[Array, Array]:
    """Lowest and highest possible command in force (T, n) [rad]."""
    oldest = np.searchsorted(log.time, log.time - compiled.SETTLE, side="right") - 1
    rows = np.arange(len(log))[:, None] - np.arange(1, compiled.HISTORY + 1)
    commands = log.command[np.maximum(np.maximum(rows, oldest[:, None]), 0)]
    return commands.min(axis=1), commands.max(axis=1)


def doubted(arm: Arm, logs: Sequence[RunLog], bands: Bands) -> Mask:
    """Joints (n,) of a whole arm that the monitor flags somewhere in its ``logs``, or that move in none."""
    found, moved = np.full((2, arm.joints), False)
    for log in logs:
        following = Following(arm, _state(log, 0), log.command[:1], bands)
        for row in range(1, len(log)):
            found |= following.check(_state(log, row), log.command[row - 1 : row], np.full(1, False))[0]
        moved |= following.moved[0]
    return found | ~moved


def _state(log: RunLog, row: int) -> JointState:
    rows = slice(row, row + 1)
    load = None if log.servo_load is None else log.servo_load[rows]
    return JointState(time=log.time[rows], position=log.position[rows], age=np.zeros(1), load=load)


HELD = 0.05
"""[s] of a push"""
SPAN, LIFTED = 0.25, 0.01
"""[s], and least way in it [rad] of a joint that moves"""
REACHES = np.radians(np.geomspace(20.0, 0.3, 30))
"""[rad]; the longest of equals counts"""


def standing_bands(arm: Arm, logs: Sequence[RunLog], softness: Array, offset: Array) -> Bands:
    """Friction bands of an arm's joints from the ``logs`` of its diagnosis.

    ``softness`` (n,) [rad/(N m)] and ``offset`` (n,) [rad] are those of the balance; joints with a NaN, or flagged in
    these logs, stay unknown. The width is the largest push of a joint stationary for `HELD`, at
    least the least reach; the reach minimises it.
    """
    logs, known = [log for log in logs if len(log) > FEWEST], np.isfinite(softness + offset)
    found = Bands(slope=np.where(known, softness, 0.0), offset=np.where(known, offset, 0.0))
    if not logs:
        return found
    balances = [found.balance(arm, log.position) for log in logs]
    lifted = np.max([_lifted(log, balance) for log, balance in zip(logs, balances, strict=True)], axis=0)
    reach, width = _narrowest(arm, logs, balances)
    found = replace(found, lifted=lifted, reach=reach, stood=width, width=np.where(known, width, np.inf))
    off = doubted(arm, logs, found)
    return replace(found, stood=np.where(off, 0.0, found.stood), width=np.where(off, np.inf, found.width))


def _lifted(log: RunLog, balance: Array) -> Array:
    """Largest lead (n,) [rad] against gravity at which a joint moved on."""
    span = max(1, round(SPAN / log.period))
    way = log.position[span:] - log.position[:-span]
    against = np.where(np.abs(way) > LIFTED, np.sign(way) * balance[span // 2 :][: len(way)], 0.0)
    return against.max(axis=0, initial=0.0)


def _narrowest(arm: Arm, logs: Sequence[RunLog], balances: Sequence[Array]) -> tuple[Array, Array]:
    """Reach and width (n,) [rad] of the narrowest bands."""
    leads = [np.array(commands_in_force(log)) - log.position for log in logs]
    held = [
        [
            _held(log, compiled.push.py_func(*lead, balance, reach))
            for log, lead, balance in zip(logs, leads, balances, strict=True)
        ]
        for reach in REACHES
    ]
    width = np.maximum(np.max(held, axis=1), max(arm.encoder_step, REACHES[-1]))
    best = np.argmax(REACHES[:, None] / width, axis=0)
    return REACHES[best], width[best, np.arange(arm.joints)]


def _held(log: RunLog, push: Array) -> Array:
    """Largest push (n,) [rad] of joints stationary for `HELD`."""
    readings = 1 + max(1, round(HELD / log.period))
    stands = np.diff(log.position, axis=0, prepend=np.nan) == 0.0
    windows = np.lib.stride_tricks.sliding_window_view(np.where(stands, push, 0.0), readings, axis=0)
    return np.maximum(windows.min(axis=-1), -windows.max(axis=-1)).max(axis=0)
