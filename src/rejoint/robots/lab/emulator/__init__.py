"""A worn arm behind the myCobot wire protocol, on TCP or a pseudo-terminal."""

from rejoint.robots.lab.emulator.emulate import build_firmware, emulate
from rejoint.robots.lab.emulator.faults import Faults, parse_faults
from rejoint.robots.lab.emulator.firmware import Firmware
from rejoint.robots.lab.emulator.servers import Server, Timing, TruthLog, serve_pty, serve_tcp

__all__ = [
    "Faults",
    "Firmware",
    "Server",
    "Timing",
    "TruthLog",
    "build_firmware",
    "emulate",
    "parse_faults",
    "serve_pty",
    "serve_tcp",
]
