"""A worn arm for anyone to connect to: plant, firmware and server put together."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import cast

from rejoint.arms import Arm
from rejoint.robots.lab.emulator.faults import NONE, SERVO_BUS, Faults
from rejoint.robots.lab.emulator.firmware import Firmware
from rejoint.robots.lab.emulator.plantlike import PlantLike
from rejoint.robots.lab.emulator.servers import serve_pty, serve_tcp
from rejoint.robots.lab.emulator.truthlog import TruthLog
from rejoint.system.errors import InputError

DIED = 1
"""Exit code of an emulator that a fault let die."""


def build_firmware(arm: Arm, wear_name: str, *, seed: int = 0) -> Firmware:
    """Put an arm with the wear profile ``wear_name``, at rest in its rest posture, behind firmware."""
    from rejoint.robots.lab.plant.plant import Plant
    from rejoint.robots.lab.plant.wear import load_wear

    plant = Plant(arm, [load_wear(wear_name, arm)], seed=seed)
    firmware = Firmware(cast(PlantLike, plant), arm, seed=seed)
    firmware.advance(0.01)  # compiles the plant now instead of during the first request
    return firmware


def emulate(
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
    """Serve a worn arm until interrupted (Ctrl-C); ``announce`` gets its address once it can be reached.

    With ``log`` the true tool position is written there as CSV. If ``faults`` let it die, the whole process ends on
    the spot with exit code 1. Raises InputError if the port cannot be used, ProfileError for a wear profile that does
    not exist, FileError if the log cannot be written.
    """
    for name in SERVO_BUS:
        if getattr(faults, name) != getattr(NONE, name):
            raise InputError(f"the fault {name} is one of an arm on its servos' own bus, as --arm so101 is")
    try:
        with ExitStack() as stack:
            firmware = build_firmware(arm, wear_name, seed=seed)
            truth = None if log is None else TruthLog.open(log, arm.joints)
            if truth is not None:
                stack.callback(truth.close)
            if pty:
                server = serve_pty(firmware, seed=seed, log=truth, faults=faults)
            else:
                server = serve_tcp(firmware, host, port, seed=seed, log=truth, faults=faults)
            server.on_death = lambda: os._exit(DIED)
            stack.callback(server.stop)
            announce(server.address)
            server.run()
    except KeyboardInterrupt:
        return
