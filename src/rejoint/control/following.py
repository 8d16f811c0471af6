"""The monitor of joints that do not follow: a stuck joint and a dead encoder look the same, until the load is asked.

A reading that stands still while its command moves belongs to one of three: a joint that is stuck, one whose
encoder tells the same for ever while the servo goes where it is sent (frozen), or one whose servo itself sees nothing
else (blind) and runs away as soon as it is moved. Three rules tell them apart, once per cycle:

* **Turning.** A servo gives a torque in proportion to the error that it sees. While a joint stands, its load is a line
  over command minus reading. A load off that line says that the joint turns although its reading does not: by its own
  feedback (frozen), or by the voltage that a turning motor induces (blind). It is believed when it is off by far, off
  for two cycles, or off by little for twelve. The line has to be known beforehand (`Knowledge`; `rejoint.control.lines`
  reads it from the arm's own diagnosis) and is made more precise from the joint itself while it stands; learned from
  nothing it only tells that a joint is stuck.
* **Push.** Where no such line is known, what stands is judged by how hard it is pushed. A servo pushes its joint by the
  command minus the reading, less what gravity takes of it; friction holds the joint up to some push and not beyond. At
  which pushes it stood when it was well is read from the arm's own diagnosis (`Bands`, `rejoint.control.bands`). One
  that is pushed harder must move, the sooner the harder; a reading that still stands then is a dead encoder, or a
  joint that got stuck since.
* **Travel.** Where there is no diagnosis, a command may leave the place where the reading last changed by so much and
  no more: as far as moves the tool by `TRAVEL`, and as far on top as joints stick. One whose reading has gone nowhere
  in this run is not judged but held within `TRAVEL`: a frozen encoder carries the tool no farther, and a stuck joint
  is let be.

Two encoders hardly die at once: where a second joint stands although it must move, or its load does not fit either, the
arm itself is late, and both are let be for `EXCUSED`.

After a trip the joint is led back to the command under which its reading last changed: there it was in balance, and a
blind servo gives the torque of then.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, gravity_torque, position_kinematics
from rejoint.control.law import plain
from rejoint.control.robot import JointState, Mask
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.late import Late

watching = Late("rejoint.control.watching")

TRAVEL = 0.020
"""[m] of the tool that a command may go beyond a reading that stands (chosen: 30 less what the arm coasts)."""
STICKING = 1.5
"""times as far as a joint was seen to stick may it stick again (chosen)"""
STICKS = np.radians(4.0)
"""[rad] that a joint is taken to stick where little is known of it (chosen: worn ones stick up to twice that)"""
SHORT_LEVER = 0.13
"""[m] joints nearer to the tool are not judged without load (chosen: 20 deg, the guard's longest lead, are 45 mm there;
a weak wrist joint stands at any lead)"""
MOVED = np.radians(2.0)
"""[rad] that a reading must have gone in this run before its joint is known to move (chosen: more than a stuck gear
yields)"""
TURN_ROUND = 0.12
"""[s] for which a reading must stand before it is judged without load (chosen: a joint that is sent to and fro by a
controller at its limits stands while it turns round)"""
EXCUSED = 0.15
"""[s] for which two joints at once are let be (chosen: a little longer than commands are late at most in `python -m
benchmarks.following --wires late`)"""
ARRIVED = np.radians(1.0)
"""[rad] of lead within which a joint that stands is where it was sent (chosen)"""
SETTLED = 30
"""changes of a reading after which it is known how far its joint sticks (chosen)"""
GAIN, GAIN_SPREAD = 20.0, 2.0
"""[1/rad] share of its largest torque that a servo gives per radian, and its relative standard deviation where nothing
is known (emulated arms: 7 to 35, and 64 with a failing motor)"""
LEAST_GAIN = 3.0
"""[1/rad] of any position servo (chosen: it gives all it has at the guard's longest lead)"""
OFFSET_SPREAD, UNKNOWN_OFFSET = 0.02, 0.15
"""standard deviations of the load at no lead, shares of the largest torque: where the offset of a servo is known, and
where it is not (chosen: a real SO-101 has 0.8 deg, which are 0.1)"""
_EARLIEST = np.radians(2.0)  # [rad] travel from which levers are computed (chosen: 10 mm at 0.28 m)
_UNKNOWN, _TURNING, _OVERDUE = 2, 3, 4  # as in `watching`, which is imported late


@dataclass(frozen=True, kw_only=True, eq=False)
class Knowledge:
    """What is known of the servos of an arm before it moves: read from their registers, or measured when it was well.

    `rejoint.control.lines.servo_lines` measures it. A twin does not have it: the largest torque of a joint that never
    gave it is a guess, and a gain with it.
    """

    gain: Array
    """(n,) or (B, n) [1/rad] share of its largest torque that a servo gives per radian of error"""
    offset: Array | float = 0.0
    """(n,) [rad] where a servo brings its joint without load, minus the command"""
    within: Array | float = 0.2
    """(n,) largest relative error of ``gain``; infinite where nothing is known (chosen: what values from a data sheet
    should reach)"""
    noise: Array | float = OFFSET_SPREAD
    """(n,) standard deviation of loads about that line, share of the largest torque"""

    def __post_init__(self) -> None:
        positive = [np.isfinite(self.gain).all(), np.all(self.gain > 0.0), np.all(self.within > 0.0)]
        if not (all(positive) and np.all(self.noise > 0.0)):
            raise InputError(
                f"following: gains, their errors and noises must be positive, got {self.gain}, {self.within} and "
                f"{self.noise}"
            )


def states_of(log: RunLog) -> Iterator[JointState]:
    """Give what was read in each row of a log."""
    for row in range(len(log)):
        rows = slice(row, row + 1)
        load = None if log.servo_load is None else log.servo_load[rows]
        yield JointState(time=log.time[rows], position=log.position[rows], age=np.zeros(1), load=load)


@dataclass(frozen=True, kw_only=True, eq=False)
class Bands:
    """At which pushes the joints of an arm stand; all (n,) or (B, n). `rejoint.control.bands` reads them from logs.

    The lead is the command minus the reading, the push what is left of it beyond the balance.
    """

    slope: Array
    """[rad/(N m)] lead that holds a newton metre of gravity"""
    offset: Array
    """[rad] lead that a joint without load is held by"""
    reach: Array
    """[rad] lead beyond which a servo gives no more torque"""
    width: Array
    """[rad] largest push at which a joint stood; infinite where nothing is known, and such joints are not judged"""

    def __post_init__(self) -> None:
        known = [np.isfinite(self.slope).all(), np.isfinite(self.offset).all()]
        if not (all(known) and np.all(self.reach > 0.0) and np.all(self.width > 0.0)):
            raise InputError(
                f"following: slopes and offsets of bands must be numbers, reach and width positive, got {self.slope}, "
                f"{self.offset}, {self.reach} and {self.width}"
            )

    def balance(self, arm: Arm, position: Array) -> Array:
        """Leads (..., n) [rad] that hold the ``arm`` against gravity at ``position`` (..., n) [rad]."""
        balance: Array = self.slope * gravity_torque(arm, position) + self.offset
        return balance


class Following:
    """Watches B arms; one `check` per cycle."""

    def __init__(
        self,
        arm: Arm,
        state: JointState,
        sent: Array,
        knowledge: Knowledge | None = None,
        *,
        bands: Bands | None = None,
    ) -> None:
        """Begin with the ``state`` in which ``sent`` (B, n) [rad] is in force."""
        self._bands = bands
        shape = state.position.shape
        self._arm, self._last = arm, state.time.copy()
        self._tracks = np.zeros(shape, watching.TRACK)
        self._tracks["position"] = self._tracks["home"] = state.position
        self._tracks["held"] = sent
        self._tracks["reach"] = np.inf if bands is None else bands.reach
        self._tracks["width"] = np.inf if bands is None else bands.width
        self._tracks["stuck"] = 0.0 if bands is None else 2.0 * bands.width  # from one end of the band to the other
        self._tracks["since"] = state.time[:, None]
        self._know(knowledge or Knowledge(gain=np.full(shape, GAIN), within=np.inf))
        self._sent_at = np.repeat(state.time[:, None], watching.HISTORY, axis=1)
        self._sent = np.repeat(np.asarray(sent, dtype=float)[:, None], watching.HISTORY, axis=1)
        self._verdict = np.zeros(shape, dtype=np.int64)
        self._nothing = np.zeros(shape)
        self._excused_since, self._excused_last = np.full((2, len(state.time)), -np.inf)
        self._loaded = False

    def _know(self, knowledge: Knowledge) -> None:
        """Begin with the lines that are given, and elsewhere with one that is to be learned."""
        tracks, shape = self._tracks, self._tracks.shape
        given = np.broadcast_to(np.isfinite(knowledge.within), shape)
        gain = np.where(given, knowledge.gain, GAIN)
        spread = np.where(given, knowledge.within, GAIN_SPREAD * watching.SURE) / watching.SURE
        tracks["given"], tracks["noise"] = given, knowledge.noise
        tracks["gain"], tracks["p00"] = gain, (spread * gain) ** 2
        tracks["least"] = np.maximum((1.0 - 2.0 * spread) * gain, LEAST_GAIN)
        tracks["offset"] = np.where(given, gain * knowledge.offset, 0.0)
        tracks["p11"] = np.where(given, knowledge.noise, UNKNOWN_OFFSET) ** 2

    def check(self, state: JointState, sent: Array, aimed: Mask) -> Mask | None:
        """Joints (B, n) that are not believed any more, None where all are.

        ``sent`` (B, n) [rad] is the command since the last check. Only arms that are ``aimed`` (B,) at a target are
        judged by their travel: on a given trajectory the tool stays on its way, and a diagnosis has to
        find stuck joints.
        """
        self._loaded = state.load is not None
        load = self._nothing if state.load is None else state.load
        balance = self._nothing if self._bands is None else self._bands.balance(self._arm, state.position)
        watching.watch(
            self._tracks, self._sent_at, self._sent, plain(state.time), self._last, plain(state.position),
            plain(sent), plain(load), self._loaded, plain(balance), self._arm.encoder_step, self._verdict,
        )  # fmt: skip
        self._last = state.time.copy()
        worst = self._verdict.max()
        if worst < _UNKNOWN:
            return None
        bad: Mask = self._verdict >= _TURNING
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
        """Arms (B,) that are late as a whole: beside a ``bad`` joint (B, n) another one is ``late`` (B, n)."""
        now, several = self._last, bad.any(axis=-1) & ((bad | late).sum(axis=-1) > 1)
        anew = several & (now - self._excused_last > EXCUSED)
        self._excused_since = np.where(anew, now, self._excused_since)
        self._excused_last = np.where(several, now, self._excused_last)
        excused: Mask = several & (now - self._excused_since < EXCUSED)
        return excused

    def bound(self, wanted: Array, position: Array, aimed: Mask) -> Array:
        """``wanted`` (B, n) [rad], where no load tells, within `TRAVEL` of a reading that has hardly ever changed."""
        if self._loaded:
            return wanted
        held = self._tracks["held"]
        far = (self._tracks["moved"] < MOVED) & (np.abs(wanted - held) > _EARLIEST) & aimed[:, None]
        if not far.any():
            return wanted
        reach = TRAVEL / self._levers(position)
        return np.where(far, np.minimum(np.maximum(wanted, held - reach), held + reach), wanted)

    def onward(self, way: Array) -> Array:
        """How far (B, n) [rad] joints that were gone by ``way`` (B, n) [rad] went where their commands had gone."""
        return way * np.sign(self._tracks["travel"])

    def believe(self, state: JointState, sent: Array, joints: Mask) -> None:
        """Believe ``joints`` (B, n) again that stood and broke loose; ``sent`` (B, n) [rad] is in force now.

        The push at which one broke loose is allowed from now on.
        """
        tracks, where = self._tracks, joints.any(axis=-1)
        stood = np.abs(tracks["push"]) / watching.MOST
        tracks["width"] = np.where(joints, np.maximum(tracks["width"], stood), tracks["width"])
        tracks["position"][where], tracks["held"][where] = state.position[where], sent[where]
        tracks["since"][where] = state.time[where, None]
        for name in ("travel", "pushed", "due", "still", "strikes", "steady", "full", "late"):
            tracks[name][where] = 0
        self._verdict[where] = watching.FINE
        self._last = np.where(where, state.time, self._last)
        self._sent_at[where] = state.time[where, None]
        self._sent[where] = sent[where, None]

    def balance(self, joints: Mask, sent: Array) -> Array:
        """Commands (B, n) [rad] to hold by: ``sent``, but ``joints`` (B, n) by those that they were in balance with."""
        return np.where(joints, self._tracks["held"], sent)

    def describe(self, b: int, joints: Mask) -> str:
        """Tell what was seen of the ``joints`` (n,) of arm ``b``, what it looks like, and what to do."""
        return "; ".join(self._describe(b, int(j)) for j in np.flatnonzero(joints))

    def _travelled(self, position: Array, sent: Array) -> tuple[Mask, Mask]:
        """Joints (B, n) whose commands have gone too far from a reading that stands, with no load to explain it.

        The second ones are all whose commands have gone farther than they were ever seen to stick.
        """
        tracks = self._tracks
        travel = np.abs(tracks["travel"])
        stands = self._last[:, None] - tracks["since"] > TURN_ROUND
        away = np.abs(sent - position) > ARRIVED
        asked = (self._verdict == _UNKNOWN) & (travel > _EARLIEST) & stands & away & (tracks["moved"] >= MOVED)
        if not asked.any():
            return asked, asked
        lever = self._levers(position)
        stuck = np.where(tracks["moves"] >= SETTLED, tracks["stuck"], np.maximum(tracks["stuck"], STICKS))
        beyond = travel - STICKING * stuck
        return asked & (lever > SHORT_LEVER) & (beyond > TRAVEL / lever), asked & (beyond > 0.0)

    def _levers(self, position: Array) -> Array:
        """How far (B, n) [m/rad] the tool goes with each joint."""
        return np.maximum(np.linalg.norm(position_kinematics(self._arm, position)[1], axis=-2), 1e-6)

    def _describe(self, b: int, j: int) -> str:
        track, name = self._tracks[b, j], self._arm.joint_names[j]
        seen = (
            f"{name}: the command moved {np.degrees(abs(track['travel'])):.1f} deg in "
            f"{self._last[b] - track['since']:.2f} s, the reading 0"
        )
        if self._verdict[b, j] == _TURNING:
            return (
                f"{seen}; its servo gives {100 * track['load']:.0f} % of its torque, and one that stands would give "
                f"{100 * track['expected']:.0f} %: the joint turns and its encoder is dead; do not drive the arm "
                f"before servo and cable of {name} are replaced"
            )
        if self._verdict[b, j] == _OVERDUE:
            push, width = np.degrees(abs(track["push"])), np.degrees(track["width"])
            seen += f", at a push of {push:.1f} deg, and in its diagnosis it stood up to {width:.1f}"
        return (
            f"{seen}; no load tells whether it is stuck, held or loaded more than in its diagnosis, or its encoder is "
            f"dead; if nothing holds or loads the arm, support it, switch it off, turn {name} by hand and see whether "
            "its reading changes"
        )
