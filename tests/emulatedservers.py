"""Servers of emulated arms on a port of this computer, and on a pseudo-terminal."""

from typing import Any

from rejoint.robots.wireserver import Server, TerminalServer
from rejoint_lab.emulator.firmware import Firmware
from rejoint_lab.emulator.servers import WireSession, on_port


def serve_tcp(firmware: Firmware, host: str = "127.0.0.1", port: int = 0, **options: Any) -> Server:
    return on_port(WireSession(firmware, **options), host, port)


def serve_pty(firmware: Firmware, **options: Any) -> Server:
    return TerminalServer(WireSession(firmware, **options))
