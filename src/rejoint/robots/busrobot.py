"""One arm behind its bus: the control period, and what of its answers is believed, the same for every family.

One control cycle is: send the command, wait, read the joints so that the answer arrives one period after the last one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.robot import JointState, Mask, Robot
from rejoint.control.runstate import GAP, elsewhere
from rejoint.control.servogains import Rung, ServoGains
from rejoint.robots.bus import Bus, Reading
from rejoint.robots.family import DEFAULT_ARM, Family, Opening, Place
from rejoint.robots.health import Health, believed
from rejoint.robots.link import Link
from rejoint.robots.plausibility import Continuity, judge
from rejoint.system.errors import ImpossibleReplyError, InputError

_SMOOTHING = 0.2  # share of the newest cost of a reading in its running mean

T = TypeVar("T")


class BusRobot:
    """One arm behind a bus that is opened by `open`; its clock is that of the bus.

    Every cycle's length is drawn uniformly from ``period`` [s]; it is never shorter than the wire allows.
    """

    def __init__(
        self, bus: Bus, arm: Arm, *, address: str, period: tuple[float, float] = (0.050, 0.050), seed: int = 0
    ) -> None:
        low, high = period
        if not 0.0 < low <= high <= 1.0:
            raise InputError(f"the control period needs 0 < low <= high <= 1 s, got {period}")
        self._bus, self._arm, self._period, self._clock = bus, arm, period, bus.clock
        self._link = Link(bus, address)
        self._rng = np.random.default_rng(seed)
        self._continuity = Continuity(arm)
        self._health = Health(self._link, bus)
        self._command: Array | None = None
        self._state: JointState | None = None
        self._left: tuple[float, Array, Array] | None = None
        """when [s] and where (1, n) the arm was last seen before a command, and the command (1, n)"""
        self._read_cost: float | None = None

    @property
    def arm(self) -> Arm:
        """The arm's kinematics, limits and masses."""
        return self._arm

    @property
    def address(self) -> str:
        """Where the robot is."""
        return self._link.address

    @property
    def count(self) -> int:
        """One arm."""
        return 1

    def open(self) -> None:
        """Connect and get the arm ready; nothing moves. AddressError if nothing usable answers."""
        self._link.open()

    def read(self) -> JointState:
        """Ask for the joint positions; an impossible answer is asked for again.

        Raises NoReplyError, StaleReplyError, ImpossibleReplyError or ConnectionLostError.
        """
        if self._state is None:
            self._health.find()
        now, reading = self._link.ask(self._read_once)
        self._health.take(reading)
        self._state = JointState(
            time=np.array([now]), position=reading.position[None],
            age=np.array([self._continuity.accept(now, reading.position, self._command)]),
            temperature=self._health.temperature, fault=self._health.fault, trouble=self._health.trouble,
            load=None if reading.load is None else reading.load[None],
            voltage=None if reading.voltage is None else reading.voltage[None],
            elsewhere=self._elsewhere(now, reading.position[None]),
        )  # fmt: skip
        return self._state

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Send ``command`` (1, n) [rad], let the period pass, read.

        A command that could not be sent in time is not sent any more. An arm that is not ``active`` (1,) is left alone,
        and its last state repeated.
        """
        if command.shape != (1, self._arm.joints) or not np.isfinite(command).all():
            raise InputError(
                f"expected finite joint positions of shape (1, {self._arm.joints}), got {np.shape(command)}"
            )
        last = self._state if self._state is not None else self.read()
        if active is not None and not active[0]:
            return last
        period = self._rng.uniform(*self._period)
        due = max(float(last.time[0]), self._clock.now() - period / 2) + period  # even a late command gets half of it
        goal = self._command = command[0].copy()
        self._left = float(last.time[0]), last.position, command.copy()
        began = self._clock.now()

        def send() -> None:
            if self._clock.now() - began <= GAP:  # after a pause the arm is looked at first: it may stand elsewhere
                self._bus.send(goal.copy())  # a bus may reckon in place, and may be asked again

        self._link.ask(send)
        ask_at = due - (self._read_cost or 0.0)
        self._health.poll(ask_at - self._clock.now())
        self._clock.wait(ask_at - self._clock.now())
        return self.read()

    def true_tcp(self) -> Array:
        """(1, 3) NaN: nobody knows where a real tool is."""
        return np.full((1, 3), np.nan)

    def stop(self) -> None:
        """Make the arm hold where it is. The power stays on."""
        self._link.ask(self._bus.stop)
        self._command = None

    def servo_gains(self) -> ServoGains | None:
        """Return the gains of the servos' own loops; None where nobody knows them."""
        return self._bus.servo_gains()

    def rungs(self) -> tuple[Rung, ...]:
        """Return what a search for better gains tries."""
        return self._bus.rungs()

    def tune(self, gains: ServoGains) -> None:
        """Bring these gains in small steps to what is given, see `Bus.tune`."""
        self._left = None  # under other gains it sags elsewhere
        self._link.ask(lambda: self._bus.tune(gains))

    def keep(self, gains: ServoGains) -> None:
        """Bring these gains to what is given and keep them without power, see `Bus.keep`."""
        self._left = None
        self._link.ask(lambda: self._bus.keep(gains))

    def relay(self, command: int, payload: bytes) -> bytes | None:
        """Ask what is none of the joints, see `Bus.relay`."""
        return self._link.ask(lambda: self._bus.relay(command, payload))

    def close(self) -> None:
        """Drop the connection; the arm keeps holding."""
        self._link.close()

    def _elsewhere(self, now: float, position: Array) -> Mask:
        """Tell (1,) whether the arm left the way to its last command in a pause; told until the next command."""
        if self._left is None or now - self._left[0] <= GAP:
            return np.zeros(1, dtype=bool)
        return elsewhere(*self._left[1:], position)

    def _read_once(self) -> tuple[float, Reading]:
        """Read, and judge what was read; returns when it arrived [s] as well."""
        began = self._clock.now()
        reading = _own(believed(self._bus.read), self._arm.joints)
        now = self._clock.now()
        judge(reading.position, self._arm)
        self._continuity.check(now, reading.position)
        cost = min(now - began, self._period[0])
        self._read_cost = cost if self._read_cost is None else (1 - _SMOOTHING) * self._read_cost + _SMOOTHING * cost
        return now, reading


def _own(reading: Reading, joints: int) -> Reading:
    """Return an answer with arrays of its own, since a bus may fill the same ones each time.

    ImpossibleReplyError where it has another number of them than the arm has ``joints``.
    """
    told = {name: getattr(reading, name) for name in ("load", "temperature", "fault", "voltage")}
    arrays: dict[str, Any] = {name: np.array(value, float) for name, value in told.items() if value is not None}
    for name, array in arrays.items():
        if array.shape != (joints,):
            raise ImpossibleReplyError(f"expected {joints} values of {name}, got {array!r}")
    return replace(reading, position=np.array(reading.position, float), **arrays)


def bus_family(
    bus: Callable[[T, Arm], Bus],
    *,
    scheme: str,
    form: str,
    parse: Callable[[str], T],
    default_arm: str = DEFAULT_ARM,
    default_period: tuple[float, float] = (0.050, 0.050),
    tunable: bool = False,
    needs: tuple[str, ...] = (),
) -> Family[T]:
    """Family of arms behind a ``bus``, which is made from what ``parse`` read from the address, and the arm."""

    def connect(place: Place[T], opening: Opening) -> Robot:
        robot = BusRobot(
            bus(place.detail, opening.arm), opening.arm, address=place.text, period=opening.period, seed=opening.seed
        )
        robot.open()
        return robot

    return Family(
        scheme=scheme, form=form, parse=parse, connect=connect, default_arm=default_arm, default_period=default_period,
        tunable=tunable, needs=needs,
    )  # fmt: skip
