"""A worn arm behind the myCobot wire protocol: the plant in wall-clock time, on TCP or a pseudo-terminal."""

from rejoint.emulator.emulate import build_firmware, emulate
from rejoint.emulator.firmware import Firmware
from rejoint.emulator.servers import Server, serve_pty, serve_tcp
from rejoint.emulator.session import Timing, TruthLog

__all__ = ["Firmware", "Server", "Timing", "TruthLog", "build_firmware", "emulate", "serve_pty", "serve_tcp"]
