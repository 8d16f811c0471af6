"""Whether the board is flat: of a bent one, a wrong lens explains most, and where the tool is comes out wrong.

A bow of 2.5 mm in a sheet of 140 mm makes the focal lengths wrong by 6 and 8 % while all corners fit
(`tests/diagnosis/camera/test_film.py`); nearer cameras suffer more. So the bow is estimated from what is left of the
corners, along with the lens and the pose of the board in each view, of which nothing is believed here.
"""

from __future__ import annotations

import numpy as np

from rejoint.arms import Array
from rejoint.arms.camera.board import Board
from rejoint.arms.camera.lens import TERMS, projected
from rejoint.arms.camera.poses import skew
from rejoint.diagnosis.calibration.camera.bundle import Bundle
from rejoint.system.errors import InputError

MOST = 0.005
"""Bow by the board's longer edge from which it is not used, as it is estimated about a lens that is bent along: half of
what it is (chosen: in the same test 1 mm of 140 seems 0.0036, 3 mm 0.0105, and a flat board 0.0001; flat ones before
other lenses seemed to have up to 0.001)"""
SURE = 5.0
"""Standard deviations by which a bow must differ from none (chosen)"""


def require_flat(found: Bundle) -> None:
    """Raise InputError where the pictures show a bent board."""
    height, sigma = bow(found)
    if height > MOST * found.rig.board.size.max() and height > SURE * sigma:
        raise InputError(
            f"camera: the board is not flat: its corners stand by {1e3 * height:.1f} mm or more out of its plane; "
            "glue it on something flat and stiff, and take the pictures again"
        )


def bow(found: Bundle) -> tuple[float, float]:
    """Return how far [m] corners of the board stand out of its plane, from lowest to highest, and how sure that is.

    The board is taken for a parabolic surface.
    """
    rows, left, freedom = [], [], 0
    surface = _surface(found.rig.board)
    for view, pose in zip(found.views, found.sights, strict=True):
        lever = found.rig.board.corners[view.number] @ pose[:3, :3].T
        pixel, by_point, by_terms = projected(found.rig.lens.numbers, lever + pose[:3, 3])
        by_pose = np.concatenate([by_point, -by_point @ skew(lever)], axis=-1).reshape(-1, 6)
        by_height = (by_point @ pose[:3, 2])[..., None] * surface[view.number][:, None]
        shared = np.concatenate([by_terms, by_height], axis=-1).reshape(len(by_pose), -1)
        taken, _ = np.linalg.qr(by_pose)
        rows.append(shared - taken @ (taken.T @ shared))
        off = (view.pixel - pixel).ravel()
        left.append(off - taken @ (taken.T @ off))
        freedom += len(off) - 6
    slope, rest = np.concatenate(rows), np.concatenate(left)
    scale = np.linalg.norm(slope, axis=0)
    found_by, _, _, _ = np.linalg.lstsq(slope / scale, rest, rcond=None)
    variance = float(((rest - slope / scale @ found_by) ** 2).sum()) / max(freedom - len(scale), 1)
    covariance = variance * np.linalg.pinv((slope / scale).T @ (slope / scale)) / np.outer(scale, scale)
    bent, spread = (found_by / scale)[len(TERMS) :], covariance[len(TERMS) :, len(TERMS) :]
    heights = surface @ bent
    ends = surface[int(np.argmax(heights))] - surface[int(np.argmin(heights))]
    return float(np.ptp(heights)), float(np.sqrt(ends @ spread @ ends))


def _surface(board: Board) -> Array:
    """Shapes (C, 3) of a surface without slope at the corners: bent along x, twisted, bent along y; about one high."""
    x, y = (board.corners[:, :2] / board.size.max() * 2.0 - board.size / board.size.max()).T
    return np.stack([x * x, x * y, y * y], axis=-1)
