"""Registers of an STS3215: address, size, default, unit, and which bit is the sign.

Source: Feetech's memory table of the STS/SMS series; defaults of a servo as sold (C018), names as in LeRobot. Values
with a sign are sign and magnitude, see `rejoint.robots.lab.emulator.feetech.packets.magnitude`.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

SIZE = 88
"""Bytes of the register file (chosen: the last known register is 86)"""
MODEL = 777
"""What an STS3215 calls itself"""


class Access(Enum):
    """Who may write a register, and whether it outlasts a loss of power."""

    READ = "read"
    """measured, or fixed"""
    RAM = "ram"
    """set; lost with the power"""
    SAVED = "saved"
    """set; kept if the lock is open when it is written"""


class Register(NamedTuple):
    """A value in the register file."""

    address: int
    size: int
    name: str
    access: Access
    default: int
    unit: str = ""
    sign: int | None = None
    """bit of the sign; None for values without one"""


_R, _W, _E = Access.READ, Access.RAM, Access.SAVED

TABLE: tuple[Register, ...] = (
    Register(0, 1, "Firmware_Major_Version", _R, 3),
    Register(1, 1, "Firmware_Minor_Version", _R, 10),
    Register(3, 2, "Model_Number", _R, MODEL),
    Register(5, 1, "ID", _E, 1),
    Register(6, 1, "Baud_Rate", _E, 0),
    Register(7, 1, "Return_Delay_Time", _E, 0, "2 us"),
    Register(8, 1, "Response_Status_Level", _E, 1),
    Register(9, 2, "Min_Position_Limit", _E, 0, "count"),
    Register(11, 2, "Max_Position_Limit", _E, 4095, "count"),
    Register(13, 1, "Max_Temperature_Limit", _E, 70, "deg C"),
    Register(14, 1, "Max_Voltage_Limit", _E, 140, "0.1 V"),
    Register(15, 1, "Min_Voltage_Limit", _E, 40, "0.1 V"),
    Register(16, 2, "Max_Torque_Limit", _E, 1000, "0.1 %"),
    Register(18, 1, "Phase", _E, 12),
    Register(19, 1, "Unloading_Condition", _E, 44),
    Register(20, 1, "LED_Alarm_Condition", _E, 47),
    Register(21, 1, "P_Coefficient", _E, 32),
    Register(22, 1, "D_Coefficient", _E, 32),
    Register(23, 1, "I_Coefficient", _E, 0),
    Register(24, 1, "Minimum_Startup_Force", _E, 16, "0.1 %"),
    Register(25, 1, "Integral_Limit", _E, 0, "0.4 %"),
    Register(26, 1, "CW_Dead_Zone", _E, 1, "count"),
    Register(27, 1, "CCW_Dead_Zone", _E, 1, "count"),
    Register(28, 2, "Protection_Current", _E, 310, "6.5 mA"),
    Register(30, 1, "Angular_Resolution", _E, 1),
    Register(31, 2, "Homing_Offset", _E, 0, "count", 11),
    Register(33, 1, "Operating_Mode", _E, 0),
    Register(34, 1, "Protective_Torque", _E, 20, "%"),
    Register(35, 1, "Protection_Time", _E, 200, "10 ms"),
    Register(36, 1, "Overload_Torque", _E, 80, "%"),
    Register(37, 1, "Velocity_P_Coefficient", _E, 10),
    Register(38, 1, "Over_Current_Protection_Time", _E, 200, "10 ms"),
    Register(39, 1, "Velocity_I_Coefficient", _E, 200),
    Register(40, 1, "Torque_Enable", _W, 0),
    Register(41, 1, "Acceleration", _W, 0, "100 count/s^2"),
    Register(42, 2, "Goal_Position", _W, 0, "count", 15),
    Register(44, 2, "Goal_Time", _W, 0, "", 10),
    Register(46, 2, "Goal_Velocity", _W, 0, "count/s", 15),
    Register(48, 2, "Torque_Limit", _W, 1000, "0.1 %"),
    Register(55, 1, "Lock", _W, 1),
    Register(56, 2, "Present_Position", _R, 0, "count", 15),
    Register(58, 2, "Present_Velocity", _R, 0, "count/s", 15),
    Register(60, 2, "Present_Load", _R, 0, "0.1 %", 10),
    Register(62, 1, "Present_Voltage", _R, 120, "0.1 V"),
    Register(63, 1, "Present_Temperature", _R, 25, "deg C"),
    Register(64, 1, "Async_Write_Flag", _R, 0),
    Register(65, 1, "Status", _R, 0),
    Register(66, 1, "Moving", _R, 0),
    Register(67, 2, "Goal_In_Force", _R, 0, "count", 15),
    Register(69, 2, "Present_Current", _R, 0, "6.5 mA", 15),
    Register(80, 1, "Moving_Velocity_Threshold", _E, 2, "count"),
    Register(81, 1, "DTs", _E, 20, "ms"),
    Register(82, 1, "Velocity_Unit_Factor", _E, 50),
    Register(83, 1, "Minimum_Velocity_Limit", _E, 1),
    Register(84, 1, "Maximum_Velocity_Limit", _E, 150, "50 count/s"),
    Register(85, 1, "Maximum_Acceleration", _E, 100, "100 count/s^2"),
    Register(86, 1, "Acceleration_Multiplier", _E, 1),
)

BY_NAME: dict[str, Register] = {register.name: register for register in TABLE}


def factory_settings(servo: int) -> bytearray:
    """Return the register file of a servo with this ID as it is after its first power-on."""
    cells = bytearray(SIZE)
    for register in TABLE:
        cells[register.address : register.address + register.size] = register.default.to_bytes(register.size, "little")
    cells[BY_NAME["ID"].address] = servo
    return cells
