"""``twin.toml``: a twin as a file that people can read and programs can trust.

Values are in SI units. The intervals are written for the reader and computed again when the file is
read. One digest covers all that decides the twins drawn from this one; another, in the first line, covers the whole
text, so that a changed or damaged file is noticed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from tomlkit.items import Array as TomlArray
from tomlkit.items import Table as TomlTable

from rejoint.arms import Arm, Array
from rejoint.system.errors import InputError
from rejoint.system.sealed import read_sealed, write_sealed
from rejoint.twin.parameters import PARAMETERS, STICTION, Layout, TwinParameters
from rejoint.twin.prediction import PredictionError
from rejoint.twin.table import TablePlane
from rejoint.twin.twin import HeldOut, Twin

FORMAT = 1
"""Version of the layout; a reader refuses others"""


def write_twin(path: Path, twin: Twin) -> None:
    """Write a twin as TOML, whole or not at all."""
    write_sealed(path, _document(twin))


def read_twin(path: Path, arm: Arm | None = None) -> Twin:
    """Read a twin; FileError if the file is missing or damaged, ContractError if it is of another arm."""

    def build(data: dict[str, Any]) -> Twin:
        twin = _twin(data)
        if data["digest"] != twin.digest():
            raise InputError(f"it holds digest {data['digest']!r} but its values give {twin.digest()!r}")
        return twin

    twin = read_sealed(path, build, name="twin", version=FORMAT, again="identify the arm")
    if arm is not None:
        twin.require(arm)
    return twin


def _document(twin: Twin) -> tomlkit.TOMLDocument:
    low, high = twin.interval
    document = tomlkit.document()
    document.add(tomlkit.comment("Digital twin of one robot arm, fitted to its own motion. SI units."))
    document.add("format", tomlkit.item(FORMAT))
    document.add("arm", tomlkit.item(twin.arm))
    document.add("joints", _row(twin.joint_names))
    document.add("digest", tomlkit.item(twin.digest()).comment("of parameters, bounds and covariance"))
    document.add("fit_seconds", tomlkit.item(twin.fit_seconds).comment("s, motion that the fit has seen"))
    document.add("notes", _row(twin.notes))
    document.add("stiction", tomlkit.item(twin.stiction).comment("friction at rest over friction in motion"))
    if twin.acceleration < np.inf:
        limit = tomlkit.item(twin.acceleration).comment("rad/s^2, of the reference while commands keep changing")
        document.add("acceleration", limit)
    document.add("held_out", _held_out_table(twin.held_out))
    for p in PARAMETERS:
        here = Layout(len(twin.joint_names)).at(p.name)
        table = tomlkit.table()
        table.comment(f"{p.unit}: {p.meaning}")
        table.add("value", _numbers(getattr(twin.parameters, p.name)))
        table.add("low95", _numbers(getattr(low, p.name), digits=4).comment("95 % interval, for the reader"))
        table.add("high95", _numbers(getattr(high, p.name), digits=4))
        table.add("identified", _row(twin.identified[here].tolist()).comment("false: keeps its prior range"))
        scale = "logarithms of the physical bounds" if p.log else "physical bounds"
        table.add("lower", _numbers(twin.lower[here]).comment(scale))
        table.add("upper", _numbers(twin.upper[here]))
        table.add("narrowing", _numbers(twin.narrowing[here]).comment("standard deviation over that of the prior"))
        document.add(p.name, table)
    document.add("covariance", _covariance_table(twin))
    if twin.table is not None:
        document.add("table", _table_table(twin.table))
    return document


def _held_out_table(held_out: HeldOut) -> TomlTable:
    table = tomlkit.table()
    table.comment("errors on motion that the fit has not seen, root mean square")
    table.add("seconds", held_out.seconds)
    for name in ("no_twin", "healthy_twin", "twin"):
        error: PredictionError = getattr(held_out, name)
        entry = tomlkit.table()
        entry.add("joint", tomlkit.item(error.joint).comment(f"rad = {np.degrees(error.joint):.3f} deg"))
        entry.add("joints", _numbers(error.joints).comment("rad"))
        entry.add("tcp", tomlkit.item(error.tcp).comment(f"m = {error.tcp * 1e3:.2f} mm"))
        table.add(name, entry)
    return table


def _table_table(table: TablePlane) -> TomlTable:
    found = tomlkit.table()
    found.comment("what the tip leaned on in the logs: m in the base frame, N/m; no part of the arm")
    for field in fields(table):
        found.add(field.name, getattr(table, field.name))
    return found


def _covariance_table(twin: Twin) -> TomlTable:
    table = tomlkit.table()
    table.comment("of the logarithms of the positive parameters, and of offset and delay as they are")
    table.add("order", _row(twin.names))
    rows = tomlkit.array()
    for i, row in enumerate(twin.covariance):
        rows.append(_numbers(row[: i + 1]))
    table.add("lower_triangle", rows.multiline(True))
    return table


def _row(values: Sequence[Any]) -> TomlArray:
    array = tomlkit.array()
    array.extend(list(values))
    return array


def _numbers(values: Array, digits: int | None = None) -> TomlArray:
    flat = np.atleast_1d(values).tolist()
    return _row(flat if digits is None else [float(f"{value:.{digits}g}") for value in flat])


def _twin(data: dict[str, Any]) -> Twin:
    names = tuple(str(name) for name in data["joints"])
    values = {p.name: np.array(data[p.name]["value"], dtype=float) for p in PARAMETERS}
    parameters = TwinParameters(**{p.name: values[p.name] if p.per_joint else values[p.name][0] for p in PARAMETERS})
    k = sum(len(values[p.name]) for p in PARAMETERS)
    covariance = np.zeros((k, k))
    for i, row in enumerate(data["covariance"]["lower_triangle"]):
        covariance[i, : i + 1] = covariance[: i + 1, i] = row

    def stacked(key: str) -> Array:
        return np.concatenate([np.array(data[p.name][key], dtype=float) for p in PARAMETERS])

    held_out = data["held_out"]
    errors = {
        name: PredictionError(
            joints=np.array(held_out[name]["joints"], dtype=float),
            joint=float(held_out[name]["joint"]),
            tcp=float(held_out[name]["tcp"]),
        )
        for name in ("no_twin", "healthy_twin", "twin")
    }
    return Twin(
        arm=str(data["arm"]),
        joint_names=names,
        parameters=parameters,
        covariance=covariance,
        lower=stacked("lower"),
        upper=stacked("upper"),
        narrowing=stacked("narrowing"),
        identified=stacked("identified").astype(bool),
        held_out=HeldOut(seconds=float(held_out["seconds"]), **errors),
        fit_seconds=float(data["fit_seconds"]),
        notes=tuple(str(note) for note in data["notes"]),
        stiction=float(data.get("stiction", STICTION)),
        acceleration=float(data.get("acceleration", np.inf)),
        table=TablePlane(**{key: float(value) for key, value in data["table"].items()}) if "table" in data else None,
    )
