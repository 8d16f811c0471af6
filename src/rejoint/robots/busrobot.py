"""One arm behind its bus."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from itertools import compress
from pkgutil import resolve_name
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, Mask
from rejoint.control.loop import elsewhere
from rejoint.control.recording import GAP
from rejoint.control.robot import JointState, Robot
from rejoint.control.servogains import ServoGains
from rejoint.robots.bus import Bus, Link, Reading, Vitals
from rejoint.robots.family import Family, Opening, Place
from rejoint.system.errors import AddressError, ImpossibleReplyError, InputError, NoReplyError, StaleReplyError

RANGE_MARGIN = np.radians(5.0)
"""[rad] beyond a joint limit by sag and stops (chosen)"""
MAX_SPEED_FACTOR = 2.0
"""Times the arm's speed limit (chosen: above no-load speed)"""
JUMP_SLACK = np.radians(5.0)
"""[rad] for answers sampled up to 30 ms before arrival (chosen)"""
DOUBT = 1.0
"""[s] for which a doubtful answer stays impossible (chosen)"""
SURE = 0.1
"""[s] of full speed in a single answer (chosen: two periods of a slow wire)"""
COMMAND_TRAVEL = np.radians(10.0)
"""[rad] of a command that moves a joint by an encoder step (chosen)"""
COMMANDED_JOINTS = 2
"""joints with such commands (chosen: one may be stuck)"""
REPEAT_GRACE = 0.3
"""[s] of equal answers by latency and acceleration (chosen)"""
REPEAT_LIMIT = 1.5
"""[s] of equal answers under a changed command (chosen)"""


def judge(position: Array, arm: Arm) -> None:
    """Raise ImpossibleReplyError for impossible positions (n,) [rad]; NaN: unknown."""
    unreadable = np.isnan(position)
    if unreadable.any():
        names = ", ".join(compress(arm.joint_names, unreadable))
        raise ImpossibleReplyError(f"the servos of {names} cannot be read")
    outside = (position < arm.lower - RANGE_MARGIN) | (position > arm.upper + RANGE_MARGIN)
    if outside.any():
        j = np.argmax(outside)
        raise ImpossibleReplyError(
            f"{arm.joint_names[j]} reads {np.degrees(position[j]):.1f} deg, outside the arm's range of "
            f"{np.degrees(arm.lower[j]):.0f} to {np.degrees(arm.upper[j]):.0f} deg by more than "
            f"{np.degrees(RANGE_MARGIN):.0f}: it fell or was pushed there, or its zero or the answer is wrong"
        )


class Continuity:
    """Compares every answer with the last one and the commands."""

    def __init__(self, arm: Arm) -> None:
        self._max_speed = MAX_SPEED_FACTOR * arm.max_speed
        self._accepted: deque[tuple[float, Array]] = deque(maxlen=2)
        self._doubted: float | None = None
        self._candidate: Array | None = None
        self._command_then: Array | None = None
        self._waiting_since: float | None = None

    def check(self, time: float, position: Array) -> None:
        """Raise ImpossibleReplyError if no servo can reach ``position`` (n,) [rad] by ``time`` [s].

        After a pause two answers must agree.
        """
        if not self._accepted:
            return
        if self._doubted is not None and time - self._doubted < DOUBT:
            time = self._doubted
        (earlier, first), (then, before) = self._accepted[0], self._accepted[-1]
        gone, elapsed = np.abs(position - before), time - then
        jumped, sudden = gone > self._reach(elapsed), gone > self._reach(min(elapsed, SURE))
        agreed = self._candidate is not None and (np.abs(position - self._candidate) <= JUMP_SLACK).all()
        self._doubted = time if jumped.any() else None
        if jumped.any() and len(self._accepted) > 1:  # two answers are sure
            agreed = agreed and (np.abs(position - first) <= self._reach(time - earlier)).all()
        if sudden.any() and not agreed:
            self._candidate = position
            i = np.argmax(jumped if jumped.any() else sudden)
            says = "cannot have jumped" if jumped.any() else "is said, once, to have gone"
            raise ImpossibleReplyError(
                f"joint {i + 1} {says} from {np.degrees(before[i]):.1f} to {np.degrees(position[i]):.1f} deg in "
                f"{elapsed:.3f} s"
            )
        self._candidate = None

    def _reach(self, elapsed: float) -> Array:
        """Return how far (n,) [rad] joints may seem to go in ``elapsed`` [s]."""
        return self._max_speed * max(elapsed, 0.0) + JUMP_SLACK

    def accept(self, time: float, position: Array, command: Array | None) -> float:
        """Take an answer; return its age [s]: how long it should have changed.

        StaleReplyError when that lasts.
        """
        if not self._accepted or np.any(position != self._accepted[-1][1]):
            self._command_then, self._waiting_since = command, None
        elif command is not None and self._command_then is None:
            self._command_then = self._accepted[-1][1]
        self._accepted.append((time, position))
        self._doubted = None
        if command is None or self._command_then is None:
            return 0.0
        if self._waiting_since is None:
            if np.count_nonzero(np.abs(command - self._command_then) > COMMAND_TRAVEL) >= COMMANDED_JOINTS:
                self._waiting_since = time
            return 0.0
        age = time - self._waiting_since
        if age > REPEAT_LIMIT:
            raise StaleReplyError(
                f"the same joint angles for {age:.1f} s although the command moved by more than "
                f"{np.degrees(COMMAND_TRAVEL):.0f} deg: the answers are old, or the arm is blocked or switched off"
            )
        return age if age > REPEAT_GRACE else 0.0


DOUBTS = 5
"""Repeated questions after an alarm (chosen)"""

INTERVAL = 1.0
"""[s] between questions (chosen)"""
# Times what a question costs that a cycle must have left for one (chosen: answers jitter)
_SPARE = 1.5
_SMOOTHING = 0.2  # share of the newest cost in its running mean

V = TypeVar("V", bound=Vitals)


def believed(ask: Callable[[], V], joints: int) -> V:
    """Ask again after an alarm until two answers agree; copies arrays (n,). ImpossibleReplyError for another shape."""
    found = _copied(ask(), joints)
    for _ in range(DOUBTS if found.alarming else 0):
        before, found = found, _copied(ask(), joints)
        if not found.alarming or found.agrees(before):
            break
    return found


def _copied(found: V, joints: int) -> V:
    if not isinstance(found, Vitals):
        raise InputError(f"the driver of this arm returned {type(found).__name__}, expected a Reading, or Vitals")
    arrays: dict[str, Any] = {}
    for name, value in vars(found).items():
        if value is not None and name != "trouble":
            arrays[name] = np.array(value, bool if name == "fault" else float)
            if arrays[name].shape != (joints,):
                raise ImpossibleReplyError(f"expected {joints} values of {name}, got {value!r}")
    return replace(found, **arrays)


T = TypeVar("T")


class BusRobot:
    """One arm behind a bus; ``period`` [s]: uniform cycle lengths."""

    def __init__(
        self, bus: Bus, arm: Arm, *, address: str, period: tuple[float, float] = (0.050, 0.050), seed: int = 0
    ) -> None:
        self.arm, self.address, self.count = arm, address, 1
        self.bus, self._period, self._clock = bus, period, bus.clock
        self._link = Link(bus, address)
        self.open, self.close = self._link.open, self._link.close
        self.servo_gains, self.rungs = bus.servo_gains, bus.rungs
        self._rng = np.random.default_rng(seed)
        self._continuity = Continuity(arm)
        self._questions, self._known = list(bus.vitals()), Vitals()
        # when [s] the next of the questions is due, and what one of them and a reading cost [s]
        self._due = self._cost = self._read_cost = 0.0
        self._command: Array | None = None
        self._state: JointState | None = None
        # when [s] and where (1, n) the arm was last seen before a command, and the command (1, n)
        self._left: tuple[float, Array, Array] | None = None

    def read(self) -> JointState:
        """Ask for the joint positions; RobotError."""
        if self._state is None:
            for _ in range(len(self._questions)):  # this firmware may not answer all of them
                try:
                    self._ask_next()
                except NoReplyError:
                    self._questions.pop()  # the one that was asked
        now, reading = self._link.ask(self._read_once)
        self._take(reading)
        servos = self._known
        self._state = JointState(
            time=np.array([now]),
            position=reading.position[None],
            age=np.array([self._continuity.accept(now, reading.position, self._command)]),
            temperature=_batch(servos.temperature),
            fault=_batch(servos.fault),
            trouble=servos.trouble,
            load=_batch(reading.load),
            voltage=_batch(reading.voltage),
            elsewhere=self._elsewhere(now, reading.position[None]),
        )
        return self._state

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Send ``command`` (1, n) [rad], wait a period, read."""
        if command.shape != (1, self.arm.joints) or not np.isfinite(command).all():
            raise InputError(
                f"expected finite joint positions of shape (1, {self.arm.joints}), got {np.shape(command)}"
            )
        last = self._state or self.read()
        if active is not None and not active[0]:
            return last
        period = self._rng.uniform(*self._period)
        due = max(last.time[0], self._clock.now() - period / 2) + period  # even a late command gets half of it
        goal = self._command = command[0].copy()
        self._left = last.time[0], last.position, command.copy()
        began = self._clock.now()

        def send() -> None:
            if self._clock.now() - began <= GAP:  # after a pause the arm is looked at first: it may stand elsewhere
                self.bus.send(goal.copy())  # a bus may reckon in place, and may be asked again

        self._link.ask(send)
        ask_at = due - self._read_cost
        if self._questions and (ask_at - self._clock.now() > _SPARE * self._cost or self._clock.now() >= self._due):
            self._ask_next()
        self._clock.wait(ask_at - self._clock.now())
        return self.read()

    def true_tcp(self) -> Array:
        """(1, 3) NaN: unknown."""
        return np.full((1, 3), np.nan)

    def stop(self) -> None:
        """Hold; the power stays on."""
        self._link.ask(self.bus.stop)
        self._command = None

    def tune(self, gains: ServoGains) -> None:
        """Set gains in small steps, see `Bus.tune`."""
        self._left = None  # under other gains it sags elsewhere
        self._link.ask(lambda: self.bus.tune(gains))

    def keep(self, gains: ServoGains) -> None:
        """Set gains permanently, see `Bus.keep`."""
        self._left = None
        self._link.ask(lambda: self.bus.keep(gains))

    def relay(self, command: int, payload: bytes) -> bytes | None:
        """Ask another device, see `Bus.relay`."""
        return self._link.ask(lambda: self.bus.relay(command, payload))

    def _ask_next(self) -> None:
        began, question = self._clock.now(), self._questions.pop(0)
        self._questions.append(question)
        self._take(self._link.ask(lambda: believed(question, self.arm.joints)))
        now = self._clock.now()
        self._cost = _mean(self._cost, now - began)
        self._due = now + INTERVAL

    def _take(self, found: Vitals) -> None:
        if found.temperature is not None:
            self._known = replace(self._known, temperature=found.temperature)
        if found.fault is not None:
            self._known = replace(self._known, fault=found.fault, trouble=found.trouble)

    def _elsewhere(self, now: float, position: Array) -> Mask:
        if self._left is None or now - self._left[0] <= GAP:
            return np.zeros(1, dtype=bool)
        return elsewhere(*self._left[1:], position)

    def _read_once(self) -> tuple[float, Reading]:
        """Read and check; also returns the arrival [s]."""
        began = self._clock.now()
        reading = believed(self.bus.read, self.arm.joints)
        now = self._clock.now()
        judge(reading.position, self.arm)
        self._continuity.check(now, reading.position)
        self._read_cost = _mean(self._read_cost, min(now - began, self._period[0]))
        return now, reading


def _mean(before: float, newest: float) -> float:
    """Take the newest value into a running mean; 0: it begins."""
    return before + (_SMOOTHING if before else 1.0) * (newest - before)


def _batch(values: NDArray[Any] | None) -> NDArray[Any] | None:
    return None if values is None else values[None]


def bus_family(
    bus: Callable[[T, Arm], Bus] | str,
    *,
    parse: Callable[[str], T],
    **options: Any,  # noqa: ANN401
) -> Family[T]:
    """Family of arms behind a ``bus`` of a parsed address, or behind ``package.module:name``, which is imported late.

    ``options`` as in `Family`.
    """

    def connect(place: Place[T], opening: Opening) -> Robot:
        made: Bus = (resolve_name(bus) if isinstance(bus, str) else bus)(place.detail, opening.arm)
        robot = BusRobot(made, opening.arm, address=place.text, period=opening.period, seed=opening.seed)
        try:
            robot.open()
        except AddressError as error:
            from rejoint.robots.ports import why_not  # late: it is seldom wanted

            if why := why_not(place, error):
                raise AddressError(why) from error
            raise
        return robot

    return Family(parse=parse, connect=connect, **options)
