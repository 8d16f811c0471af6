"""What hinders a repair: `rejoint doctor` goes through a table of checks, each with its remedy."""

import os
import platform
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.arms import Arm
from rejoint.cli.options import Call, takes
from rejoint.control.robot import Robot
from rejoint.control.start import Symptom, look_at_servos
from rejoint.robots import Place, open_robot, place_of
from rejoint.robots import ports as lines
from rejoint.runs.run import Run
from rejoint.system.errors import AddressError, RejointError, RobotError, first_line
from rejoint.system.extras import EXTRAS, compiles_first, explain, install_line, installed, require, require_compiler
from rejoint.system.shell import __version__

ILL = 2
"""Exit code where something is to be put right"""
ROOM = 1e9
"""[bytes] of free space (chosen: a run, its logs and compiled loops take a tenth)"""
BUSY = 0.8
"""Largest share of a control period that a question may take (chosen)"""
READINGS = 10
"""Questions by which the link is timed (chosen)"""
COBOT = ("tcp", "serial")
"""Addresses of a myCobot"""
TRIED = 7.3
"""Firmware version of a myCobot with which the driver was tried"""


@dataclass(kw_only=True)
class Surroundings:
    """What is looked at: this computer, and what of robot, run and camera was named."""

    robot: str | None
    run: Path | None
    camera: int | None
    stack: ExitStack = field(default_factory=ExitStack)
    """closes what was opened"""
    opened: Robot | None = None
    arm: Arm | None

    @property
    def place(self) -> Place[object] | None:
        """The address, if it is one."""
        with suppress(AddressError):
            return place_of(self.robot or "")
        return None


def examine(case: Surroundings) -> Iterator[tuple[str, Symptom]]:
    """Go through `CHECKS`; an error of the project is a finding, and names its remedy behind the semicolon."""
    with case.stack:
        for check in CHECKS:
            try:
                for found in check(case):
                    yield check.__name__, found
            except (RejointError, OSError, ImportError, RuntimeError) as error:
                text, _, fix = (explain(error) or first_line(error)).partition("; ")
                yield check.__name__, Symptom(text, fix or "see docs/troubleshooting.md")


def extras(case: Surroundings) -> Iterator[Symptom]:
    """Name the extras that are missing for a repair, and the others that are there."""
    needed = {
        "train",
        "report",
        *(() if case.place is None else case.place.family.needs),
        *["camera"] * (case.camera is not None),
    }
    there = {name: all(map(installed, modules)) for name, modules in EXTRAS.items()}
    missing = [name for name in needed if not there.get(name, installed(name))]
    if missing:
        yield Symptom(f"not installed: {', '.join(sorted(missing))}", install_line(missing))
    yield Symptom(f"installed: {', '.join(name for name, one in there.items() if one) or 'none'}")


def compiler(_: Surroundings) -> Iterator[Symptom]:
    """Compile something."""
    require_compiler()
    from numba import njit

    began = time.monotonic()
    try:
        njit(lambda value: value + 1)(1)
    except Exception as error:  # noqa: BLE001 - whatever is wrong with it
        yield Symptom(
            f"Numba cannot compile ({type(error).__name__}: {first_line(error)})",
            "install it again: pip install --force-reinstall numba llvmlite",
        )
        return
    told = "; the first motion compiles its loops, once, which takes about 15 s" * compiles_first()
    yield Symptom(f"Numba compiles in {time.monotonic() - began:.1f} s{told}")


def disk(case: Surroundings) -> Iterator[Symptom]:
    """Look for space where runs and temporary files go."""
    run = case.run if case.run and case.run.is_dir() else Path.cwd()
    for folder in dict.fromkeys((Path.cwd(), Path(tempfile.gettempdir()), run)):
        free, writable = shutil.disk_usage(folder).free, os.access(folder, os.W_OK)
        fix = "" if free >= ROOM else f"free {(ROOM - free) / 1e6:.0f} MB there, or work in another folder"
        yield Symptom(
            f"{free / 1e9:.1f} GB free in {folder}",
            fix if writable else "allow writing there, or work in another folder",
        )


def clock(case: Surroundings) -> Iterator[Symptom]:
    """Compare the clock with files that were written."""
    newest = max(path.stat().st_mtime for path in (Path(__file__), case.run or Path(__file__)) if path.exists())
    late = newest - time.time() > 60.0
    now = f"it is {datetime.now():%Y-%m-%d %H:%M:%S}"
    yield Symptom(now + ", but files here are newer" * late, "set it: sudo timedatectl set-ntp true" * late)


def ports(_: Surroundings) -> Iterator[Symptom]:
    """List the ports, with who may open them."""
    found = lines.ports()
    for device, what in found.items():
        yield Symptom(f"{device}, {what}", (lines.refused(device) or "").partition("; ")[2])
    if not found:
        yield Symptom("none on this computer")


def camera(case: Surroundings) -> Iterator[Symptom]:
    """Take a picture."""
    if case.camera is None:
        return
    from rejoint.camera.tracker import LiveCamera

    with LiveCamera(case.camera) as opened:
        opened.picture()
        yield Symptom(f"camera {case.camera} gives pictures")


def run(case: Surroundings) -> Iterator[Symptom]:
    """Read a run, and compare it with the robot."""
    if case.run is None:
        return
    opened, place = Run.open(case.run), case.place
    case.arm = opened.arm
    for part in ("diagnosis", "twin", "policy", "comparison"):
        getattr(opened, part)
    if place is not None and not opened.info.from_logs and place_of(opened.robot).spot != place.spot:
        other = opened.arm.name != place.default_arm and place.family.only
        yield Symptom(
            f"{case.run} is a run of {opened.robot} ({opened.arm.name}), and not of {place}",
            f"give another RUN, or repair this arm: rejoint repair {place}"
            if other or place.virtual
            else "give another RUN, unless the same arm has moved there",
        )
    elif not opened.folder.calibration.exists():
        yield Symptom(
            f"{case.run} has no calibration: the tool may be millimetres from where the encoders see it",
            f"rejoint calibrate {opened.robot} {case.run} --measure touch",
        )
    else:
        yield Symptom(f"{case.run} is a run of {opened.robot}, with a calibration")


def robot(case: Surroundings) -> Iterator[Symptom]:
    """Open the robot: port, permissions, baud rate, protocol, IDs, zeros."""
    if case.robot is None:
        return
    place = place_of(case.robot)
    require(place.text, *place.family.needs)
    if place.virtual:
        case.stack.callback(open_robot(place.text).close)
        yield Symptom(f"{place} is emulated in this process")
        return
    if other := lines.other_arm(place):
        found, _, fix = other.partition(": ")
        yield Symptom(f"{found.removesuffix(' answers there')} answers at {place}", fix)
        return
    case.opened = open_robot(place.text, arm=case.arm)
    case.stack.callback(case.opened.close)
    yield Symptom(f"{place} answers: {case.opened.arm.name}, {case.opened.arm.joints} joints")


def servos(case: Surroundings) -> Iterator[Symptom]:
    """Look at firmware, temperatures, supply and status of each servo."""
    if case.opened is None:
        return
    arm, state = case.opened.arm, case.opened.read()
    if case.place is not None and case.place.family.scheme in COBOT:
        version, power = (_reply_of(case.opened, method) for method in ("get_system_version", "get_servo_voltages"))
        expected, fix = ("", "") if version == TRIED else (f", expected {TRIED}", "update it with the maker's myStudio")
        yield Symptom(f"firmware: {version or 'none'}{expected}", fix)
        state = replace(state, voltage=np.array(power, float)[None] if np.size(power) == arm.joints else None)
    yield from look_at_servos(arm, state)


def _reply_of(robot: Any, method: str) -> Any:  # noqa: ANN401
    """Return what a myCobot answers to a method of the vendor's client; None: nothing."""
    with suppress(RobotError):
        return robot.bus.ask(method)
    return None


def link(case: Surroundings) -> Iterator[Symptom]:
    """Time questions, against the control period."""
    if case.opened is None or case.place is None:
        return
    took = []
    for _ in range(READINGS):
        began = time.monotonic()
        case.opened.read()
        took.append(1e3 * (time.monotonic() - began))
    usual, period = float(np.median(took)), 1e3 * case.place.default_period[0]
    fix = f"use a cable or a nearer computer; else --period {usual / BUSY:.0f}" * (usual > BUSY * period)
    yield Symptom(
        f"a question takes {usual:.0f} ms ({max(took):.0f} at most), the control period is {period:.0f} ms", fix
    )


CHECKS = (extras, compiler, disk, ports, camera, run, robot, servos, link, clock)
"""All checks, in their order"""


@takes
def doctor(call: Call, robot: str | None = None, run: Path | None = None, camera: int | None = None) -> object:
    """Look for what hinders a repair, and say how to put it right; nothing moves."""
    system = f"{platform.platform()}, {os.cpu_count()} processors"
    call.result(f"rejoint {__version__}, Python {platform.python_version()}, {system}")
    ill, rows = 0, []
    arm = call.arm() if call.pick.arm else None
    for name, one in examine(Surroundings(robot=robot, run=run, camera=camera, arm=arm)):
        ill += bool(one.fix)
        rows.append({"check": name, **one._asdict()})
        call.result(f"{'FIX ' if one.fix else 'ok  '} {name}: {one.found}{f'; {one.fix}' if one.fix else ''}")
    call.result(f"{ill or 'Nothing'} to put right.")
    call.code = ILL if ill else 0
    return {"version": __version__, "system": system, "findings": rows, "to_fix": ill}
