"""``camera.toml``: how camera, board and arm stood to each other when they were found, for pictures to come.

SI units and px. A digest in the first line covers the whole text, so that a changed or damaged file is noticed. It
holds as long as neither camera nor board is shifted, and the lens not focused anew.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tomlkit

from rejoint.arms.arm import Arm, Array
from rejoint.arms.camera.board import Board
from rejoint.arms.camera.lens import TERMS, Lens
from rejoint.arms.camera.rig import Rig
from rejoint.system.errors import ContractError, InputError
from rejoint.system.sealed import read_sealed, write_sealed

FORMAT = 1
"""Version of the layout; a reader refuses others"""


def write_rig(path: Path, arm: Arm, rig: Rig, sigma: Array, date: str = "") -> None:
    """Write the ``rig`` of ``arm``.

    ``sigma`` (19,) are standard deviations of the lens's `TERMS`, and of shift [m] and turn [rad] of what stands and of
    what is mounted.
    """
    document = tomlkit.document()
    document.add(tomlkit.comment("A camera, a board and one robot arm. SI units and px; sigma: standard deviations."))
    document.add("format", tomlkit.item(FORMAT))
    document.add("arm", tomlkit.item(arm.name))
    document.add("date", tomlkit.item(date))
    document.add("carried", tomlkit.item(rig.carried).comment("what the tool carries: board or camera"))
    document.add("board", tomlkit.item(asdict(rig.board)))
    n = len(TERMS)
    lens = tomlkit.item(asdict(rig.lens))
    lens.add("sigma", dict(zip(TERMS, map(float, sigma[:n]), strict=True)))
    document.add("lens", lens)
    for name, pose, spread in (
        ("standing", rig.standing, sigma[n : n + 6]), ("mounted", rig.mounted, sigma[n + 6 :])
    ):  # fmt: skip
        table = tomlkit.table()
        table.comment("pose in the base of the arm" if name == "standing" else "pose in the frame of the tool")
        rows = tomlkit.array()
        for row in pose[:3].tolist():
            rows.append(row)
        table.add("pose", rows.multiline(True))
        table.add("sigma_shift", spread[:3].tolist())
        table.add("sigma_turn", spread[3:].tolist())
        document.add(name, table)
    write_sealed(path, document)


def read_rig(path: Path, arm: Arm) -> Rig:
    """Read the rig of ``arm``; FileError if it is missing or damaged, ContractError if it is of another arm."""

    def build(data: dict[str, Any]) -> Rig:
        if data["arm"] != arm.name:
            raise ContractError(f"camera of arm {data['arm']!r}, expected one of {arm.name!r}; calibrate this arm")
        lens = {name: value for name, value in data["lens"].items() if name != "sigma"}
        return Rig(
            lens=msgspec.convert(lens, Lens), board=msgspec.convert(data["board"], Board),
            carried=str(data["carried"]), standing=_pose(data["standing"]), mounted=_pose(data["mounted"]),
        )  # fmt: skip

    return read_sealed(path, build, name="rig of a camera", version=FORMAT, again="calibrate with the camera")


def _pose(table: dict[str, Any]) -> Array:
    rows = np.array(table["pose"], dtype=float)
    if rows.shape != (3, 4) or not np.isfinite(rows).all():
        raise InputError(f"a pose of finite numbers of shape (3, 4) was expected, found {rows.shape}")
    pose = np.eye(4)
    pose[:3] = rows
    return pose
