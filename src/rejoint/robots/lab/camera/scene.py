"""A camera before an emulated arm: pictures of the board where the arm's tool really is.

Rendered pictures go the whole way through the detection; corners alone, with the noise that rendered pictures have,
are a hundred times faster and enough to judge the fit.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rejoint.arms import Arm, Array, tcp_pose
from rejoint.arms.camera.board import ON_TOOL, Board, BoardView
from rejoint.arms.camera.lens import Lens
from rejoint.arms.camera.poses import inverse
from rejoint.arms.camera.rig import Rig
from rejoint.robots.lab.camera.rendering import Looks, Picture, render

LENS = Lens(width=1920, height=1080, f=1400.0, cx=950.0, cy=545.0, k1=-0.08, k2=0.05, p1=8e-4, p2=-5e-4)
"""A web camera of 69 degrees with some distortion (chosen)"""
AWAY = 0.6
"""[m] of the camera from the region of targets (issue: a table beside the arm)"""
_AZIMUTH = np.radians(-60.0)
"""[rad] at which it stands beside the arm, about the vertical, from the front (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """An emulated camera and board, and the arm that carries one of them."""

    arm: Arm
    rig: Rig
    looks: Looks = field(default_factory=Looks)

    def picture(self, links: Array, seed: int | tuple[int, ...], looks: Looks | None = None) -> Picture:
        """Render what the camera sees while the links are at ``links`` (n,) [rad], wherever the encoders are."""
        return self.shows(tcp_pose(self.arm, links), seed, looks)

    def shows(self, tool: Array, seed: int | tuple[int, ...], looks: Looks | None = None) -> Picture:
        """Render what the camera sees while the tool is at ``tool`` (4, 4) in the base."""
        return render(self.rig.board, self.rig.lens, self.rig.sight(tool), seed, looks or self.looks)

    def view(self, name: str, links: Array, rng: np.random.Generator, noise: float = 0.15) -> BoardView:
        """Return the corners that the camera sees, with ``noise`` [px], without a picture."""
        pose, corners = self.rig.sight(tcp_pose(self.arm, links)), self.rig.board.corners
        pixel = self.rig.lens.project(corners @ pose[:3, :3].T + pose[:3, 3])
        return BoardView(
            name=name, number=np.arange(len(corners)), pixel=pixel + noise * rng.standard_normal(pixel.shape)
        )


def beside(arm: Arm, *, board: Board = ON_TOOL) -> Scene:
    """Put a camera beside an arm, and a board upright on its tool that faces the camera where the arm rests.

    The camera looks at the middle of the region of targets, from the arm's right and somewhat above. The board hangs
    beside the tool, its middle 30 mm before the TCP towards the camera.
    """
    middle = 0.5 * (arm.targets.lower + arm.targets.upper)
    level = np.array([np.cos(_AZIMUTH), np.sin(_AZIMUTH), 0.0])
    standing = looking(middle + AWAY * (0.95 * level + [0.0, 0.0, 0.31]), middle)
    rest = tcp_pose(arm, arm.rest)
    towards = standing[:3, 3] - rest[:3, 3]
    upright = looking(rest[:3, 3] + 0.03 * towards / np.linalg.norm(towards), rest[:3, 3])
    origin = upright[:3, :3] @ np.array([*(-0.5 * board.size), 0.0])
    hung = upright.copy()
    hung[:3, 3] += origin
    return Scene(
        arm=arm, rig=Rig(lens=LENS, board=board, carried="board", standing=standing, mounted=inverse(rest) @ hung)
    )


def on_tool(arm: Arm, *, board: Board) -> Scene:
    """Put a camera on an arm's tool that looks along with it, and a board flat on the table below the targets."""
    middle = 0.5 * (arm.targets.lower + arm.targets.upper)
    lying = np.eye(4)
    lying[:3, :3] = np.diag([1.0, -1.0, -1.0])  # seen from above
    lying[:3, 3] = [middle[0], middle[1], 0.0]
    lying[:3, 3] -= lying[:3, :3] @ np.array([*(0.5 * board.size), 0.0])
    rest = tcp_pose(arm, arm.rest)
    camera = looking(rest[:3, 3] + [0.0, 0.0, 0.05], np.array([middle[0], middle[1], 0.0]))
    return Scene(arm=arm, rig=Rig(lens=LENS, board=board, carried="camera", standing=lying,
                                  mounted=inverse(rest) @ camera))  # fmt: skip


def looking(place: Array, at: Array) -> Array:
    """Pose (4, 4) of a camera at ``place`` (3,) that looks at a point (3,), its picture upright."""
    forwards = (at - place) / np.linalg.norm(at - place)
    right = np.cross(forwards, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-6 else np.array([1.0, 0.0, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(forwards, right), forwards])
    pose[:3, 3] = place
    return pose
