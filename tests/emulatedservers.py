"""Servers of emulated arms on a port of this computer, and on a pseudo-terminal."""

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.robots.wireserver import Server, TerminalServer
from rejoint.runs.run import Run
from rejoint_lab.emulator.faults import parse_faults
from rejoint_lab.emulator.firmware import Firmware
from rejoint_lab.emulator.servers import WireSession, on_port
from rejoint_lab.emulator.servobus import BusSession


def _session(firmware: Firmware, timing: Any = (), **options: Any) -> WireSession:
    session = WireSession(firmware, **options)
    vars(session).update(timing)
    return session


def serve_tcp(firmware: Firmware, host: str = "127.0.0.1", port: int = 0, **options: Any) -> Server:
    return on_port(_session(firmware, **options), host, port)


def serve_pty(firmware: Firmware, **options: Any) -> Server:
    return TerminalServer(_session(firmware, **options))


def serve_bus(arm, fault="", *, pty=False):
    """A server of the servos of an ``arm``, which it keeps."""
    server = (TerminalServer if pty else on_port)(BusSession(arm, faults=parse_faults(fault, arm.arm.joints)))
    server.arm = arm
    return server


HEARD = (
    "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); from rejoint.cli import main; main()"
)
"""The command line in a process that Ctrl-C reaches: what a shell starts in the background ignores it"""


def deploy(address: str, firmware: Firmware, folder: Path, moved: float) -> subprocess.Popen[str]:
    """Start a deployment in a process of its own; returns once a joint was sent ``moved`` [rad] away."""
    Run.create(folder, address, firmware.arm)
    words = [sys.executable, "-c", HEARD, "deploy", address, str(folder), "--controller", "integrator", "--dwell", "30"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    begin, until = firmware.planned_angles, time.monotonic() + 60.0
    while np.abs(firmware.planned_angles - begin).max() < moved and time.monotonic() < until:
        time.sleep(0.02)
    return process
