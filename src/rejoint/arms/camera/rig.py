"""How camera, board and arm stand to each other, and where that puts the tool in a picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Array
from rejoint.arms.camera.board import Board
from rejoint.arms.camera.lens import Lens
from rejoint.arms.camera.poses import inverse
from rejoint.system.errors import InputError

MOUNTINGS = ("board", "camera")
"""What the tool carries: the board, seen by a camera beside the arm, or the camera, which sees a board on the table"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """A camera, a board and an arm, one of the first two on the tool of the third."""

    lens: Lens
    board: Board
    carried: str
    """one of `MOUNTINGS`: what the tool carries"""
    standing: Array
    """(4, 4) in the base of the arm: of the camera, or of the board where the tool carries the camera"""
    mounted: Array
    """(4, 4) in the frame of the tool, whose origin is the TCP: of what it carries"""

    def __post_init__(self) -> None:
        if self.carried not in MOUNTINGS:
            raise InputError(f"the tool carries {self.carried!r}, expected one of: {', '.join(MOUNTINGS)}")
        for name in ("standing", "mounted"):
            value = np.array(getattr(self, name), dtype=float)
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    def tool(self, board: Array) -> Array:
        """Poses (..., 4, 4) of the tool in the base where the camera sees the board at ``board`` (..., 4, 4)."""
        return tool_of(self.carried, self.standing, self.mounted, board)

    def sight(self, tool: Array) -> Array:
        """Poses (..., 4, 4) of the board in the frame of the camera while the tool is at ``tool`` (..., 4, 4)."""
        between = inverse(self.standing) @ tool @ self.mounted
        return between if self.carried == "board" else inverse(between)

    def shows(self, tool: Array, margin: float = 20.0, steepest: float = np.radians(55.0)) -> Array:
        """Tell for poses (..., 4, 4) of the tool whether all of the board is in the picture, and not too oblique.

        ``margin`` [px] is left to the rim; ``steepest`` [rad] is the angle between the line of sight and the board's
        normal beyond which its markers are no longer read.
        """
        pose = self.sight(tool)
        outline = np.einsum("...ij,cj->...ci", pose[..., :3, :3], self.board.outline) + pose[..., None, :3, 3]
        middle = outline.mean(axis=-2)
        facing = (pose[..., :3, 2] * middle).sum(axis=-1) / np.linalg.norm(middle, axis=-1)
        ahead = (outline[..., 2] > 0.05).all(axis=-1)
        pixel = self.lens.project(np.where(ahead[..., None, None], outline, [0.0, 0.0, 1.0]))
        return np.asarray(ahead & (facing > np.cos(steepest)) & self.lens.shows(pixel, margin).all(axis=-1))


def tool_of(carried: str, standing: Array, mounted: Array, board: Array) -> Array:
    """Poses (..., 4, 4) of the tool in the base, see `Rig.tool`."""
    between = board if carried == "board" else inverse(board)
    return np.asarray(standing @ between @ inverse(mounted))
