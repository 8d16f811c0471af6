"""Files of measurements: Parquet, and CSV for everybody else's tracker, gauge and spreadsheet.

Columns: ``position.JOINT`` and, where it is known, ``approach.JOINT``; ``x``, ``y``, ``z`` and ``sigma`` of the tool;
and ``posture``, the number of the posture. In Parquet they are in rad and m. In CSV every name ends with its unit
(``position.joint1_deg``, ``x_mm``), see `rejoint.diagnosis.calibration.sheets`; an empty cell is a coordinate that was
not measured, a line without any is left out, and ``approach``, ``sigma``, ``posture`` and two of the axes may be
missing.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from rejoint.arms import Arm, Array
from rejoint.arms.size import in_metres
from rejoint.diagnosis.calibration.measurements import NOISE, Measurements, MeasuringSession
from rejoint.diagnosis.calibration.sheets import ANGLES, COUNT, LENGTHS, read_columns
from rejoint.logs.runlog import AXES, read_parquet
from rejoint.system.errors import FileError, InputError, first_line
from rejoint.system.files import CHANGED, write_whole

FORMAT = 1
_KEY = b"rejoint"
_REMEDY = "measure again, or take another file"
_DEG, _MM = np.pi / 180.0, 1e-3


def write_measurements(path: Path, arm: Arm, measured: Measurements, session: MeasuringSession | None = None) -> None:
    """Write measurements of ``arm`` as Parquet, or as CSV where the name ends in ``.csv``.

    ``session`` tells how far they have come; without it they are all, and nothing goes on from them.
    """
    columns = _columns(arm, measured)
    if path.suffix.lower() == ".csv":
        write_whole(path, lambda temporary: temporary.write_text(_as_csv(columns), encoding="utf-8"))
        return
    about: dict[str, Any] = {
        "arm": arm.name,
        "joints": list(arm.joint_names),
        "frame": measured.frame,
        "source": measured.source,
    }
    if session is not None:
        about["session"] = asdict(session)
    header = {"format": FORMAT, **about, "digest": _digest(measured, about.get("session"))}
    table = pa.table(columns).replace_schema_metadata({_KEY: json.dumps(header).encode()})
    write_whole(path, lambda temporary: pq.write_table(table, temporary, write_page_checksum=True))


def read_measurements(path: Path, arm: Arm, *, frame: str = "base", source: str = "tracker") -> Measurements:
    """Read measurements of ``arm``, CSV or Parquet; FileError says what cannot be used and why.

    A CSV file does not tell in which ``frame`` its points are and what their ``source`` is.
    """
    try:
        if path.suffix.lower() == ".csv":
            return _from_csv(path, arm, frame, source)
        return _from_parquet(path, arm)
    except FileNotFoundError as error:
        raise FileError(path, "no such file", "check the path") from error
    except (OSError, pa.ArrowException, UnicodeDecodeError, csv.Error, KeyError, TypeError, ValueError) as error:
        raise FileError(path, f"not readable measurements ({first_line(error)})", _REMEDY) from error


def read_interrupted(path: Path, arm: Arm) -> tuple[Measurements, MeasuringSession] | None:
    """Read measurements in Parquet that were interrupted, and how far they had come; None where they came to the end.

    FileError as `read_measurements`.
    """
    measured = read_measurements(path, arm)
    try:
        session = json.loads((pq.read_schema(path).metadata or {}).get(_KEY, b"{}")).get("session")
        return None if session is None else (measured, msgspec.convert(session, MeasuringSession))
    except (OSError, pa.ArrowException, ValueError, msgspec.MsgspecError) as error:
        raise FileError(path, f"not readable measurements ({first_line(error)})", _REMEDY) from error


def _columns(arm: Arm, measured: Measurements) -> dict[str, Array]:
    columns: dict[str, Array] = {"posture": measured.posture.astype(float)}
    for group in ("position", "approach"):
        columns |= {f"{group}.{name}": getattr(measured, group)[:, i] for i, name in enumerate(arm.joint_names)}
    columns |= {axis: measured.point[:, i] for i, axis in enumerate(AXES)}
    return columns | {"sigma": measured.sigma}


def _digest(measured: Measurements, session: object = None) -> str:
    found = hashlib.sha256(f"{measured.frame} {measured.source}".encode())
    if session is not None:
        found.update(json.dumps(session, sort_keys=True).encode())
    for name in ("position", "approach", "point", "sigma", "posture"):
        found.update(np.ascontiguousarray(getattr(measured, name), dtype="<f8").tobytes())
    return found.hexdigest()[:16]


def _from_parquet(path: Path, arm: Arm) -> Measurements:
    table = read_parquet(path, _REMEDY)
    if _KEY not in (table.schema.metadata or {}):
        raise FileError(path, "no measurements, but some other table", _REMEDY)
    header = json.loads(table.schema.metadata[_KEY])
    if header.get("format") != FORMAT or "frame" not in header:
        raise FileError(path, f"measurements of format {header.get('format')}, expected {FORMAT}", _REMEDY)
    if header["arm"] != arm.name or tuple(header["joints"]) != arm.joint_names:
        raise FileError(path, f"measurements of arm {header['arm']}, expected {arm.name}", "name the right arm")
    columns = {name: table[name].to_numpy() for name in table.column_names}
    found = _assemble(columns, arm, header["frame"], header["source"])
    if header["digest"] != _digest(found, header.get("session")):
        raise FileError(path, CHANGED, _REMEDY)
    return found


def _assemble(columns: dict[str, Array], arm: Arm, frame: str, source: str) -> Measurements:
    rows = len(columns["x"])

    def group(prefix: str) -> Array:
        return np.stack([columns[f"{prefix}.{name}"] for name in arm.joint_names], axis=-1)

    return Measurements(
        position=group("position"),
        approach=group("approach"),
        point=np.stack([columns[axis] for axis in AXES], axis=-1),
        sigma=columns.get("sigma", np.full(rows, NOISE)),
        posture=np.asarray(columns.get("posture", np.arange(rows, dtype=float)), dtype=np.int64),
        frame=frame, source=source,
    )  # fmt: skip


BEYOND = np.radians(10.0)
"""[rad] outside of its limits that a joint may be said to stand (chosen: limits are coarse, servos get pushed)"""


def _units(name: str) -> tuple[str, float]:
    """Name of a column in CSV, and its unit."""
    if name == "posture":
        return name, 1.0
    return (f"{name}_mm", _MM) if name in (*AXES, "sigma") else (f"{name}_deg", _DEG)


def _as_csv(columns: dict[str, Array]) -> str:
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([_units(name)[0] for name in columns])
    scaled = [(values / _units(name)[1], 0 if name == "posture" else 4) for name, values in columns.items()]
    for row in range(len(columns["x"])):
        writer.writerow("" if np.isnan(values[row]) else f"{values[row]:.{digits}f}" for values, digits in scaled)
    return text.getvalue()


def _from_csv(path: Path, arm: Arm, frame: str, source: str) -> Measurements:
    joints = [f"position.{name}" for name in arm.joint_names]
    came = [f"approach.{name}" for name in arm.joint_names]
    meanings = dict.fromkeys(joints + came, ANGLES) | dict.fromkeys((*AXES, "sigma"), LENGTHS) | {"posture": COUNT}
    found = read_columns(path, meanings, joints)
    if not any(axis in found.places for axis in AXES):
        raise FileError(path, f"columns {found.sheet.shown}; missing: x_mm, y_mm, z_mm", "give at least one of them")
    if not len(found):
        raise FileError(path, "no measurements below the header", "add one line for each")
    blank = np.full(len(found), np.nan)
    columns = {name: found.numbers(name) if name in found.places else blank for name in (*AXES, *came)}
    columns |= {name: found.filled(name) for name in (*joints, "sigma", "posture") if name in found.places}
    seen = np.isfinite([columns[axis] for axis in AXES]).any(axis=0)  # as an empty answer at the prompt leaves one out
    lines = [found.line(row) for row in np.flatnonzero(seen).tolist()]
    if not lines:
        raise FileError(path, "no line has a coordinate of the tool", "measure at least one")
    try:
        measured = _assemble({name: values[seen] for name, values in columns.items()}, arm, frame, source)
    except InputError as error:
        raise FileError(path, str(error), _REMEDY) from error
    _require_units(path, arm, measured, lines)
    return measured


def _require_units(path: Path, arm: Arm, measured: Measurements, lines: list[int]) -> None:
    """Raise FileError where joint positions cannot be degrees of this arm, or points not millimetres."""
    beyond = (measured.position < arm.lower - BEYOND) | (measured.position > arm.upper + BEYOND)
    if beyond.any():
        row, joint = (int(index) for index in np.argwhere(beyond)[0])
        low, high = np.degrees(arm.lower[joint]), np.degrees(arm.upper[joint])
        angle = np.degrees(measured.position[row, joint])
        raise FileError(
            path, f"line {lines[row]}: {arm.joint_names[joint]} at {angle:.1f} deg, "
            f"expected {low:.0f} to {high:.0f}", "give what this arm's encoders said, in degrees",
        )  # fmt: skip
    if len(measured) > 1 and (np.abs(np.degrees(measured.position)) <= np.pi).all():
        raise FileError(path, "every joint position lies between -3.14 and 3.14", "give degrees, not radians")
    if measured.frame == "base" and in_metres(measured.point):
        raise FileError(path, "every coordinate of the tool is below 5", "give millimetres, not metres")
