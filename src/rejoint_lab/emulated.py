"""Worn arms in this process, in virtual time."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rejoint.arms import Arm, Array, Mask
from rejoint.control.robot import JointState, Robot
from rejoint.control.seeing import Sighting
from rejoint.control.servogains import ServoGains
from rejoint.robots import dynamixel, feetech
from rejoint.robots.knobs import Gains, TunedServos, Values
from rejoint.system.errors import InputError
from rejoint_lab.plant.plant import ServoPlant, StsPlant, XPlant, plant_of
from rejoint_lab.plant.servo import Channel, stream_keys
from rejoint_lab.plant.wear import Wear
from rejoint_lab.plant.xseries import ACCELERATION_UNIT, VELOCITY_UNIT

if TYPE_CHECKING:
    from rejoint.camera.board import Board
    from rejoint_lab.cameras import EmulatedCamera


_UNITS = {"speed": VELOCITY_UNIT, "acceleration": ACCELERATION_UNIT}


_CHANNEL_PURPOSE = 1
_IDLE = Channel()


class EmulatedRobot(TunedServos):
    """B emulated arms, whose servos have equal gains, if any; time passes only in `step`, noise is as in `Plant`."""

    def __init__(
        self,
        arm: Arm,
        wears: Sequence[Wear],
        *,
        address: str = "emulated:worn",
        seed: int = 0,
        channel: Channel = _IDLE,
        start: Array | None = None,
        gains: Gains | None = None,
        **options: Any,  # noqa: ANN401
    ) -> None:
        """Put the arms at ``start`` (B, n) or (n,) [rad], or rest; ``options``: of `Plant`, and ``tells_load``."""
        self.arm, self.address, self.count = arm, address, len(wears)
        self._tells_load, self._channel = options.pop("tells_load", True), channel
        self.plant = plant_of(arm)(arm, wears, seed=seed, **options)
        super().__init__(dynamixel.KIND if isinstance(self.plant, XPlant) else feetech.KIND, arm.joint_names, {})
        if gains:
            self._require_gains()
        for name, values in self.kind.for_all(gains or {}, arm.joints).items():
            self.write_gain(name, values)
        self.gains = self.read_gains()
        self._keys = stream_keys(seed, len(wears), first=options.get("first", 0), purpose=_CHANNEL_PURPOSE)
        self._cycle = np.zeros(len(wears), np.int64)
        self.restart(arm.rest if start is None else start)

    def restart(self, start: Array) -> None:
        """Put arms at rest at ``start`` (B, n) or (n,) [rad]."""
        self.plant.reset(np.broadcast_to(start, (self.count, self.arm.joints)))
        self._position = self.plant.encoder()

    def read(self) -> JointState:
        """Newest state; takes no virtual time."""
        return JointState(
            time=self.plant.time,
            position=self._position.copy(),
            age=np.zeros(self.count),
            temperature=self.plant.temperature,
            load=self._load() if self._tells_load else None,
        )

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Send ``command`` (B, n) [rad], wait a period, read."""
        latency, age, period = self._channel.draw(self._keys, self._cycle)
        self.plant.command(command, latency, active)
        self.plant.advance(period, active)
        seen = self.plant.encoder(age)
        self._position = seen if active is None else np.where(active[:, None], seen, self._position)
        self._cycle += 1 if active is None else active
        return self.read()

    def true_tcp(self) -> Array:
        """(B, 3) [m] true tools."""
        return self.plant.true_tcp()

    def stop(self) -> None:
        """Hold: the reference stops."""
        self.plant.halt()

    def tune(self, gains: ServoGains) -> None:
        """Set the gains of all arms in small steps of virtual time."""
        self._require_gains()
        super().tune(gains)
        self._position = self.plant.encoder()

    def _require_gains(self) -> None:
        if not isinstance(self.plant, ServoPlant):
            raise InputError(f"{self.address} has no servo gains that could be set; an SO-101 has: give --arm so101")

    def read_gains(self) -> Values:
        """Gains in force."""
        found: Values = {}
        if isinstance(self.plant, ServoPlant):
            settings = self.plant.settings[0].reshape(self.arm.joints, -1)[:, 0]
            for name in self.kind.strides:
                if name in settings.dtype.names:
                    found[name] = tuple(np.rint(settings[name] / _UNITS.get(name, 1)).astype(int).tolist())
        return found

    def write_gain(self, name: str, values: Sequence[int]) -> None:
        """Set one gain of all servos."""
        if isinstance(self.plant, ServoPlant):  # others have no gains: `tune` refuses
            self.plant.settings[name].T[:] = np.array(values)[:, None] * _UNITS.get(name, 1)

    def strain(self, joint: int) -> tuple[float, float]:
        """Largest share of the torque, and temperature [deg C]."""
        plant = self.plant
        return float(np.abs(plant.load[:, joint]).max()), float(plant.temperature[:, joint].max())

    def relieve(self, joint: int) -> None:
        """Let a joint hold where it stands."""
        goal = self.plant.goal.copy()
        goal[:, joint] = self.plant.encoder()[:, joint]
        self.plant.command(goal)

    def wait(self, duration: float) -> None:
        """Let virtual time pass [s]."""
        self.plant.advance(duration)

    def keep(self, gains: ServoGains) -> None:  # noqa: ARG002 - nothing of an arm in this process outlasts it
        """Raise InputError: emulated arms do not last."""
        raise InputError(
            f"{self.address} forgets its gains at the end of the command; name them in its address, as "
            "emulated:so101?p=48, or keep them in what `rejoint emulate --arm so101` serves"
        )

    def eye(self, seed: int) -> EmulatedEye:
        """Detector of the tool of the only arm."""
        return EmulatedEye(self, seed=seed)

    def camera(self, board: Board, carried: str, seed: int) -> EmulatedCamera:
        """Camera beside the only arm, or on its tool."""
        from rejoint_lab.cameras import EmulatedCamera, beside, on_tool

        rig = beside(self.arm, board=board) if carried == "board" else on_tool(self.arm, board=board)
        return EmulatedCamera(rig, lambda: self.plant.true_pose()[0], seed)

    def close(self) -> None:
        """Do nothing."""

    def _load(self) -> Array:
        """Return shares (B, n) of the largest torque."""
        if not isinstance(self.plant, StsPlant):
            return self.plant.load
        status = self.plant.status
        return feetech.torque_share(self.gains, status["output"], status["goal"] - status["position"])


RATE, LATE = 15.0, 0.1
"""[1/s] images, and [s] from an image to its detection (chosen)"""
DEVIATION = np.array([5e-4, 1e-4, 1e-4])
"""[m] of a detection in the base frame, along the line of sight and across (chosen)"""


class EmulatedEye:
    """Detects the tool of one emulated arm."""

    def __init__(self, robot: Robot, seed: int) -> None:
        self._robot, self._rng = robot, np.random.default_rng(seed)
        self._taken: deque[Sighting] = deque(maxlen=64)
        self._due = -np.inf  # [s] of the next image

    def sighting(self, now: float) -> Sighting | None:
        """Newest detection at robot time ``now`` [s], or None."""
        if now >= self._due:
            self._due = (self._due if now - self._due < 1.0 / RATE else now) + 1.0 / RATE  # missed images are lost
            place = self._robot.true_tcp()[0] + DEVIATION * self._rng.normal(size=3)
            self._taken.append(Sighting(time=now, place=place))
        ready = [one for one in self._taken if one.time <= now - LATE]
        return ready[-1] if ready else None
