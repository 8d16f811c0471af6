"""What is used of the vendor's package: two clients and their table of limits.

Importing pymycobot 4.0.7 asks the locale in a way that Python has deprecated; the user can do
nothing about it and does not hear of it.
"""

from __future__ import annotations

import warnings

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    from pymycobot import MyCobot280, MyCobot280Socket
    from pymycobot.robot_info import RobotLimit

LOWEST_DEG: tuple[float, ...] = tuple(RobotLimit.robot_limit["MyCobot280"]["angles_min"])
"""[deg] lowest joint angles that the clients accept"""
HIGHEST_DEG: tuple[float, ...] = tuple(RobotLimit.robot_limit["MyCobot280"]["angles_max"])
"""[deg] highest joint angles that the clients accept"""

__all__ = ["HIGHEST_DEG", "LOWEST_DEG", "MyCobot280", "MyCobot280Socket"]
