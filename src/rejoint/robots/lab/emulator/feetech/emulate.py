"""An SO-101 for anyone to connect to: servos, bus and server put together."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from rejoint.arms import Arm
from rejoint.robots.lab.emulator.emulate import DIED
from rejoint.robots.lab.emulator.faults import NONE, Faults
from rejoint.robots.lab.emulator.feetech.arm import build_arm
from rejoint.robots.lab.emulator.feetech.session import BusSession
from rejoint.robots.lab.emulator.servers import Server, on_port, on_terminal
from rejoint.robots.lab.emulator.truthlog import TruthLog

SCHEME = "feetech"
"""of the addresses at which a driver finds it"""


def serve_bus(
    session: BusSession, *, host: str = "127.0.0.1", port: int = 0, pty: bool = False
) -> Server:  # fmt: skip
    """Serve a bus on a TCP port (0: any free one), or on a pseudo-terminal; InputError if it cannot be. Run it."""
    return on_terminal(session, scheme=SCHEME) if pty else on_port(session, host, port, scheme=SCHEME)


def emulate_bus(
    arm: Arm,
    wear_name: str,
    *,
    host: str = "127.0.0.1",
    port: int = 9000,
    pty: bool = False,
    seed: int = 0,
    announce: Callable[[str], None],
    log: Path | None = None,
    faults: Faults = NONE,
) -> None:
    """Serve an SO-101 until interrupted, as `rejoint.robots.lab.emulator.emulate.emulate` serves a myCobot."""
    try:
        with ExitStack() as stack:
            built = build_arm(arm, wear_name, seed=seed, resistance=faults.sag)
            truth = None if log is None else TruthLog.open(log, arm.joints)
            if truth is not None:
                stack.callback(truth.close)
            server = serve_bus(BusSession(built, seed=seed, faults=faults, log=truth), host=host, port=port, pty=pty)
            server.on_death = lambda: os._exit(DIED)
            stack.callback(server.stop)
            announce(server.address)
            server.run()
    except KeyboardInterrupt:
        return
