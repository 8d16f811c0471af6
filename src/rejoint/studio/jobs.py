"""Jobs of the steps: each calls the public functions, or the session, as any program does."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import rejoint
from rejoint.arms import Arm, Array
from rejoint.control.controllers.classical import DefaultController
from rejoint.control.recording import StageObserver
from rejoint.control.start import look_at_servos
from rejoint.diagnosis.calibration.procedure import TouchGauge
from rejoint.logs.history import find_rows
from rejoint.logs.runfolder import RunFolder, runs_below
from rejoint.robots import is_virtual, place_of, usable
from rejoint.robots.ports import arm_at, ports
from rejoint.runs.exports import export_run
from rejoint.runs.fleet.file import known_arms, named_arm
from rejoint.runs.history import arms_of, cells
from rejoint.runs.repair import stages_of
from rejoint.runs.run import Run
from rejoint.session.inputs import GaugeLike, arm_of
from rejoint.studio.machine import Studio
from rejoint.system.errors import InputError, NotReadyError, RejointError
from rejoint.system.files import read_shipped

if TYPE_CHECKING:  # an extra
    from rejoint.camera.board import BoardView, Picture

_TABLES = read_shipped(__file__, "jobs.toml", dict[str, dict[str, Any]])
SAYS, EXPECTED = (_TABLES[name] for name in ("says", "expected"))
"""What a finding says at its joint; seconds of stages before their own pace is known"""
LEAST = 1.0
"""[mm] at the tool that is worth a word at a joint (chosen)"""
EARLY = 0.05
"""Share of a job from which its pace tells when it ends (chosen)"""
NUDGE = np.radians(5.0)
"""[rad] of the motion that the owner confirms (chosen)"""
EMULATED = {"Emulated myCobot 280, worn": "emulated:worn", "Emulated SO-101, worn": "emulated:so101"}


def candidates(home: Path) -> dict[str, str]:
    """Return names or addresses by what the page calls arms: named, connected, repaired below ``home``, emulated."""
    found = {f"{one.name}, {one.address}": one.name for one in known_arms()}
    for device, what in ports().items():
        heard = arm_at(device)
        found[f"{heard or 'no arm answers; is it switched on?'}, on {device} ({what})"] = heard or ""
    for address in runs(home):
        if address not in (*found.values(), *EMULATED.values()):
            found[f"{address}, known from before"] = address
    return found | {name: address for name, address in EMULATED.items() if usable(address)}


def runs(home: Path, arm: Arm | None = None, name: str = "") -> dict[str, Path]:
    """Return the newest run of every address below ``home``, of this ``arm`` and ``name`` if given."""
    found = dict[str, Path]()
    for folder, info in runs_below(home).items():
        with suppress(RejointError):
            run = Run.open(folder.path)
            other = (arm and run.other_than(arm)) or (name and info.name not in ("", name))
            if ":" in info.robot and not info.from_logs and not other:
                found.setdefault(info.robot, folder.path)
    return dict(sorted(found.items()))


def look(studio: Studio) -> None:
    """Look for arms."""
    studio.keep(arms=candidates(studio.home))


def choose(studio: Studio, address: str, name: str | None = None) -> None:
    """Connect to an arm; nothing moves."""
    if not address:
        raise InputError("no arm answers there; choose another from the list, or type its address")
    studio.release()
    named = named_arm(address)
    place = place_of(address if named is None else named.address)
    arm = arm_of(place.text, name if named is None else name or named.description)
    before, settings, known = studio.status, studio.settings, named.name if named else ""
    run, found = runs(studio.home, arm, known).get(place.text), {"arms": before.found.get("arms")}
    studio.change(name=known, address=place.text, arm=arm, run=run, found=found)
    studio.settings = rejoint.Settings()
    try:
        see(studio)
    except BaseException:
        studio.change(name=before.name, address=before.address, arm=before.arm, run=before.run, found=before.found)
        studio.settings = settings
        raise
    begun = studio.run
    studio.keep(diagnosis=begun and begun.diagnosis)
    studio.change(step="use" if begun and begun.comparison else "check")


def see(studio: Studio) -> None:
    """Check the servos; nothing moves."""
    session = studio.session()
    session.look()
    found = tuple(look_at_servos(session.arm, session.robot.read()))
    studio.keep(checks=found)
    bad = [f"{one.found}; {one.fix}" for one in found if one.fix]
    if bad:
        raise NotReadyError(". ".join(bad))


def nudge(studio: Studio) -> None:
    """Move the last but one joint a little, and ask the owner whether it did."""
    session = studio.session()
    j = max(session.arm.joints - 2, 0)
    here = session.state.joints_rad
    middle = 0.5 * (session.arm.lower[j] + session.arm.upper[j])
    away = here.copy()
    away[j] += NUDGE if here[j] < middle else -NUDGE
    name = session.arm.joint_names[j]
    for number, goal in enumerate((away, here, away, here)):
        studio.progress(number / 4, f"{name} turns by {np.degrees(NUDGE):.0f} degrees, and back")
        session.move_joints(np.clip(goal, session.arm.lower, session.arm.upper), within_rad=np.radians(3.0))
    if studio.ask(f"Did {name} alone turn a little, and come back?", "yes", "no") != "yes":
        raise NotReadyError(f"{name} did not move as expected: compare cables and IDs with the arm's description")
    studio.change(step="diagnose", done=f"{name} answers. The arm is ready.")


def diagnose(studio: Studio, quick: bool) -> None:
    """Find out what is wrong with the arm."""
    studio.keep(diagnosis=None)
    studio.keep(diagnosis=studio.call(rejoint.diagnose, run=studio.begin_run(quick=quick), quick=quick).diagnosis)
    studio.change(done="Diagnosed. What was found is written at the joints.")


def marks(arm: Arm, diagnosis: rejoint.Diagnosis | None) -> dict[int, str]:
    """Return what stands at the joints: the largest finding of each."""
    found = dict[int, str]()
    for one in () if diagnosis is None else diagnosis.findings:
        j = arm.joint_names.index(one.joint)
        if one.tcp_mm >= LEAST:
            found.setdefault(j, f"{one.joint} {SAYS[one.kind]} {one.tcp_mm:.0f} mm")
    return found


def left(studio: Studio) -> str:
    """Return in words how long the job still takes; empty: unknown."""
    status, stage = studio.status, studio.status.stage
    if not status.busy or status.question:
        return ""
    elapsed, share, usual, later = time.monotonic() - status.began, status.share, 0.0, 0.0
    pace = 0.2 if is_virtual(status.address) else 1.0
    if stage is not None and status.run is not None and status.arm is not None:
        planned = list(stages_of(status.address, status.arm, RunFolder(status.run)))
        coming = planned[planned.index(stage.name) + 1 :]
        usual = pace * EXPECTED.get(stage.name, 0.0)
        later = pace * sum(EXPECTED[name] for name in coming)
    now = elapsed * (1.0 - share) / share if share > EARLY else max(usual - elapsed, 0.0)
    seconds = now + later
    about = f"{seconds:.0f} s" if seconds < 90.0 else f"{seconds / 60.0:.0f} min"
    return f"about {about} left" if seconds else ""


def repair(studio: Studio, quick: bool) -> None:
    """Repair the arm; it goes on where an earlier repair ended."""
    run = studio.begin_run(quick=quick)
    done = studio.call(rejoint.repair, run=run, quick=quick)
    from rejoint.pages.report.page import read_contents  # late: a repair has asked for what it needs

    errors, advice = read_contents(run.path).before_after(), done.recommendation
    sentence = "" if errors is None else errors.sentence
    if quick:
        sentence = f"A quick try, which is no result. {sentence}"
    studio.keep(diagnosis=done.diagnosis, repaired=sentence, advice=advice)
    studio.change(done=f"Repaired. {advice.controller if advice else ''} drives the arm from now on.")


def again(studio: Studio) -> None:
    """Begin another run of the same arm with the next job."""
    studio.release()
    studio.change(run=None, step="diagnose")
    studio.keep(diagnosis=None, repaired=None, advice=None, proof=None)


def calibrate(studio: Studio, by: str, count: float, board: str, camera: float) -> None:
    """Measure where the tool is, ``by`` a ruler, the ``camera`` of this number or the emulator."""
    run = studio.begin_run()
    gauge: GaugeLike | None = None
    if by == RULER:
        gauge = TouchGauge(ask=lambda stop: studio.ask(stop.question))
    elif by == CAMERA:
        from rejoint.camera.board import ON_TOOL, read_board
        from rejoint.camera.filming import camera_gauge

        emulated = is_virtual(studio.status.address)
        drawn = ON_TOOL if emulated and not Path(board).exists() else read_board(Path(board))
        gauge = replace(camera_gauge(None if emulated else int(camera), drawn), show=partial(show, studio))
    found = studio.call(rejoint.calibrate, run=run, gauge=gauge, count=int(count))
    helps = "It is used from now on" if found.calibration.used else "It does not clearly help and is not used"
    seen = f"{1e3 * found.before:.1f} mm from where the encoders see it"
    known = f"{1e3 * found.after:.1f} mm from where the calibration does"
    studio.change(done=f"The tool is {seen}, and {known}. {helps}.")


WIDTH = 480
"""[px] of a shown picture (chosen)"""


def show(studio: Studio, picture: Picture, seen: BoardView) -> None:
    """Show a camera's picture with the corners of the board, or say why it is of no use."""
    import cv2

    drawn = cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB)
    if seen.why:
        studio.message(f"One picture: {seen.why}")
    else:
        for x, y in np.rint(seen.pixel).astype(int).tolist():
            cv2.circle(drawn, (x, y), max(picture.shape[1] // 120, 3), (30, 160, 90), -1)
    height = round(WIDTH * picture.shape[0] / picture.shape[1])
    studio.change(picture=cv2.resize(drawn, (WIDTH, height), interpolation=cv2.INTER_AREA))


RULER, CAMERA, EMULATOR = "a ruler or calliper", "a camera and a printed board", "the emulator"


def gauges(address: str) -> tuple[str, ...]:
    """Return what can measure the tool at an address."""
    return (EMULATOR, CAMERA, RULER) if is_virtual(address) else (RULER, CAMERA)


def prove(studio: Studio, points: Sequence[Array]) -> None:
    """Drive to an owner's ``points`` (3,) [m], first as the arm was and then as it is now."""
    if not points:
        raise InputError("there are no points yet; add some, or click on the table")
    studio.keep(proof=None)
    run, proof = studio.run, []
    plain = replace(studio.settings, controller=DefaultController.name, calibration="none")
    for number, settings in enumerate((plain, studio.settings)):
        part = StageObserver(studio.observer, 0.5 * number, 0.5 * number + 0.5)
        proof.append(studio.call(rejoint.deploy, points, run=run, settings=settings, observer=part))
    studio.keep(proof=tuple(proof))
    before, after = (f"{1e3 * one.error:.2f} mm" for one in proof)
    studio.change(done=f"Before: {before}. After, with {proof[1].controller}: {after}.")


def go_to(studio: Studio, target: Array, within: float = 2e-3) -> None:
    """Bring the tool to ``target`` (3,) [m], and ``within`` [m]."""
    session = studio.session()
    state = session.move_to(target, within_m=within)
    error = np.nan if state is None or state.error_m is None else 1e3 * state.error_m
    studio.change(done=f"There, {error:.2f} mm off by the encoders, driven by {session.controller}.")


SPEED = 0.05
"""[m/s] of a played path (chosen)"""


def play(studio: Studio, points: Sequence[Array], repeat: float) -> None:
    """Drive through ``points`` (3,) [m] as a smooth path."""
    if len(points) < 2:
        raise InputError("a path needs two points; add the places where the tool is to go")
    legs = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    _followed(studio, np.column_stack([np.append(0.0, np.cumsum(legs / SPEED + 0.2)), points]), int(repeat))


def play_file(studio: Studio, content: bytes) -> None:
    """Drive along a path of a CSV file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "path.csv"
        path.write_bytes(content)
        _followed(studio, path, 1)


def _followed(studio: Studio, path: Path | Array, repeat: int) -> None:
    found = studio.session().follow(path, repeat=repeat)
    if found is not None:
        error = found.passes[-1].encoder
        studio.change(
            done=f"Followed: {1e3 * error.rms_after:.2f} mm off on average, {1e3 * error.rms:.2f} mm with its lag."
        )


def carry(studio: Studio, grams: float) -> None:
    """Tell the arm that its hand carries so many ``grams``."""
    told = replace(studio.settings, payload=1e-3 * grams)
    studio.call(rejoint.connect, run=studio.run, settings=told).close()
    studio.settings = told
    studio.change(done=f"The hand carries {grams:.0f} g from now on.")


def serve(studio: Studio, listen: str) -> None:
    """Let other programs drive the arm until it is stopped."""
    run = studio.begin_run()
    rejoint.serve(studio.status.address, run, listen=listen, settings=studio.settings, observer=studio.observer)
    studio.change(done="Serving has ended. The arm holds its position.")


def export(studio: Studio, kind: str, lerobot: str) -> None:
    """Write what the run has found for other programs; ``lerobot``: calibration file of LeRobot."""
    path, told = export_run(studio.begin_run(), kind, lerobot=Path(lerobot) if lerobot and kind == "lerobot" else None)
    studio.change(done=f"{path}: {told}")


def check_again(studio: Studio) -> None:
    """See whether the arm has become worse."""
    name = studio.status.name
    tolerance = (one := named_arm(name)) and one.tolerance_mm
    found = studio.call(rejoint.check, history=studio.home, name=name or None, tolerance_mm=tolerance)
    studio.change(done=f"{found.arm}: {found.line}")
    history(studio)


def history(studio: Studio) -> None:
    """Read the history of all arms."""
    studio.keep(history=tuple(cells(one) for one in arms_of(find_rows(studio.home)[0])))
