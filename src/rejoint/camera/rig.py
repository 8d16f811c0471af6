"""Poses of camera, board and arm, and ``camera.toml`` (SI units, px)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tomlkit

from rejoint.arms import Arm, Array
from rejoint.arms.rotations import difference, inverse, moved
from rejoint.camera.board import Board
from rejoint.camera.lens import TERMS, Lens
from rejoint.diagnosis.calibration.calibration import finite
from rejoint.system.errors import ContractError
from rejoint.system.tomltable import read_sealed, write_sealed

_STEP = 1e-6  # [m] and [rad] of numerical derivatives


@dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """A camera, a board and an arm."""

    lens: Lens
    board: Board
    carried: str
    """by the tool: ``board`` or ``camera``"""
    standing: Array
    """(4, 4) of the other one, base frame"""
    mounted: Array
    """(4, 4) of the carried one, TCP frame"""

    def tool(self, board: Array) -> Array:
        """Tool poses (..., 4, 4) in the base, for ``board`` (..., 4, 4) in the camera."""
        between = board if self.carried == "board" else inverse(board)
        return np.asarray(self.standing @ between @ inverse(self.mounted))

    def spread(self, board: Array, covariance: Array) -> Array:
        """Covariance (V, 6, 6) of the tool's pose, base axes, from that of ``board`` (V, 4, 4), camera axes."""
        base = self.tool(board)
        rows = [difference(self.tool(moved(board, _STEP * row)), base) / _STEP for row in np.eye(6)]
        slope = np.stack(rows, axis=-1)
        return np.asarray(slope @ covariance @ np.swapaxes(slope, -1, -2))

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


def point_sigma(spread: Array) -> Array:
    """Sigma (...) [m] of a coordinate, for covariances (..., 6, 6) of poses."""
    return np.asarray(np.sqrt(np.trace(spread[..., :3, :3], axis1=-2, axis2=-1) / 3.0))


FORMAT = 1
"""Version; others are refused"""


def write_rig(path: Path, arm: Arm, rig: Rig, sigma: Array, date: str = "") -> None:
    """Write a rig; ``sigma`` (19,): deviations of `TERMS`, `Rig.standing` and `Rig.mounted`."""
    lens, standing, mounted = np.split(sigma, [len(TERMS), len(TERMS) + 6])
    told = {
        "format": FORMAT,
        "arm": arm.name,
        "date": date,
        "carried": rig.carried,
        "board": asdict(rig.board),
        "lens": asdict(rig.lens) | {"sigma": dict(zip(TERMS, map(float, lens), strict=True))},
    }
    for name, own in (("standing", standing), ("mounted", mounted)):
        pose = getattr(rig, name)[:3].tolist()
        told[name] = {"pose": pose, "sigma_shift": own[:3].tolist(), "sigma_turn": own[3:].tolist()}
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
        return Rig(
            lens=msgspec.convert(data["lens"], Lens),
            board=msgspec.convert(data["board"], Board),
            carried=str(data["carried"]),
            standing=_pose(data["standing"]),
            mounted=_pose(data["mounted"]),
        )

    return read_sealed(path, build, name="rig of a camera", version=FORMAT, again="calibrate with the camera")


def _pose(table: dict[str, Any]) -> Array:
    return np.vstack([finite(table["pose"], (3, 4)), np.eye(4)[3]])
