"""Measurements of the real tool at rest, and their files: JSON and CSV.

Rows of one ``posture`` approach it from different sides, which shows play. Columns of a CSV: ``position.JOINT``;
optional ``x``, ``y``, ``z``, ``sigma`` of the tool; ``posture``. Each name ends with its unit (``position.joint1_deg``,
``X [mm]``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rejoint.arms import Arm, Array, Index, Mask, tcp_position
from rejoint.arms.rotations import pose_of
from rejoint.arms.workspace import in_metres
from rejoint.logs.runlog import AXES
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import MEGABYTE, read_json, write_json
from rejoint.system.records import Readable, entity, taken, value_type
from rejoint.system.textfile import ANGLES, COUNT, LENGTHS, read_columns

Numbers = NDArray[np.int64]

NOISE = 0.5e-3
"""[m] default sigma of a coordinate; chosen: a ruler read with care"""


ROWS = ("position", "point", "sigma", "posture")
"""Fields of `Measurements` with a row each"""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Measurements(Readable):
    """M measurements of one arm of n joints."""

    position: Array
    """(M, n) [rad] by encoders"""
    point: Array
    """(M, 3) [m] tool in ``frame``; NaN where not measured"""
    sigma: Array
    """(M,) [m] sigma of each coordinate"""
    posture: Numbers
    """(M,) rows of one number visit one posture"""
    frame: str = "base"
    """``base``, or the name of a frame to fit"""
    source: str = "touch"
    """``touch``, ``camera`` or ``tracker``"""

    def __post_init__(self) -> None:
        rows = len(self.position)
        shapes = {"position": np.shape(self.position), "point": (rows, 3), "sigma": (rows,), "posture": (rows,)}
        for name, shape in shapes.items():
            array = np.array(getattr(self, name), dtype=np.int64 if name == "posture" else np.float64)
            if array.shape != shape:
                raise InputError(f"measurements: {name} has shape {array.shape}, expected {shape}")
            object.__setattr__(self, name, array)
        if np.isinf(self.point).any() or not (np.isfinite(self.point).any(axis=1)).all():
            raise InputError("measurements: every row needs at least one coordinate of the tool, in metres")
        if not np.isfinite(self.position).all() or not (self.sigma > 0.0).all():
            raise InputError("measurements: joint positions must be finite and standard deviations positive")

    def __len__(self) -> int:
        return len(self.sigma)

    def joined(self, more: Measurements) -> Measurements:
        """Add rows."""
        both: dict[str, Any] = {name: np.concatenate([getattr(self, name), getattr(more, name)]) for name in ROWS}
        return replace(self, **both)

    def rows(self, where: Mask | Index) -> Measurements:
        """Return some rows."""
        return taken(self, ROWS, where)


@value_type
class MeasuringSession:
    """Progress of an interrupted measuring session."""

    plan: str
    """`rejoint.diagnosis.calibration.procedure.Suggestion.digest`"""
    answered: int
    """postures measured or left out"""
    fresh: bool = False
    """ignore earlier calibrations"""


FEWEST = 4
"""Complete points that a pose needs; chosen"""
_FLAT = 0.02  # [m] least extent of the points across their longest direction (chosen: ten times the error of a point)


def align(arm: Arm, measurements: Measurements) -> Array:
    """Pose (4, 4) of the measuring frame nearest to the encoders (Kabsch 1976); InputError if undetermined."""
    whole = np.isfinite(measurements.point).all(axis=1)
    if whole.sum() < FEWEST:
        raise InputError(
            f"measurements in the frame {measurements.frame!r}: {int(whole.sum())} points with all three coordinates, "
            f"expected at least {FEWEST} to find out where that frame is; measure more, or in the frame of the base"
        )
    seen = measurements.point[whole]
    told = tcp_position(arm, measurements.position[whole])
    apart_seen, apart_told = seen - seen.mean(axis=0), told - told.mean(axis=0)
    if np.sqrt(np.linalg.svd(apart_seen.T @ apart_told)[1][1] / len(seen)) < _FLAT / 2:
        raise InputError(
            f"measurements in the frame {measurements.frame!r}: all points lie on a line, which leaves its pose open; "
            "measure points that lie apart in two directions at least"
        )
    rotation = Rotation.align_vectors(apart_told, apart_seen)[0].as_matrix()
    return pose_of(rotation, told.mean(axis=0) - rotation @ seen.mean(axis=0))


SHEET_MOST = 4 * MEGABYTE
"""Largest CSV file; chosen: ten thousand rows"""


@entity
class MeasurementFile:
    """Content of a file of measurements."""

    arm: str
    joints: tuple[str, ...]
    measured: Measurements
    session: MeasuringSession | None = None
    """None: it is complete"""


def _of(path: Path, arm: Arm) -> MeasurementFile:
    """Read a JSON file of ``arm``; FileError for another one's."""
    found = read_json(path, MeasurementFile)
    if (found.arm, found.joints) != (arm.name, arm.joint_names):
        raise FileError(path, f"of arm {found.arm}, expected {arm.name}", "name the right arm")
    return found


def write_measurements(path: Path, arm: Arm, measured: Measurements, session: MeasuringSession | None = None) -> None:
    """Write measurements as JSON; ``session``: progress."""
    write_json(path, MeasurementFile(arm=arm.name, joints=arm.joint_names, measured=measured, session=session))


def read_interrupted(path: Path, arm: Arm) -> tuple[Measurements, MeasuringSession] | None:
    """Read interrupted measurements and progress; None if complete."""
    found = _of(path, arm)
    return None if found.session is None else (found.measured, found.session)


def read_measurements(path: Path, arm: Arm, *, frame: str = "base", sigma: float = NOISE) -> Measurements:
    """Read JSON, or text with columns, measured in ``frame`` within ``sigma`` [m] unless it says so; FileError."""
    if path.suffix.lower() == ".json":
        return _of(path, arm).measured
    return _from_csv(path, arm, frame, sigma)


BEYOND = np.radians(10.0)
"""[rad] tolerated beyond joint limits; chosen"""


def joint_columns(arm: Arm) -> list[str]:
    """Names of the columns of positions."""
    return [f"position.{name}" for name in arm.joint_names]


def require_degrees(path: Path, position: Array) -> None:
    """Raise FileError if positions (M, n) [rad] were given in radians, and taken for degrees."""
    if len(position) > 1 and (np.abs(np.degrees(position)) <= np.pi).all():
        raise FileError(path, "every joint position lies between -3.14 and 3.14", "give degrees, not radians")


def _from_csv(path: Path, arm: Arm, frame: str, sigma: float) -> Measurements:
    joints = joint_columns(arm)
    meanings = dict.fromkeys(joints, ANGLES) | dict.fromkeys((*AXES, "sigma"), LENGTHS) | {"posture": COUNT}
    found, lines = read_columns(path, meanings, joints, {*joints, "sigma", "posture"}, most=SHEET_MOST)
    if not len(lines):
        raise FileError(path, "no measurements below the header", "add one line for each")
    columns = dict.fromkeys(AXES, np.full(len(lines), np.nan)) | found
    seen = np.isfinite([columns[axis] for axis in AXES]).any(axis=0)  # as an empty answer at the prompt leaves one out
    lines = lines[seen]
    if not len(lines):
        raise FileError(path, "no line has a coordinate of the tool", "measure at least one of x_mm, y_mm and z_mm")
    columns = {name: values[seen] for name, values in columns.items()}
    position, point = (np.stack([columns[one] for one in names], axis=-1) for names in (joints, AXES))
    try:
        measured = Measurements(
            position=position,
            point=point,
            sigma=columns.get("sigma", np.full(len(lines), sigma)),
            posture=columns.get("posture", np.arange(len(lines))),
            frame=frame,
            source="tracker",
        )
    except InputError as error:
        raise FileError(path, str(error), "measure again, or take another file") from error
    _require_units(path, arm, measured, lines)
    return measured


def _require_units(path: Path, arm: Arm, measured: Measurements, lines: Numbers) -> None:
    beyond = (measured.position < arm.lower - BEYOND) | (measured.position > arm.upper + BEYOND)
    if beyond.any():
        row, joint = np.argwhere(beyond)[0]
        low, high = np.degrees(arm.lower[joint]), np.degrees(arm.upper[joint])
        angle = np.degrees(measured.position[row, joint])
        raise FileError(
            path,
            f"line {lines[row]}: {arm.joint_names[joint]} at {angle:.1f} deg, expected {low:.0f} to {high:.0f}",
            "give what this arm's encoders said, in degrees",
        )
    require_degrees(path, measured.position)
    if measured.frame == "base" and in_metres(measured.point):
        raise FileError(path, "every coordinate of the tool is below 5", "give millimetres, not metres")
