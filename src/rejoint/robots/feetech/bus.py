"""An SO-100 or SO-101 on its servo bus: one synchronous read and write per cycle.

A joint is at zero in mid-range, as in LeRobot's degrees, or at the address's ``zero``. Only `FeetechBus.keep` unlocks
the servos' memory.
"""

from collections.abc import Sequence

import numpy as np
from scservo_sdk import PKT_ERROR, PKT_ID, PKT_PARAMETER0, PortHandler, sms_sts

from rejoint.control.servogains import ServoGains
from rejoint.logs.joints import COUNTS_PER_TURN
from rejoint.robots.bus import Bus, Reading
from rejoint.robots.family import Wire
from rejoint.robots.feetech import KIND, torque_share
from rejoint.robots.servobus import STEP, VOLT, ServoBus, Zeros, listed, trouble
from rejoint.robots.servowire import ServoWire
from rejoint.system.errors import RobotError
from rejoint.system.stopping import shielded

MODEL = 3
"""Register address of the model"""


class FeetechWire(ServoWire, PortHandler):  # type: ignore[misc]  # the maker's package has no types
    """An open bus of Feetech servos."""

    places, overhead = (PKT_ID, PKT_ERROR), 6

    def __init__(self, address: Wire) -> None:
        super().__init__(address)
        self._client = sms_sts(self)

    def model(self, servo: int) -> int:
        """Model number of a servo; ignores late answers."""
        return int.from_bytes(self.read(servo, MODEL, 2), "little")

    def _data(self, packet: Sequence[int]) -> bytes:
        return bytes(packet[PKT_PARAMETER0:-1])


POSITION_MODE = 0
MEASURED = ("position", "load", "voltage", "heat", "status", "target")
"""Registers of a cycle"""
PROMPT = 254
"""[100 counts/s^2] as LeRobot sets it"""
TURNING = np.radians(300.0)
"""[rad] range of a joint that may turn fully (chosen: LeRobot does so with a wrist)"""


class FeetechBus(ServoBus):
    """The servos of an SO-100 or SO-101, by ID, without the gripper."""

    name = "SO-101"
    advice = f"{Bus.advice} `rejoint emulate --arm so101` starts an arm to try"
    wire_type = FeetechWire

    def check(self, servo: int) -> None:
        """Require position mode."""
        if self.get(servo, "mode") != POSITION_MODE:
            raise RobotError(
                f"{self.call(servo)} is not in position mode; set its register {self.table['mode'].address} to "
                f"{POSITION_MODE}"
            )

    def find_zeros(self) -> Zeros:
        """Read zeros from servos, or a file; at mid-range 0 or what the address says. RobotError."""
        arm, file = self.arm, self.file
        homing, low, high = map(self.get_all, ("homing", "low", "high"))
        zero = self.address.middle(arm)
        if file is not None:
            file.require(arm, homing)
        limited = low < high
        low, high = np.where(limited, low, 0), np.where(limited, high, COUNTS_PER_TURN - 1)
        least, most = (low, high) if file is None else (file.low, file.high)
        whole = (most - least >= COUNTS_PER_TURN - 1) & (arm.upper - arm.lower < TURNING)
        if whole.any() and not self.address.zero:
            raise RobotError(
                f"{listed(np.array(arm.joint_names)[whole])} may turn by a whole turn, as servos do that were never "
                "calibrated: zero is unknown; run lerobot-calibrate, or say by zero=DEG,DEG,... what angle each joint "
                "has in the middle of its range"
            )
        return Zeros(middle=(least + most) / 2, zero=zero, low=low, high=high, step=np.full(arm.joints, STEP))

    def set_up(self) -> None:
        """Lock the memory, and let the servos be prompt."""
        for servo in self.ids:
            if self.get(servo, "lock") == 0:
                self.set(servo, "lock", 1)
            if self.get(servo, "fastest") * self.get(servo, "times") < PROMPT:
                self.set(servo, "fastest", PROMPT)
            if 0 < self.get(servo, "acceleration") < PROMPT:
                self.set(servo, "acceleration", PROMPT)
            if self.get(servo, "speed") != 0:  # 0 is the largest
                self.set(servo, "speed", 0)
        self.supply = self.supply or tuple(VOLT * self.get(servo, "voltage") for servo in self.ids)

    def read(self) -> Reading:
        """Ask all servos."""
        places, duties, volts, heats, statuses, targets = self.ask_all(*MEASURED)
        words = [trouble(KIND.faults, *seen) for seen in zip(statuses, VOLT * volts, self.supply, strict=True)]
        return Reading(
            position=self.zeros.radians(places),
            load=torque_share(self.gains, duties, targets - places),
            voltage=VOLT * volts,
            temperature=heats,
            fault=np.array(words, bool),
            trouble=tuple(words),
        )

    def keep(self, gains: ServoGains) -> None:
        """Save gains; each lock is open meanwhile."""
        self.tune(gains)
        for joint, servo in enumerate(self.ids):
            try:
                self.set(servo, "lock", 0)
                for name, values in gains.items():
                    self.set(servo, name, values[joint])
            finally:
                with shielded():
                    self.set(servo, "lock", 1)
            if self.get(servo, "lock") != 1:
                raise RobotError(f"the lock of {self.call(servo)} stays open; switch the arm's power off and on")
        self.gains = self.read_gains()
        if any(self.gains[name] != tuple(values) for name, values in gains.items()):
            raise RobotError(f"the servos have not taken the gains; they are {self.gains}")
