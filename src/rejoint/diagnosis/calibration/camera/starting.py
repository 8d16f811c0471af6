"""First estimates of the lens and of the poses of camera and board."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from rejoint.arms import Arm, Array, tcp_pose
from rejoint.arms.camera.board import Board, BoardView
from rejoint.arms.camera.lens import Lens, place
from rejoint.arms.camera.rig import Rig, tool_of
from rejoint.arms.rotations import difference, inverse
from rejoint.system.errors import InputError
from rejoint.system.extras import require

WHOLE = 10
"""Views that determine more than the focal length; chosen"""
_LENSES = 4  # of finding the lens and leaving out views
_CROOKED, _LEAST_CROOKED = 3.0, 0.6  # times the median rms, and [px], from which a view shows no flat board (chosen)
_FOCAL = (0.3, 5.0)  # least and most of a focal length, by the width of the picture (webcams: 0.6 to 1.3)
_ROUNDS = 4  # of finding the poses and leaving out views that do not fit them
_FAR = 4.0  # times the median distance beyond which a view does not help the first estimate (chosen)
_LEVER = 0.1  # [m] that makes a length of a turn (chosen: the size of a board)
_STRETCH = 0.2
"""Relative error of lengths by another board; chosen: wear makes 0.05"""
_LEAST = 0.2
"""Factor of lengths below which motion and pictures do not match; chosen"""
_TURNED = np.radians(10.0)
"""[rad] least turn about two directions; chosen"""


def first_lens(size: tuple[int, int], board: Board, views: Sequence[BoardView]) -> Lens:
    """Lens of pictures of ``size`` [px] that fits flat boards best."""
    require("a camera", "camera")
    import cv2

    usual, few = Lens.usual(*size), len(views) < WHOLE
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_K3
    flags |= few * (cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2)
    used = np.ones(len(views), bool)
    for _ in range(_LENSES):
        shown = [view for view, good in zip(views, used, strict=True) if good]
        _, matrix, bent, _, _, _, _, rms = cv2.calibrateCameraExtended(
            [board.corners[view.number].astype(np.float32) for view in shown],
            [view.pixel.astype(np.float32) for view in shown],
            size,
            usual.matrix,
            np.zeros(5),
            flags=flags,
        )
        good = rms[:, 0] <= max(_CROOKED * float(np.median(rms)), _LEAST_CROOKED)
        if good.all():
            break
        used[np.flatnonzero(used)[~good]] = False
    if not _FOCAL[0] < matrix[0, 0] / usual.width < _FOCAL[1]:
        return usual
    return usual.with_numbers(np.array([matrix[0, 0], matrix[0, 2], matrix[1, 2], *np.ravel(bent)[:4]]))


def first_sights(lens: Lens, board: Board, views: Sequence[BoardView]) -> Array:
    """Poses (V, 4, 4) of the board in the camera frame."""
    return np.array([place(lens, board.corners[view.number], view.pixel).pose for view in views])


def first_rig(arm: Arm, lens: Lens, board: Board, carried: str, position: Array, sights: Array) -> Rig:
    """Find the poses of camera and board by the encoders' ``position`` (V, n) [rad].

    Linear least squares of A M = F B (Dornaika and Horaud 1998, section III), without outliers. InputError for too
    little rotation.
    """
    tool = tcp_pose(arm, position)
    _require_turns(tool)
    between = sights if carried == "board" else inverse(sights)
    used = np.ones(len(tool), bool)
    for _ in range(_ROUNDS):
        standing, mounted = _solve(tool[used], between[used])
        seen = tool_of(carried, standing, mounted, sights)
        shift, turn = np.split(difference(seen, tool), 2, axis=-1)
        off = np.linalg.norm(shift, axis=-1) + _LEVER * np.linalg.norm(turn, axis=-1)
        used = off <= _FAR * np.median(off)
    scale = _scale(tool[used], between[used], standing)
    if not _LEAST < scale < 1.0 / _LEAST:
        raise InputError(
            "the pictures do not fit the joint positions: check that each is paired with its own, in the right unit, "
            "and that the board is where it is said to be, on the tool or on the table"
        )
    if abs(scale - 1.0) > _STRETCH:
        raise InputError(
            f"by the joints' motion the squares of the board measure about {1e3 * board.square * scale:.0f} mm, by its "
            f"description {1e3 * board.square:g}; give the description of this print"
        )
    return Rig(lens=lens, board=board, carried=carried, standing=standing, mounted=mounted)


def _solve(tool: Array, between: Array) -> tuple[Array, Array]:
    """Poses A and B with A M = F B for poses M ``between`` and F of the ``tool`` (V, 4, 4)."""
    one = np.eye(3)
    rows = [
        np.hstack([np.kron(m[:3, :3].T, one), -np.kron(one, f[:3, :3])]) for m, f in zip(between, tool, strict=True)
    ]
    both = np.linalg.svd(np.vstack(rows), full_matrices=False)[2][-1]
    a, b = both[:9].reshape(3, 3).T, both[9:].reshape(3, 3).T
    sign = np.sign(np.linalg.det(a))
    standing, mounted = np.eye(4), np.eye(4)
    standing[:3, :3], mounted[:3, :3] = (
        Rotation.from_matrix(sign * one / np.cbrt(abs(np.linalg.det(one)))).as_matrix() for one in (a, b)
    )
    left = np.concatenate([np.broadcast_to(one, (len(tool), 3, 3)), -tool[:, :3, :3]], axis=2).reshape(-1, 6)
    right = (tool[:, :3, 3] - between[:, :3, 3] @ standing[:3, :3].T).ravel()
    shift = np.linalg.lstsq(left, right, rcond=None)[0]
    standing[:3, 3], mounted[:3, 3] = shift[:3], shift[3:]
    return standing, mounted


def _scale(tool: Array, between: Array, standing: Array) -> float:
    one = np.broadcast_to(np.eye(3), (len(tool), 3, 3))
    lengths = (between[:, :3, 3] @ standing[:3, :3].T)[..., None]
    left = np.concatenate([one, -tool[:, :3, :3], lengths], axis=2).reshape(-1, 7)
    return float(np.linalg.lstsq(left, tool[:, :3, 3].ravel(), rcond=None)[0][6])


def _require_turns(tool: Array) -> None:
    axes = tool[:, :3, :3] - tool[:, :3, :3].mean(axis=0)
    spread = np.linalg.svd(axes.reshape(len(tool), -1), compute_uv=False) / np.sqrt(len(tool))
    if len(tool) < 3 or spread[1] < _TURNED:
        raise InputError(
            "the tool was turned too little between the views to tell where camera and board are; "
            "turn it by 20 degrees and more about at least two directions"
        )
