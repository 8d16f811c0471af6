"""``calibration.toml``: a calibration as a file that people can read and programs can trust.

Values are in SI units. A digest in the first line covers the whole text, so that a changed or damaged file is noticed;
digests of the arm's geometry and masses tell another arm.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from tomlkit.items import Array as TomlArray
from tomlkit.items import Table as TomlTable

from rejoint.arms import Arm, Array, Displacement
from rejoint.diagnosis.calibration.calibration import Calibration, check_arm, geometry_of
from rejoint.diagnosis.calibration.parameters import DisplacementLayout
from rejoint.system.errors import InputError
from rejoint.system.sealed import read_sealed, write_sealed

FORMAT = 1
"""Version of the layout; a reader refuses others"""

_UNITS = {
    "offset": "rad, added to what the encoders say",
    "compliance": "rad/(N m), of gear and link",
    "play": "rad, whole width",
    "carry": "1, of half the play, by which a joint that floats runs ahead of its last motion",
    "mass": "1, by the description of the arm",
}


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration as TOML, whole or not at all."""
    write_sealed(path, _document(calibration))


def read_calibration(path: Path, arm: Arm) -> Calibration:
    """Read the calibration of ``arm``; FileError if it is missing or damaged, ContractError if it is of another arm."""

    def build(data: dict[str, Any]) -> Calibration:
        check_arm(str(data["arm"]), {str(k): str(v) for k, v in data["geometry"].items()}, arm)
        return _calibration(data, arm)

    return read_sealed(path, build, name="calibration", version=FORMAT, again="calibrate the arm")


def _document(calibration: Calibration) -> tomlkit.TOMLDocument:
    found, document = calibration.displacement, tomlkit.document()
    document.add(tomlkit.comment("Where the tool of one robot arm is behind its encoders. SI units."))
    document.add("format", tomlkit.item(FORMAT))
    document.add("arm", tomlkit.item(calibration.arm.name))
    document.add("geometry", _table(dict(geometry_of(calibration.arm)), "digests of what the fit computed with"))
    document.add("date", tomlkit.item(calibration.date))
    document.add("source", tomlkit.item(calibration.source))
    document.add("points", tomlkit.item(calibration.points))
    document.add("suspects", tomlkit.item(list(calibration.suspects)).comment("rows that do not fit to the others"))
    document.add("before", _length(calibration.before, "mean true error at measured points, uncorrected"))
    document.add("after", _length(calibration.after, "the same, each point predicted from the others"))
    document.add("used", tomlkit.item(calibration.used).comment("false: nothing is corrected"))
    document.add("floor", _length(calibration.floor, "standard deviation of a coordinate that nothing here explains"))
    rows = _rows(calibration.left_out).comment("m, of each measured point: as before and after")
    document.add("left_out", rows)
    document.add("displacement", _displacement_table(found))
    frame = tomlkit.table()
    frame.comment("of whatever measured: pose in the base")
    frame.add("name", calibration.frame_name)
    frame.add("pose", _rows(calibration.frame[:3]))
    document.add("frame", frame)
    covariance = tomlkit.table()
    covariance.comment("of the parameters of the displacement: mass less one, gravity as tilt in rad")
    covariance.add("order", list(calibration.layout.names()))
    covariance.add("lower_triangle", _rows([row[: i + 1] for i, row in enumerate(calibration.covariance)]))
    document.add("covariance", covariance)
    return document


def _displacement_table(found: Displacement) -> TomlTable:
    table = tomlkit.table()
    table.comment("play and offset of one joint cannot be told apart: together they say where the tool is")
    for name, unit in _UNITS.items():
        values = np.broadcast_to(getattr(found, name), found.offset.shape)
        table.add(name, tomlkit.item(values.tolist()).comment(unit))
    table.add("gravity", tomlkit.item(found.gravity.tolist()).comment("m/s^2, in the frame of the base"))
    table.add("twist", _rows(found.twist))
    return table


def _table(values: dict[str, Any], comment: str) -> TomlTable:
    table = tomlkit.table()
    table.comment(comment)
    for key, value in values.items():
        table.add(key, value)
    return table


def _length(value: float, meaning: str) -> Any:  # noqa: ANN401 - an item of the library
    return tomlkit.item(float(value)).comment(f"m = {1e3 * value:.2f} mm, {meaning}")


def _rows(rows: Any) -> TomlArray:  # noqa: ANN401 - arrays, or lists of them
    array = tomlkit.array()
    for row in rows:
        array.append([float(value) for value in row])
    return array.multiline(True)


def _calibration(data: dict[str, Any], arm: Arm) -> Calibration:
    values, layout = data["displacement"], DisplacementLayout(joints=arm.joints)
    displacement = Displacement(
        **{name: _numbers(values[name], (arm.joints,)) for name in _UNITS},
        gravity=_numbers(values["gravity"], (3,)), twist=_numbers(values["twist"], (arm.joints + 1, 6)),
    )  # fmt: skip
    rows = data["covariance"]["lower_triangle"]
    if len(rows) != layout.body:
        raise InputError(f"covariance of {len(rows)} parameters, expected {layout.body}")
    covariance = np.zeros((layout.body, layout.body))
    for i, row in enumerate(rows):
        covariance[i, : i + 1] = covariance[: i + 1, i] = _numbers(row, (i + 1,))
    np.linalg.cholesky(covariance)
    frame = np.eye(4)
    frame[:3] = _numbers(data["frame"]["pose"], (3, 4))
    return Calibration(
        arm=arm, displacement=displacement, covariance=covariance, frame=frame, frame_name=str(data["frame"]["name"]),
        source=str(data["source"]), date=str(data["date"]), points=int(data["points"]), used=bool(data["used"]),
        before=float(data["before"]), after=float(data["after"]), floor=float(data["floor"]),
        suspects=tuple(int(row) for row in data["suspects"]), left_out=_left_out(data.get("left_out", [])),
    )  # fmt: skip


def _left_out(rows: list[list[float]]) -> Array:
    return _numbers(rows, (len(rows), 2)) if rows else np.zeros((0, 2))


def _numbers(value: object, shape: tuple[int, ...]) -> Array:
    array = np.array(value, dtype=float)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"expected finite numbers of shape {shape}, found {array.shape}")
    return array
