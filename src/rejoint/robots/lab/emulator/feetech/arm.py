"""An SO-101 behind its bus: five joints of the plant and a gripper, moved by what stands in their registers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array
from rejoint.robots.lab.emulator.ailments import SUPPLY_VOLTAGE, Ailments
from rejoint.robots.lab.emulator.feetech.servo import COUNTS, MIDDLE, Servo
from rejoint.robots.lab.emulator.plantlike import Mask
from rejoint.robots.lab.plant.bareservo import BareServos
from rejoint.robots.lab.plant.servo import STEP
from rejoint.robots.lab.plant.stsplant import StsPlant

NAMES = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
"""Motors of an SO-101 in the order of their IDs, 1 to 6 (LeRobot)."""
HOMING = (-1470, 63, 911, -388, 85, -1021)
"""[counts] homing offsets of the emulated servos (chosen: as wild as those of real arms, whose horns sit anywhere)"""
PROMPT = 254
"""[100 counts/s^2] acceleration that LeRobot sets, beside leaving most of the other registers as they were sold"""
CURRENT_UNIT = 0.0065
"""[A] of the registers of currents"""
_GRIPPER = (-0.17, 1.75)  # [rad] range of the jaw: so101_new_calib.xml
_COPIES = {
    "p": "P_Coefficient", "d": "D_Coefficient", "i": "I_Coefficient", "startup": "Minimum_Startup_Force",
    "integral_limit": "Integral_Limit", "dead_cw": "CW_Dead_Zone", "dead_ccw": "CCW_Dead_Zone",
    "torque_limit": "Torque_Limit", "threshold": "Moving_Velocity_Threshold", "unloading": "Unloading_Condition",
    "heat_limit": "Max_Temperature_Limit", "torque_on": "Torque_Enable",
}  # fmt: skip
"""Fields of `sts3215.SETTING` and the registers that they are, as they stand."""
_SCALED = {
    "protective": ("Protective_Torque", 10), "overload": ("Overload_Torque", 10),
    "protection_ticks": ("Protection_Time", 10), "current_ticks": ("Over_Current_Protection_Time", 10),
    "current_limit": ("Protection_Current", CURRENT_UNIT), "low_voltage": ("Min_Voltage_Limit", 0.1),
    "high_voltage": ("Max_Voltage_Limit", 0.1),
}  # fmt: skip
"""Likewise, times a factor."""


class ServoArm:
    """Six servos of one arm, powered and holding; ``plant`` holds one arm, already reset."""

    def __init__(self, plant: StsPlant, arm: Arm, *, resistance: float = 0.0) -> None:
        """``resistance`` [ohm] is that of the supply, which sags under the currents of all servos."""
        self.arm, self.plant, self.resistance = arm, plant, resistance
        self.gripper = BareServos(1, lower=_GRIPPER[0], upper=_GRIPPER[1])
        self.servos = [Servo(number) for number in range(1, arm.joints + 2)]
        self.ailments = Ailments(arm.joints)
        self._owed = 0.0
        for servo, homing, limits in zip(self.servos, HOMING, self._ranges(), strict=True):
            servo["Homing_Offset"], servo["Torque_Enable"] = homing, 1
            servo["Acceleration"] = servo["Maximum_Acceleration"] = PROMPT
            servo["Min_Position_Limit"], servo["Max_Position_Limit"] = limits
            servo.save()
        for index in range(len(self.servos)):
            self.settle(index)

    @property
    def angles(self) -> Array:
        """(n,) [rad] joint angles as the encoders tell them."""
        return self.plant.encoder()[0] + self.ailments.misreading

    @property
    def temperature(self) -> Array:
        """(n,) [deg C]."""
        return self.plant.temperature[0] + self.ailments.warmth

    @property
    def true_tcp(self) -> Array:
        """(3,) [m] where the tool really is."""
        return self.plant.true_tcp()[0]

    @property
    def true_links(self) -> Array:
        """(n,) [rad] angles of the links, behind play and flex."""
        return self.plant.link_position()[0]

    def freeze(self, joints: Mask) -> None:
        """Let the encoders of ``joints`` (n,) tell what they tell now, for good; their servos still see."""
        self.plant.freeze(joints[None])

    def blind(self, joints: Mask) -> None:
        """Let the servos of ``joints`` (n,) see what they see now, for good."""
        self.plant.blind(joints[None])

    def advance(self, duration: float) -> None:
        """Let [s] pass; what is less than a millisecond is owed."""
        self._owed += duration
        steps = int(self._owed / STEP)
        self._owed -= steps * STEP
        drop = self.resistance * float(np.abs(self._records("status", "current")).sum())
        settings = self.plant.settings
        settings["voltage"][0] = np.maximum(self.ailments.voltage - drop, 0.0)
        settings["warmth"][0] = self.ailments.warmth
        self.gripper.settings["voltage"] = max(SUPPLY_VOLTAGE - drop, 0.0)
        self.plant.advance(steps * STEP)
        self.gripper.advance(steps * STEP)

    def settle(self, index: int) -> None:
        """Let the servo with this index, from 0, take over what stands in its registers."""
        servo, setting = self.servos[index], self._record("settings", index)
        for field, name in _COPIES.items():
            setting[field] = servo[name]
        for field, (name, factor) in _SCALED.items():
            setting[field] = servo[name] * factor
        low, high = servo["Min_Position_Limit"], servo["Max_Position_Limit"]
        shift = self._shift(index) if low != high else 0
        setting["least"], setting["most"] = low + shift, high + shift
        acceleration = servo["Acceleration"] or servo["Maximum_Acceleration"] * servo["Acceleration_Multiplier"]
        setting["acceleration"] = 100.0 * max(acceleration, 1)
        setting["speed"] = float(abs(servo["Goal_Velocity"]) or 50 * servo["Maximum_Velocity_Limit"])

    def go(self, index: int) -> None:
        """Let a servo take over the goal that stands in its register, and the torque that comes on with it."""
        self._record("settings", index)["torque_on"] = self.servos[index]["Torque_Enable"]
        goal = self.servos[index]["Goal_Position"] + self._shift(index)
        self._record("status", index)["goal"] = goal
        if index < self.arm.joints:
            self.plant.servos["goal"][0, index] = goal * self.arm.encoder_step

    def measure(self, index: int) -> None:
        """Write what a servo measures into its registers."""
        servo, status, setting = self.servos[index], self._record("status", index), self._record("settings", index)
        joint = index < self.arm.joints
        servo["Present_Position"] = (self._count(index) - self._shift(index)) % COUNTS
        servo["Present_Velocity"] = int(np.clip(status["speed"], -32767, 32767))
        servo["Present_Load"] = int(np.clip(status["output"], -1023, 1023))
        servo["Present_Voltage"] = round(float(setting["voltage"]) * 10)
        heat = self.temperature[index] if joint else self.gripper.servos["temperature"][0]
        servo["Present_Temperature"] = int(min(heat, 255.0))
        servo["Status"] = self.alarms(index)
        servo["Moving"] = int(status["moving"])
        servo["Goal_In_Force"] = int(status["goal"]) - self._shift(index)
        least = self.ailments.current[index] if joint else 0.0
        current = max(abs(float(status["current"])), least)
        servo["Present_Current"] = round(current / CURRENT_UNIT) * (-1 if status["current"] < 0 else 1)
        servo["Torque_Enable"] = int(setting["torque_on"])  # over-current switches it off

    def alarms(self, index: int) -> int:
        """Return the error bits of a servo."""
        found = int(self._record("status", index)["alarms"])
        return found | int(self.ailments.alarms[index]) if index < self.arm.joints else found

    def reset(self, index: int) -> None:
        """Let a servo go back to the settings of the factory, but for its ID; its torque is off then."""
        self.servos[index].reset()
        self.settle(index)

    def centre(self, index: int, value: int = MIDDLE) -> None:
        """Make ``value`` [counts] of the present position, by the homing offset."""
        servo = self.servos[index]
        self.measure(index)
        servo["Homing_Offset"] = servo["Homing_Offset"] + servo["Present_Position"] - value
        self.settle(index)

    def _count(self, index: int) -> int:
        """Count of an encoder from the zero of its joint."""
        if index < self.arm.joints:
            return round(float(self.angles[index]) / self.arm.encoder_step)
        return int(self.gripper.status["position"][0])

    def _shift(self, index: int) -> int:
        """Return what is to be added to a position on the bus to get the count from the zero of the joint."""
        return self.servos[index]["Homing_Offset"] - HOMING[index] - MIDDLE

    def _record(self, what: str, index: int) -> Any:  # noqa: ANN401 - a record of `sts3215.SETTING` or `STATUS`
        if index < self.arm.joints:
            return getattr(self.plant, what)[0, index]
        return getattr(self.gripper, what)[0]

    def _records(self, what: str, field: str) -> NDArray[np.float64]:
        return np.append(getattr(self.plant, what)[field][0], getattr(self.gripper, what)[field])

    def _ranges(self) -> list[tuple[int, int]]:
        """Return the limits [counts] of every servo as LeRobot's calibration leaves them: a full turn for the wrist."""
        step = self.arm.encoder_step
        ends = [
            (MIDDLE + round(a / step), MIDDLE + round(b / step))
            for a, b in zip(self.arm.lower, self.arm.upper, strict=True)
        ]
        ends[-1] = (0, COUNTS - 1)
        return [*ends, (MIDDLE + round(_GRIPPER[0] / step), MIDDLE + round(_GRIPPER[1] / step))]


def build_arm(arm: Arm, wear_name: str, *, seed: int = 0, resistance: float = 0.0) -> ServoArm:
    """Put an arm with the wear profile ``wear_name`` behind its servos, holding its rest posture."""
    from rejoint.robots.lab.plant.wear import load_wear

    built = ServoArm(StsPlant(arm, [load_wear(wear_name, arm)], seed=seed), arm, resistance=resistance)
    built.advance(0.01)  # compiles the plant now instead of during the first request
    return built
