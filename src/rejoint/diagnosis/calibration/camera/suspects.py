"""Views that do not fit the others: mended where the board was only taken for tilted the other way, else named."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.arms.camera.sighting import place
from rejoint.arms.camera.views import Unusable
from rejoint.diagnosis.calibration.camera.adjustment import Adjustment, difference
from rejoint.diagnosis.calibration.parameters import displacement_of

CROOKED = 4.0
"""Times the median rms of the views from which corners do not lie as on a flat board (chosen)"""
LEAST_CROOKED = 0.6
"""[px] below which they do in any case (chosen: what soft pictures of a web camera have)"""
ELSEWHERE = 4.0
"""Standard deviations, root mean square of six, from which a view does not belong to its joint positions (chosen on
emulated worn arms: play brings more in 3 of 320 views, `python -m benchmarks.camera --arms 8`)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged:
    """What became of the views of an adjustment."""

    good: NDArray[np.bool_]
    """(V,)"""
    sights: Array
    """(V, 4, 4) of the board in the frame of the camera, mended where needed"""
    bad: tuple[Unusable, ...]
    mended: NDArray[np.bool_]
    """(V,)"""


def judge(state: Adjustment, vector: Array) -> Judged:
    """Look at every view by itself, with the lens, the poses and the arm ``vector`` (k,) of all of them."""
    lens, corners = state.rig.lens, state.rig.board.corners
    told = displacement_of(state.layout, vector).tool_pose(state.arm, state.position, state.approach)
    placed = [
        place(lens, corners[view.number], view.pixel, start)
        for view, start in zip(state.views, state.sights, strict=True)
    ]
    sights, rms = np.array([one.pose for one in placed]), np.array([one.rms for one in placed])
    limit = max(CROOKED * float(np.median(rms)), LEAST_CROOKED)
    off = _distance(state, state.rig.tool(sights), told)
    usual = ELSEWHERE * max(1.0, float(np.median(off)))
    good, mended, bad = np.ones(len(placed), bool), np.zeros(len(placed), bool), []
    expected = state.rig.sight(told)
    for v in np.flatnonzero((rms > limit) | (off > usual)).tolist():
        view = state.views[v]
        other = place(lens, corners[view.number], view.pixel, expected[v])
        away = _distance(state, state.rig.tool(other.pose[None]), told[v : v + 1], v)[0]
        if other.rms <= limit and away <= usual:
            sights[v], mended[v] = other.pose, True
            continue
        good[v] = False
        why = _crooked(rms[v], rms) if rms[v] > limit else _elsewhere(state, told, sights[v], v, usual)
        bad.append(Unusable(name=view.name, why=why))
    return Judged(good=good, sights=sights, bad=tuple(bad), mended=mended)


def _distance(state: Adjustment, seen: Array, told: Array, row: int | None = None) -> Array:
    """Root mean squares (V,) of the six whitened differences between tools."""
    whitener = state.whitener if row is None else state.whitener[row : row + 1]
    white = (whitener @ difference(seen, told)[..., None])[..., 0]
    return np.asarray(np.sqrt((white**2).mean(axis=-1)))


def _crooked(rms: float, all_rms: Array) -> str:
    return (
        f"its corners lie {rms:.1f} px beside those of a flat board, the others {float(np.median(all_rms)):.2f} px: "
        "blurred, moved during the exposure, or the board is bent"
    )


def _elsewhere(state: Adjustment, told: Array, sight: Array, v: int, usual: float) -> str:
    seen = state.rig.tool(sight)
    off = difference(seen, told[v])
    text = (
        f"shows the tool {1e3 * float(np.linalg.norm(off[:3])):.0f} mm and "
        f"{np.degrees(float(np.linalg.norm(off[3:]))):.0f} deg from where the joint positions put it"
    )
    others = _distance(state, np.broadcast_to(seen, told.shape), told)
    others[v] = np.inf
    nearest = int(np.argmin(others))
    if others[nearest] <= usual:
        return f"{text}: it belongs to the joint positions of {state.views[nearest].name}; swapped?"
    return f"{text}: not taken there, or board or camera was shifted"
