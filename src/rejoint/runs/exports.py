"""What was learned about an arm, for other programs and people: URDF, joint zeros, data sheet, controller."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

from rejoint.arms import Displacement
from rejoint.arms.urdf import at_targets, unit_arm, write_urdf
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.logs.homing import corrected_homing, write_homing
from rejoint.runs.given import RunLike, as_calibration, as_run
from rejoint.runs.run import Run
from rejoint.system.errors import FileError, InputError
from rejoint.system.extras import require

Kind = Literal["urdf", "lerobot", "datasheet", "onnx", "ros2"]
KINDS: tuple[str, ...] = get_args(Kind)


def export_run(run: RunLike, kind: str, out: Path | None = None, *, lerobot: Path | None = None) -> tuple[Path, str]:
    """Write what a run has found out about its arm; returns the file and a sentence about it.

    ``kind`` is ``urdf``: the description of this unit, its zeros and links corrected by the calibration; ``lerobot``:
    the calibration file ``lerobot`` of LeRobot with corrected homing offsets; ``datasheet``: one page about the arm;
    ``onnx``: the whole controller as ``controller.onnx`` with a LEAPP description beside it; ``ros2``: a folder that
    makes it a node. By default the file is written into the run's folder. FileError or InputError where something that
    it takes is missing.
    """
    about = as_run(run)
    if kind not in KINDS:
        raise InputError(f"--format {kind!r}: expected {', '.join(KINDS)}")
    if (lerobot is None) == (kind == "lerobot"):
        raise InputError(
            "--format lerobot takes --lerobot FILE, the calibration file of the arm, and no other format does"
        )
    if kind == "datasheet":
        require("rejoint export --format datasheet", "report")
        from rejoint.pages.report.datasheet import write_datasheet

        return write_datasheet(about.path, out or about.path / "datasheet.html"), "One page; print it on A4."
    if kind in ("onnx", "ros2"):
        return _controller(about, kind, out)
    return _urdf(about, out) if lerobot is None else _homing(about, lerobot, out)


def _rigid(run: Run) -> tuple[Calibration, Displacement]:
    """Return the calibration of a run, and what of it rigid links have in the region of targets."""
    found = as_calibration(None, run, run.arm)
    if found is None:
        raise FileError(run.folder.calibration, "no such file", f"make it with: rejoint calibrate ROBOT {run.path}")
    if not found.used:
        raise FileError(
            run.folder.calibration, "correcting by it does not clearly help, so there is nothing to export",
            "measure more points",
        )  # fmt: skip
    return found, found.displacement.rigid(run.arm, at_targets(run.arm))


def _urdf(run: Run, out: Path | None) -> tuple[Path, str]:
    found, rigid = _rigid(run)
    path = out or run.path / f"{run.arm.name}.urdf"
    note = (
        f"This unit as calibrated on {found.date} from {found.points} measurements ({found.source}): zeros and links "
        "are in the joint origins, with the mean effect of play and flex over the region of targets."
    )
    write_urdf(path, unit_arm(run.arm, rigid), note)
    return path, "The corrections are in the joint origins; a program that reads encoders needs no other."


def _homing(run: Run, source: Path, out: Path | None) -> tuple[Path, str]:
    _, rigid = _rigid(run)
    motors, changes = corrected_homing(source, run.arm, rigid.offset)
    path = out or run.path / "lerobot.json"
    if path.exists() and path.samefile(source):
        raise InputError(f"{path} is the file that is read; name another one to write")
    write_homing(path, motors)
    told = ", ".join(f"{name} {change:+d}" for name, change in changes.items())
    return path, f"Homing offsets changed by {told} counts (present position = raw - homing_offset)."


def _controller(run: Run, kind: str, out: Path | None) -> tuple[Path, str]:
    require(f"rejoint export --format {kind}", "onnx")
    from rejoint.runs.exporting.bundle import notice, write_controller
    from rejoint.runs.exporting.ros2 import write_package

    if kind == "ros2":
        folder = out or run.path / "ros2"
        design = write_package(run, folder)
        return folder, f"The controller in it is the {design.name}. {notice(design)}"
    path = out or run.path / "controller.onnx"
    if path.suffix != ".onnx":
        raise InputError(f"{path}: expected a file that ends with .onnx")
    design = write_controller(run, path)
    return path, f"The controller is the {design.name}; {path.with_suffix('.yaml').name} describes it. {notice(design)}"
