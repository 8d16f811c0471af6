"""A myCobot 280, real or emulated, through the vendor's client.

One control cycle is: send the command, wait, read the joints so that the answer arrives one period
after the last one. The wire takes about 8 ms for the one and 12 ms for the other; the vendor names
50 ms as the shortest cycle of control and feedback, which is the default.

This driver never uses the emulator's codec: the vendor's client is the independent judge of what
the emulator sends.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.robot import JointState, Mask
from rejoint.errors import InputError, RobotError
from rejoint.robots.health import Health
from rejoint.robots.link import VendorLink
from rejoint.robots.plausibility import Continuity, read_angles
from rejoint.robots.vendor import HIGHEST_DEG, LOWEST_DEG
from rejoint.stopping import pause

DEFAULT_PERIOD = (0.050, 0.050)
"""[s] shortest cycle of control and feedback that the vendor names (its FAQ)"""

SENT = 3
"""Times that a command is sent before its refusal is believed: one wrong byte on the wire looks the same (chosen)"""


@dataclass(frozen=True, kw_only=True)
class DriverSettings:
    """How the robot is driven."""

    period: tuple[float, float] = DEFAULT_PERIOD
    """[s] every cycle's length is drawn uniformly from this interval; never shorter than the wire allows"""
    speed_percent: int = 100
    """of the firmware's own speed limit"""
    health_interval: float = 1.0
    """[s] at most between questions for servo faults and for temperatures, which take turns (chosen); where the period
    leaves time for it, one is asked in every cycle"""
    seed: int = 0

    def __post_init__(self) -> None:
        low, high = self.period
        if not 0.0 < low <= high <= 1.0:
            raise InputError(f"the control period needs 0 < low <= high <= 1 s, got {self.period}")
        if not 1 <= self.speed_percent <= 100:
            raise InputError(f"the speed must be 1..100 percent, got {self.speed_percent}")


class MyCobotRobot:
    """One arm behind an opened `VendorLink`; its clock is `time.monotonic`."""

    def __init__(self, link: VendorLink, arm: Arm, settings: DriverSettings | None = None) -> None:
        if arm.joints != len(LOWEST_DEG):
            raise InputError(f"a myCobot 280 has {len(LOWEST_DEG)} joints, arm {arm.name} has {arm.joints}")
        self._link = link
        self._arm = arm
        self._settings = settings or DriverSettings()
        self._rng = np.random.default_rng(self._settings.seed)
        self._continuity = Continuity(arm)
        self._command: Array | None = None
        self._state: JointState | None = None
        self._health = Health(link, arm.joints, self._settings.health_interval)
        self._read_cost: float | None = None

    @property
    def arm(self) -> Arm:
        """The arm's kinematics, limits and masses."""
        return self._arm

    @property
    def address(self) -> str:
        """Where the robot is."""
        return str(self._link.address)

    @property
    def count(self) -> int:
        """One arm."""
        return 1

    def read(self) -> JointState:
        """Ask for the joint positions; an impossible answer is asked for once more.

        Raises NoReplyError, StaleReplyError, ImpossibleReplyError or ConnectionLostError.
        """
        if self._state is None:
            self._health.find()
        return self._link.insist(self._read_once)

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Send ``command`` (1, n) [rad], let the period pass, read.

        The command is clipped to the limits of the client, which refuses anything beyond them. An arm
        that is not ``active`` (1,) is left alone, and its last state repeated.
        """
        if command.shape != (1, self._arm.joints) or not np.isfinite(command).all():
            raise InputError(f"expected finite joint positions of shape (1, {self._arm.joints}), got {command!r}")
        last = self._state if self._state is not None else self.read()
        if active is not None and not active[0]:
            return last
        period = self._rng.uniform(*self._settings.period)
        due = max(float(last.time[0]), time.monotonic() - period / 2) + period  # even a late command gets half of it
        self._send(command[0])
        ask_at = due - (self._read_cost or 0.0)
        self._health.poll(ask_at - time.monotonic())
        pause(ask_at - time.monotonic())
        return self.read()

    def true_tcp(self) -> Array:
        """(1, 3) NaN: nobody knows where a real tool is."""
        return np.full((1, 3), np.nan)

    def stop(self) -> None:
        """Stop by the vendor's order; the arm holds where its reference is. The power stays on."""
        self._link.ask("stop")
        self._command = None

    def close(self) -> None:
        """Drop the connection; the arm keeps holding."""
        self._link.close()

    def _send(self, command: Array) -> None:
        self._command = command.copy()
        for _ in range(SENT):
            answer = self._link.ask("send_angles", wire_angles(command), self._settings.speed_percent)
            if answer == 1:
                return
        error = self._link.ask("get_error_information")
        raise RobotError(f"{self.address}: the arm refused a command (answer {answer}, error code {error})")

    def _read_once(self) -> JointState:
        began = time.monotonic()
        reply = self._link.ask("get_angles")
        now = time.monotonic()
        position = read_angles(reply, self._arm)
        self._continuity.check(now, position)
        age = self._continuity.accept(now, position, self._command)
        cost = min(now - began, self._settings.period[0])  # without the time of a reconnection
        self._read_cost = cost if self._read_cost is None else 0.8 * self._read_cost + 0.2 * cost
        self._state = JointState(
            time=np.array([now]), position=position[None], age=np.array([age]),
            temperature=self._health.temperature, fault=self._health.fault,
        )  # fmt: skip
        return self._state


def wire_angles(position: Array) -> list[float]:
    """Degrees (n,) that the client turns into the nearest hundredth, inside its own limits.

    The client truncates ``int(100 * angle)``; a quarter of a hundredth more makes that exact.
    """
    hundredths = np.round(np.degrees(position) * 100.0)
    degrees = (hundredths + 0.25 * np.sign(hundredths)) / 100.0
    return [float(value) for value in np.clip(degrees, LOWEST_DEG, HIGHEST_DEG)]
