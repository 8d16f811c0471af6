"""``twin.toml``: a twin as a file.

One digest covers the parameters, another the whole text.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tomlkit

from rejoint.arms import Arm, Array
from rejoint.system.errors import InputError
from rejoint.system.tomltable import read_sealed, write_sealed
from rejoint.twin.parameters import PARAMETERS, STICTION, Layout, TwinParameters
from rejoint.twin.twin import HeldOut, Twin

FORMAT = 1

ERRORS = ("no_twin", "healthy_twin", "twin")
"""Rms errors on held-out motion"""


def write_twin(path: Path, twin: Twin) -> None:
    """Write a twin, atomically."""
    write_sealed(path, _document(twin))


def read_twin(path: Path, arm: Arm | None = None) -> Twin:
    """Read a twin; FileError if missing or damaged, ContractError for another arm."""

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
    errors = {name: error for name in ERRORS if (error := getattr(twin.held_out, name)) is not None}
    told: dict[str, Any] = {
        "format": FORMAT,
        "arm": twin.arm,
        "joints": twin.joint_names,
        "digest": twin.digest(),
        "fit_seconds": twin.fit_seconds,
        "notes": twin.notes,
        "stiction": twin.stiction,
        **({"acceleration": twin.acceleration} if twin.acceleration < np.inf else {}),
        "held_out": {"seconds": twin.held_out.seconds, **errors},
    }
    for name, value in msgspec.to_builtins(told, enc_hook=np.ndarray.tolist).items():
        document.add(name, tomlkit.item(value))
    for name, error in errors.items():
        document["held_out"][name].comment(f"{np.degrees(error.joint):.3f} deg, {1e3 * error.tcp:.2f} mm")
    for p in PARAMETERS:
        here = Layout(len(twin.joint_names)).at(p.name)
        values = {
            "value": getattr(twin.parameters, p.name),
            "low95": getattr(low, p.name),
            "high95": getattr(high, p.name),
            "identified": twin.identified[here],
            "lower": twin.lower[here],
            "upper": twin.upper[here],
            "narrowing": twin.narrowing[here],
        }
        table = tomlkit.item({name: np.atleast_1d(value).tolist() for name, value in values.items()})
        table.comment(f"{p.unit}: {p.meaning}; lower and upper are {'logarithms' if p.log else 'as they are'}")
        document.add(p.name, table)
    rows = tomlkit.array()
    for i, row in enumerate(twin.covariance):
        rows.append(row[: i + 1].tolist())
    document.add("covariance", tomlkit.item({"order": list(twin.names), "lower_triangle": rows.multiline(True)}))
    return document


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

    return Twin(
        arm=str(data["arm"]),
        joint_names=names,
        parameters=parameters,
        covariance=covariance,
        lower=stacked("lower"),
        upper=stacked("upper"),
        narrowing=stacked("narrowing"),
        identified=stacked("identified").astype(bool),
        held_out=msgspec.convert(data["held_out"], HeldOut),
        fit_seconds=float(data["fit_seconds"]),
        notes=tuple(str(note) for note in data["notes"]),
        stiction=float(data.get("stiction", STICTION)),
        acceleration=float(data.get("acceleration", np.inf)),
    )
