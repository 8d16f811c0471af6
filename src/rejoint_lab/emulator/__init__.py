"""A worn arm behind its wire."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rejoint.arms import Arm
from rejoint.robots.wireserver import Server, TerminalServer
from rejoint.system.errors import InputError
from rejoint_lab.emulator.faults import NONE, SERVO_BUS, Faults, parse_faults, size_of
from rejoint_lab.emulator.feetech import BusSession, build_arm
from rejoint_lab.emulator.firmware import Firmware
from rejoint_lab.emulator.servers import (
    EmulatedConversation,
    Timing,
    TruthLog,
    WireSession,
    on_port,
    serve_pty,
    serve_tcp,
)
from rejoint_lab.plant.servo import has_these_servos

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


DIED = 1
"""Exit code after a fault"""


def build_firmware(arm: Arm, wear_name: str, *, seed: int = 0) -> Firmware:
    """Firmware of an arm at rest, with the wear profile ``wear_name``."""
    from rejoint_lab.plant.plant import Plant
    from rejoint_lab.plant.wear import load_wear

    plant = Plant(arm, [load_wear(wear_name, arm)], seed=seed)
    firmware = Firmware(plant, arm, seed=seed)
    firmware.advance(0.01)  # compiles the plant now instead of during the first request
    return firmware


def emulate(
    arm: Arm,
    wear_name: str,
    *,
    place: tuple[str, int] | None = ("127.0.0.1", 9000),
    seed: int = 0,
    announce: Callable[[str], None],
    log: Path | None = None,
    faults: Faults = NONE,
) -> None:
    """Serve a worn arm at a ``place`` or on a pseudo-terminal; ``announce`` receives its address.

    InputError, ProfileError, FileError.
    """
    on_bus = has_these_servos(arm)
    for name in () if on_bus else SERVO_BUS:
        if name in faults:
            raise InputError(f"the fault {name} is one of an arm on its servos' own bus, as --arm so101 is")
    with contextlib.suppress(KeyboardInterrupt), contextlib.ExitStack() as stack:
        truth = None if log is None else TruthLog.open(log, arm.joints)
        if truth is not None:
            stack.callback(truth.close)
        session: EmulatedConversation[Any]
        if on_bus:
            servos = build_arm(arm, wear_name, seed=seed, resistance=size_of(faults, "sag"))
            session = BusSession(servos, seed=seed, faults=faults, log=truth)
        else:
            session = WireSession(build_firmware(arm, wear_name, seed=seed), seed=seed, faults=faults, log=truth)
        server = TerminalServer(session) if place is None else on_port(session, *place)
        server.on_death = lambda: os._exit(DIED)
        stack.callback(server.stop)
        announce(server.address)
        server.run()
