"""Worn arms in this process, in virtual time: the plant behind a channel with latency and jitter.

Arms whose servos are STS3215 move by the law of that servo, with gains that can be read and set as on their bus.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.kinematics import GRAVITY
from rejoint.control.robot import JointState, Mask
from rejoint.control.servogains import Rung, ServoGains
from rejoint.robots.feetech.emulated import EmulatedServos
from rejoint.robots.feetech.gains import RUNGS, Gains
from rejoint.robots.lab.plant.channel import Channel, Interval
from rejoint.robots.lab.plant.plant import Plant
from rejoint.robots.lab.plant.streams import stream_keys
from rejoint.robots.lab.plant.sts3215 import has_these_servos
from rejoint.robots.lab.plant.stsplant import StsPlant
from rejoint.robots.lab.plant.wear import Wear
from rejoint.system.errors import InputError

_CHANNEL_PURPOSE = 1


class EmulatedRobot:
    """B emulated arms, one per wear; no time passes but in `step`.

    Arm i draws all its noise from the streams ``first + i`` of ``seed`` and so moves bit for bit as it
    would alone, at any number of threads and whatever the other arms do.
    """

    def __init__(
        self,
        arm: Arm,
        wears: Sequence[Wear],
        *,
        address: str = "emulated:worn",
        seed: int = 0,
        period: Interval = (0.020, 0.030),
        command_latency: Interval = (0.008, 0.013),
        readback_age: Interval = (0.006, 0.013),
        threads: int = 1,
        start: Array | None = None,
        first: int = 0,
        payload: Array | float = 0.0,
        tells_load: bool = True,
        bodies: Sequence[Arm] | None = None,
        gravity: Array = GRAVITY,
        gains: Gains | None = None,
    ) -> None:
        """Put the arms at rest at ``start`` (B, n) or (n,) [rad], by default in the rest posture.

        ``payload``, a number or (B,) [kg], is what their tools carry and nobody knows of. ``tells_load`` says whether
        their servos report a load, as not all do. ``bodies`` are the arms as they really are, where ``arm`` only
        describes them; ``gravity`` (3,) [m/s^2] in the frame of the base is another one where that stands askew.
        ``gains`` are those of the servos of an SO-101, by the names of `rejoint.robots.feetech.gains.KNOBS`, where they
        are not as sold.
        """
        self._address, self._tells_load = address, tells_load
        self._channel = Channel(latency=command_latency, age=readback_age, period=period)
        law = has_these_servos(arm)
        if gains and not law:
            raise InputError(f"{address} has no servo gains that could be set; an SO-101 has: give --arm so101")
        self.plant = (StsPlant if law else Plant)(
            arm, wears, seed=seed, threads=threads, first=first, payload=payload, bodies=bodies, gravity=gravity
        )
        self._servos = EmulatedServos(self.plant, gains or {}) if isinstance(self.plant, StsPlant) else None
        self._keys = stream_keys(seed, len(wears), first=first, purpose=_CHANNEL_PURPOSE)
        self._cycle = np.zeros(len(wears), np.int64)
        self._position = np.zeros((len(wears), arm.joints))
        self.restart(arm.rest if start is None else start)

    @property
    def arm(self) -> Arm:
        """The arm's kinematics, limits and masses."""
        return self.plant.arm

    @property
    def address(self) -> str:
        """Where the robot is, as the user wrote it."""
        return self._address

    @property
    def count(self) -> int:
        """Number B of arms."""
        return self.plant.count

    def restart(self, start: Array, where: Mask | None = None) -> None:
        """Put arms at rest at ``start`` (B, n) or (n,) [rad], as nobody can do with a real one."""
        shape = (self.count, self.arm.joints)
        if np.shape(start) not in (shape, shape[1:]):
            raise InputError(f"expected a start of shape {shape} or {shape[1:]} [rad], got {np.shape(start)}")
        self.plant.reset(np.broadcast_to(start, shape), where)
        self._position = self._merge(self.plant.encoder(), where)

    def read(self) -> JointState:
        """Return the newest joint state; reading takes no virtual time."""
        return JointState(
            time=self.plant.time,
            position=self._position.copy(),
            age=np.zeros(self.count),
            temperature=self.plant.temperature,
            load=self._load() if self._tells_load else None,
        )

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Send ``command`` (B, n) [rad], let one period pass, read; arms not ``active`` stand still in time."""
        delays = self._channel.draw(self._keys, self._cycle)
        self.plant.command(command, delays.latency, active)
        self.plant.advance(delays.period, active)
        self._position = self._merge(self.plant.encoder(delays.age), active)
        self._cycle += 1 if active is None else active
        return self.read()

    def true_tcp(self) -> Array:
        """(B, 3) [m] where the tools really are."""
        return self.plant.true_tcp()

    def stop(self) -> None:
        """Make the arms hold: the firmware's reference stays where its ramp is."""
        self.plant.halt()

    def servo_gains(self) -> ServoGains | None:
        """Return the gains of the servos' own loops; None where they have none that could be told."""
        return None if self._servos is None else self._servos.gains

    def rungs(self) -> tuple[Rung, ...]:
        """Return what a search for better gains tries."""
        return () if self._servos is None else RUNGS

    def tune(self, gains: ServoGains) -> None:
        """Bring the gains of all arms in small steps to these, in virtual time."""
        self._tunable().tune(gains)
        self._position = self.plant.encoder()

    def keep(self, gains: ServoGains) -> None:  # noqa: ARG002 - nothing of an arm in this process outlasts it
        """Refuse (InputError): nothing of an arm in this process outlasts it."""
        raise InputError(
            f"{self._address} forgets its gains at the end of the command; name them in its address, as "
            "emulated:so101?p=48, or keep them in what `rejoint emulate --arm so101` serves"
        )

    def close(self) -> None:
        """Nothing to release."""

    def _tunable(self) -> EmulatedServos:
        if self._servos is None:
            raise InputError(f"{self._address} has no servo gains that could be set; an SO-101 has")
        return self._servos

    def _load(self) -> Array:
        """(B, n) what the servos tell of their torque, as their driver puts it."""
        return self.plant.load if self._servos is None else self._servos.load

    def _merge(self, position: Array, where: Mask | None) -> Array:
        return position if where is None else np.where(where[:, None], position, self._position)
