"""The myCobot's wire protocol from the robot's side, as pure functions; the emulator and `rejoint serve` use it.

The driver speaks through the vendor's client instead.
"""
