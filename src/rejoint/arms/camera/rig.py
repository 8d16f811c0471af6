"""Poses of camera, board and arm, and ``camera.toml`` (SI units, px)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tomlkit

from rejoint.arms.arm import Arm, Array
from rejoint.arms.camera.board import Board
from rejoint.arms.camera.lens import TERMS, Lens
from rejoint.arms.rotations import inverse
from rejoint.system.errors import ContractError, InputError
from rejoint.system.tomltable import read_sealed, write_sealed

MOUNTINGS = ("board", "camera")


@dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """A camera, a board and an arm."""

    lens: Lens
    board: Board
    carried: str
    """one of `MOUNTINGS`"""
    standing: Array
    """(4, 4) of the other one, base frame"""
    mounted: Array
    """(4, 4) of the carried one, TCP frame"""

    def __post_init__(self) -> None:
        if self.carried not in MOUNTINGS:
            raise InputError(f"the tool carries {self.carried!r}, expected one of: {', '.join(MOUNTINGS)}")
        for name in ("standing", "mounted"):
            value = np.array(getattr(self, name), dtype=float)
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    def tool(self, board: Array) -> Array:
        """Tool poses (..., 4, 4) in the base, for ``board`` (..., 4, 4) in the camera."""
        return tool_of(self.carried, self.standing, self.mounted, board)

    def sight(self, tool: Array) -> Array:
        """Board poses (..., 4, 4) in the camera, for ``tool`` (..., 4, 4)."""
        between = inverse(self.standing) @ tool @ self.mounted
        return between if self.carried == "board" else inverse(between)

    def shows(self, tool: Array, margin: float = 20.0, steepest: float = np.radians(55.0)) -> Array:
        """Whether the whole board is visible at ``tool`` (..., 4, 4).

        ``margin`` [px] to the edge; ``steepest`` [rad] between line of sight and normal.
        """
        pose = self.sight(tool)
        outline = np.einsum("...ij,cj->...ci", pose[..., :3, :3], self.board.outline) + pose[..., None, :3, 3]
        middle = outline.mean(axis=-2)
        facing = (pose[..., :3, 2] * middle).sum(axis=-1) / np.linalg.norm(middle, axis=-1)
        ahead = (outline[..., 2] > 0.05).all(axis=-1)
        pixel = self.lens.project(np.where(ahead[..., None, None], outline, [0.0, 0.0, 1.0]))
        return np.asarray(ahead & (facing > np.cos(steepest)) & self.lens.shows(pixel, margin).all(axis=-1))


def tool_of(carried: str, standing: Array, mounted: Array, board: Array) -> Array:
    """Tool poses (..., 4, 4), see `Rig.tool`."""
    between = board if carried == "board" else inverse(board)
    return np.asarray(standing @ between @ inverse(mounted))


FORMAT = 1
"""Version; others are refused"""


def write_rig(path: Path, arm: Arm, rig: Rig, sigma: Array, date: str = "") -> None:
    """Write a rig; ``sigma`` (19,): deviations of `TERMS`, `Rig.standing` and `Rig.mounted`."""
    n = len(TERMS)
    spread = dict(zip(("standing", "mounted"), (sigma[n : n + 6], sigma[n + 6 :]), strict=True))
    told = {
        "format": FORMAT,
        "arm": arm.name,
        "date": date,
        "carried": rig.carried,
        "board": asdict(rig.board),
        "lens": asdict(rig.lens) | {"sigma": dict(zip(TERMS, map(float, sigma[:n]), strict=True))},
        **{
            name: {
                "pose": getattr(rig, name)[:3].tolist(),
                "sigma_shift": own[:3].tolist(),
                "sigma_turn": own[3:].tolist(),
            }
            for name, own in spread.items()
        },
    }
    document = tomlkit.document()
    document.add(tomlkit.comment("A camera, a board and one robot arm. SI units and px; sigma: standard deviations."))
    for name, value in told.items():
        document.add(name, tomlkit.item(value))
    write_sealed(path, document)


def read_rig(path: Path, arm: Arm) -> Rig:
    """Read a rig; FileError, ContractError for another arm."""

    def build(data: dict[str, Any]) -> Rig:
        if data["arm"] != arm.name:
            raise ContractError(f"camera of arm {data['arm']!r}, expected one of {arm.name!r}; calibrate this arm")
        lens = {name: value for name, value in data["lens"].items() if name != "sigma"}
        return Rig(
            lens=msgspec.convert(lens, Lens),
            board=msgspec.convert(data["board"], Board),
            carried=str(data["carried"]),
            standing=_pose(data["standing"]),
            mounted=_pose(data["mounted"]),
        )

    return read_sealed(path, build, name="rig of a camera", version=FORMAT, again="calibrate with the camera")


def _pose(table: dict[str, Any]) -> Array:
    rows = np.array(table["pose"], dtype=float)
    if rows.shape != (3, 4) or not np.isfinite(rows).all():
        raise InputError(f"a pose of finite numbers of shape (3, 4) was expected, found {rows.shape}")
    pose = np.eye(4)
    pose[:3] = rows
    return pose
