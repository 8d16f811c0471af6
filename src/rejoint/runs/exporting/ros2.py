"""The controller of a run as a ROS 2 package: text and ``controller.onnx``, for a ``forward_command_controller``."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from rejoint.arms.urdf import at_targets, unit_arm, write_urdf
from rejoint.runs.exporting.bundle import notice, package_name, usual_period, write_controller
from rejoint.runs.given import as_calibration
from rejoint.runs.run import Run
from rejoint.system.files import write_whole
from rejoint.system.version import __version__

if TYPE_CHECKING:
    from rejoint.runs.exporting.controllergraph import Design

_TEMPLATES = files("rejoint.runs.exporting") / "ros2_files"

_FILES = {
    "package.xml.txt": "package.xml", "setup.py.txt": "setup.py", "setup.cfg.txt": "setup.cfg",
    "node.py.txt": "{package}/node.py", "controller.py.txt": "{package}/controller.py",
    "launch.py.txt": "launch/controller.launch.py", "controllers.yaml.txt": "config/controllers.yaml",
    "README.md.txt": "README.md",
}  # fmt: skip
"""Templates, and where they go"""


def write_package(run: Run, folder: Path) -> Design:
    """Write the package into ``folder``; returns what is in it. Words between @ are filled in."""
    package = package_name(run.arm)
    inside = folder / package
    inside.mkdir(parents=True, exist_ok=True)
    design = write_controller(run, inside / "controller.onnx")
    low, high = design.periods
    words = {
        "PACKAGE": package, "VERSION": __version__.split("+")[0], "ARM": run.arm.name, "CONTROLLER": design.name,
        "JOINTS": ", ".join(run.arm.joint_names), "PERIOD": f"{usual_period(design):.4f}", "LOW": f"{low:g}",
        "HIGH": f"{high:g}", "OUTSIDE": notice(design),
    }  # fmt: skip
    for template, place in _FILES.items():
        text = (_TEMPLATES / template).read_text(encoding="utf-8")
        for word, value in words.items():
            text = text.replace(f"@{word}@", value)
        _write(folder / place.format(package=package), text)
    _write(inside / "__init__.py", "")
    _write(folder / "resource" / package, "")
    found = as_calibration(None, run, run.arm)
    if found is not None and found.used:
        unit = unit_arm(run.arm, found.displacement.rigid(run.arm, at_targets(run.arm)))
        write_urdf(
            folder / "urdf" / f"{run.arm.name}.urdf", unit, "This unit: the corrections are in the joint origins."
        )
    return design


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))
