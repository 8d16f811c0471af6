"""Lens, camera, board and arm from pictures of a board and encoder readings.

Mends views with an ambiguous tilt, reports others that do not fit. Refuses a bent board, which makes focal lengths
wrong (6 to 8 % for 2.5 mm in 140 mm, `tests/diagnosis/camera/test_film.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, Displacement
from rejoint.arms.camera.board import Board, BoardView
from rejoint.arms.camera.lens import TERMS, place
from rejoint.arms.camera.rig import Rig
from rejoint.arms.camera.views import Unusable
from rejoint.arms.rotations import difference
from rejoint.diagnosis.calibration.camera.starting import first_lens, first_rig
from rejoint.diagnosis.calibration.camera.ties import TieProblem, lens_ties, tool_spread, with_poses
from rejoint.diagnosis.calibration.parameters import Belief, DisplacementLayout, PriorCase, belief
from rejoint.diagnosis.calibration.solver import Fitted, solve
from rejoint.system.errors import InputError

CROOKED = 4.0
"""Rms of a view of a bent board, over their median; chosen"""
LEAST_CROOKED = 0.6
"""[px] below which it never is; chosen"""
ELSEWHERE = 4.0
"""Rms of six deviations of a view that does not fit; chosen"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged:
    """Result of the check of V views."""

    good: NDArray[np.bool_]
    """(V,)"""
    sights: Array
    """(V, 4, 4) of the board in the camera frame, mended where needed"""
    bad: tuple[Unusable, ...]
    mended: NDArray[np.bool_]
    """(V,)"""
    rms: Array
    """(V,) [px] residual of the corners"""


def judge(problem: TieProblem, vector: Array, views: Sequence[BoardView]) -> Judged:
    """Check each view with the poses and the arm ``vector`` (k,) of all."""
    rig, whitener = problem.rig_of(vector), problem.whitener(vector)
    lens, corners, told = problem.rig.lens, rig.board.corners, problem.reported(vector)
    placed = [
        place(lens, corners[view.number], view.pixel, start) for view, start in zip(views, problem.sights, strict=True)
    ]
    sights, rms = np.array([one.pose for one in placed]), np.array([one.rms for one in placed])
    limit = max(CROOKED * float(np.median(rms)), LEAST_CROOKED)
    seen = problem.tool(vector, sights)
    off = _distance(whitener, seen, told)
    usual = ELSEWHERE * max(1.0, float(np.median(off)))
    good, mended, bad = np.ones(len(placed), bool), np.zeros(len(placed), bool), []
    expected = rig.sight(told)
    for v in np.flatnonzero((rms > limit) | (off > usual)).tolist():
        view = views[v]
        other = place(lens, corners[view.number], view.pixel, expected[v])
        if (
            other.rms <= limit
            and _distance(whitener[v], problem.tool(vector, np.broadcast_to(other.pose, sights.shape))[v], told[v])
            <= usual
        ):
            sights[v], mended[v], rms[v] = other.pose, True, other.rms
            continue
        good[v] = False
        why = _crooked(rms[v], rms) if rms[v] > limit else _elsewhere(seen[v], told[v])
        bad.append(Unusable(name=view.name, why=why))
    return Judged(good=good, sights=sights, bad=tuple(bad), mended=mended, rms=rms)


def _distance(whitener: Array, seen: Array, told: Array) -> Array:
    """Rms (...) of the six whitened differences between tools."""
    white = (whitener @ difference(seen, told)[..., None])[..., 0]
    return np.asarray(np.sqrt((white**2).mean(axis=-1)))


def _crooked(rms: float, all_rms: Array) -> str:
    return (
        f"its corners lie {rms:.1f} px beside those of a flat board, the others {float(np.median(all_rms)):.2f} px: "
        "blurred, moved during the exposure, or the board is bent"
    )


def _elsewhere(seen: Array, told: Array) -> str:
    shift, turn = np.linalg.norm(difference(seen, told).reshape(2, 3), axis=1)
    return (
        f"shows the tool {1e3 * shift:.0f} mm and {np.degrees(turn):.0f} deg from where the joint positions put it: "
        "not taken there, swapped with another one, or board or camera was shifted"
    )


FEWEST = 10
"""Views that an arm's fit needs; chosen"""
USUAL = PriorCase(twist=0.5)
"""Prior of a worn arm on a table"""

_ROUNDS = 5  # of the fit, at most
_KEEP = 0.6  # share of the views that must remain: otherwise the few may be the wrong ones (chosen)


@dataclass(frozen=True, kw_only=True)
class Residual:
    """Residual of one view."""

    name: str
    rms: float
    """[px] per coordinate"""
    away: float
    """[m] of the tool, picture against corrected kinematics"""
    turned: float
    """[rad] the same of its orientation"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Bundle:
    """Fit of pictures and encoders."""

    problem: TieProblem
    fitted: Fitted
    """with the prior `USUAL` or an earlier calibration"""
    views: tuple[BoardView, ...]
    residuals: tuple[Residual, ...]
    left_out: tuple[Unusable, ...]

    @property
    def rig(self) -> Rig:
        """Poses of camera, board and arm."""
        return self.problem.rig_of(self.fitted.vector)

    @property
    def displacement(self) -> Displacement:
        """Of the tool."""
        return self.problem.displacement(self.fitted.vector)


def bundle(
    arm: Arm,
    board: Board,
    views: Sequence[BoardView],
    position: Array,
    *,
    size: tuple[int, int],
    approach: Array | None = None,
    carried: str = "board",
    prior: Belief | None = None,
) -> Bundle:
    """Fit lens, poses and arm to ``views`` of ``board`` with the encoders at ``position`` (V, n) [rad].

    ``size`` [px] of the pictures; ``approach`` (V, n) as in `Measurements`; ``carried`` of `MOUNTINGS`. InputError for
    too few views that fit.
    """
    position = np.asarray(position, dtype=float)
    layout, count = DisplacementLayout(joints=arm.joints), len(views)
    lens = first_lens(size, board, views)
    placed = [place(lens, board.corners[view.number], view.pixel) for view in views]
    sights = np.array([one.pose for one in placed])
    rig = first_rig(arm, lens, board, carried, position, sights)
    by_lens, told = lens_ties(rig, views, sights)
    problem = TieProblem(
        arm=arm,
        layout=layout,
        rig=rig,
        sights=sights,
        by_lens=by_lens,
        position=position,
        posture=np.arange(count),
        belief=with_poses(belief(arm, layout, USUAL) if prior is None else prior, told),
        approach=np.full_like(position, np.nan) if approach is None else np.broadcast_to(approach, position.shape),
        spread=tool_spread(rig, sights, np.array([one.covariance for one in placed])),
    )
    good, bad, start = np.ones(count, bool), dict[str, Unusable](), problem.belief.mean
    for number in range(_ROUNDS):
        fitted = solve(problem.rows(good), start)
        judged = judge(problem, fitted.vector, views)
        bad |= {one.name: one for one in judged.bad}
        if number > 0 and (judged.good == good).all() and not judged.mended[good].any():
            break
        problem, good, start = replace(problem, sights=judged.sights), judged.good, fitted.vector
        if good.sum() < max(FEWEST, _KEEP * count):
            raise InputError(
                f"{count - good.sum()} of {count} views do not fit the others (such as {', '.join(list(bad)[:5])}); "
                "check that every picture is paired with the joint positions at which it was taken"
            )
    used, off = problem.rows(good), problem.misfit(fitted.vector)
    return Bundle(
        problem=used,
        fitted=fitted,
        views=tuple(view for view, fits in zip(views, good, strict=True) if fits),
        residuals=tuple(
            Residual(
                name=views[v].name,
                rms=float(judged.rms[v]),
                away=float(np.linalg.norm(off[v, :3])),
                turned=float(np.linalg.norm(off[v, 3:])),
            )
            for v in np.flatnonzero(good).tolist()
        ),
        left_out=tuple(bad[view.name] for view, fits in zip(views, good, strict=True) if not fits),
    )


MOST = 0.005
"""Bow over the longer edge of a refused board; chosen: half of the true one"""
SURE = 5.0
"""Standard deviations of a significant bow; chosen"""


def require_flat(found: Bundle) -> None:
    """Raise InputError if the board is bent."""
    height, sigma = bow(found)
    if height > MOST * found.rig.board.size.max() and height > SURE * sigma:
        raise InputError(
            f"camera: the board is not flat: its corners stand by {1e3 * height:.1f} mm or more out of its plane; "
            "glue it on something flat and stiff, and take the pictures again"
        )


def bow(found: Bundle) -> tuple[float, float]:
    """Board's parabolic bow [m], and its sigma."""
    rows, left, freedom = [], [], 0
    surface = _surface(found.rig.board)
    for view, pose in zip(found.views, found.problem.sights, strict=True):
        pixel, slope, by_terms = found.rig.lens.slopes(
            found.rig.board.corners[view.number] @ pose[:3, :3].T, pose[:3, 3]
        )
        by_pose = slope.reshape(-1, 6)
        by_height = (slope[..., :3] @ pose[:3, 2])[..., None] * surface[view.number][:, None]
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
    """Shapes (C, 3) at the corners: bent along x, twisted, bent along y; height about one."""
    x, y = (board.corners[:, :2] / board.size.max() * 2.0 - board.size / board.size.max()).T
    return np.stack([x * x, x * y, y * y], axis=-1)
