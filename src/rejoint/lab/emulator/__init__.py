"""A worn arm behind the myCobot wire protocol: the plant in wall-clock time, on TCP or a pseudo-terminal."""

from rejoint.lab.emulator.emulate import build_firmware, emulate
from rejoint.lab.emulator.faults import Faults, parse_faults
from rejoint.lab.emulator.firmware import Firmware
from rejoint.lab.emulator.servers import Server, serve_pty, serve_tcp
from rejoint.lab.emulator.session import Timing
from rejoint.lab.emulator.truthlog import TruthLog

__all__ = [
    "Faults", "Firmware", "Server", "Timing", "TruthLog", "build_firmware", "emulate", "parse_faults", "serve_pty",
    "serve_tcp",
]  # fmt: skip
