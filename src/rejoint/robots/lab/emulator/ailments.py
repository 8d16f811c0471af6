"""What the servos of an arm report that is not so, or should not be: nothing, until a fault begins."""

from __future__ import annotations

import numpy as np

VOLTAGE_BIT, OVER_TEMPERATURE_BIT, OVER_CURRENT_BIT, OVERLOAD_BIT = 1 << 0, 1 << 2, 1 << 3, 1 << 5
"""Bits of the servo status (pymycobot 4.0.7, robot_info)."""
SUPPLY_VOLTAGE = 12.0
"""[V] (vendor's product parameters)"""


class Ailments:
    """Of an arm of n joints; the firmware adds them to what it measures."""

    def __init__(self, joints: int) -> None:
        self.misreading = np.zeros(joints)
        """(n,) [rad] by which the encoders tell too much"""
        self.warmth = np.zeros(joints)
        """(n,) [K] above what the work of the motors explains"""
        self.current = np.zeros(joints)
        """(n,) [A] at least, whatever the torque of the motors"""
        self.voltage = np.full(joints, SUPPLY_VOLTAGE)
        """(n,) [V] of the supply, at each servo"""
        self.alarms = np.zeros(joints, dtype=np.uint8)
        """(n,) status bits that are set, besides over-temperature"""
