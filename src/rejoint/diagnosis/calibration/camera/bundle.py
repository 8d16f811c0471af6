"""One bundle adjustment: lens, camera, board and arm from pictures of a board and the encoders' readings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, Displacement
from rejoint.arms.camera.board import Board, BoardView
from rejoint.arms.camera.lens import TERMS, Lens
from rejoint.arms.camera.poses import inverse
from rejoint.arms.camera.rig import MOUNTINGS, Rig
from rejoint.arms.camera.sighting import CORNER, place
from rejoint.arms.camera.views import Unusable
from rejoint.diagnosis.calibration.camera.adjustment import Adjustment, Tip, looseness
from rejoint.diagnosis.calibration.camera.starting import first_lens, first_rig, first_sights
from rejoint.diagnosis.calibration.camera.suspects import judge
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.parameters import Belief, DisplacementLayout, PriorCase, belief, displacement_of
from rejoint.system.errors import InputError
from rejoint.system.extras import require

FEWEST = 10
"""Views of which an arm is estimated (chosen: with fewer, a wrong one is not noticed)"""
HUBER = 3.0
"""Standard deviations of a residual from which the loss grows linearly (chosen: 0.3 % of normal ones are larger)"""
USUAL = PriorCase(twist=0.5)
"""What is believed of the arm before: that it may be worn and stands on a table (see `PriorCase`)"""

_ROUNDS = 5  # of the adjustment, at most; all but the first two only where a view was left out or taken back
_STEPS = (15, 30)  # of the first round and of the others
_INSIDE = 1e-6  # from a bound at which the solver may begin
_KEEP = 0.6  # share of the views that must remain: otherwise the few may be the wrong ones (chosen)


@dataclass(frozen=True, kw_only=True)
class Residual:
    """How well one view fits."""

    name: str
    rms: float
    """[px] of its corners, per coordinate"""
    away: float
    """[m] between where the tool is seen and where the arm's kinematics with its displacement put it"""
    turned: float
    """[rad] the same of its orientation"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Bundle:
    """What pictures and encoders tell together."""

    arm: Arm
    rig: Rig
    displacement: Displacement
    vector: Array
    """(k,) its parameters"""
    covariance: Array
    """(k, k) of them, see `rejoint.diagnosis.calibration.parameters.DisplacementLayout`"""
    rig_covariance: Array
    """(19, 19) of the lens's `TERMS`, and of shift [m] and turn [rad] of `Rig.standing` and `Rig.mounted`"""
    residuals: tuple[Residual, ...]
    left_out: tuple[Unusable, ...]
    """views that do not fit the others, and why"""
    views: tuple[BoardView, ...]
    """those that were used"""
    position: Array
    """(V, n) [rad] encoders at these"""
    approach: Array
    """(V, n) [rad] where they came from last; NaN where nobody knows"""
    sights: Array
    """(V, 4, 4) of the board in the frame of the camera at these"""

    @property
    def rms(self) -> float:
        """[px] over all corners, per coordinate."""
        return float(np.sqrt(np.mean([one.rms**2 for one in self.residuals])))

    def intervals(self) -> dict[str, tuple[float, float]]:
        """Name every number that was estimated, with its value and standard deviation, in SI units and px."""
        layout = DisplacementLayout(joints=self.arm.joints)
        told = dict(zip(layout.names(), zip(self.vector, _deviations(self.covariance), strict=True), strict=True))
        spread = _deviations(self.rig_covariance)
        what = ("camera", "board") if self.rig.carried == "board" else ("board", "camera")
        names = [*TERMS, *(f"{one} {axis}" for one in what for axis in ("x", "y", "z", "turn x", "turn y", "turn z"))]
        values = [*self.rig.lens.numbers, *self.rig.standing[:3, 3], 0, 0, 0, *self.rig.mounted[:3, 3], 0, 0, 0]
        rig = {name: (float(v), float(s)) for name, v, s in zip(names, values, spread, strict=True)}
        return rig | {name: (float(value), float(sigma)) for name, (value, sigma) in told.items()}

    def measurements(self, posture: Array | None = None) -> Measurements:
        """Where the tool was seen, in the base frame, as any other measurement; ``posture`` (V,) numbers postures."""
        tool = self.rig.tool(self.sights)
        count = len(self.views)
        spread = np.array([
            place(self.rig.lens, self.rig.board.corners[view.number], view.pixel, pose).covariance
            for view, pose in zip(self.views, self.sights, strict=True)
        ])  # fmt: skip
        return Measurements(
            position=self.position, approach=self.approach, point=tool[:, :3, 3],
            sigma=point_sigma(self.rig, self.sights, spread),
            posture=np.arange(count) if posture is None else np.asarray(posture), frame="base", source="camera",
        )  # fmt: skip


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
    tip: Tip | None = None,
) -> Bundle:
    """Adjust lens, poses and arm to ``views`` of ``board`` with the encoders at ``position`` (V, n) [rad].

    ``size`` [px] is width and height of the pictures, ``approach`` (V, n) where the encoders came from, as far as it
    is known, ``carried`` what the tool carries (`MOUNTINGS`), ``prior`` what is believed of the
    arm, and ``tip`` where the tool's tip is on the board that it carries, where somebody has measured that.
    InputError where the views do not suffice, MissingExtraError without SciPy.
    """
    require("a camera", "scipy")
    position = np.asarray(position, dtype=float)
    _check(arm, views, position, carried, tip)
    came = np.full_like(position, np.nan) if approach is None else np.broadcast_to(approach, position.shape)
    layout = DisplacementLayout(joints=arm.joints)
    believed = belief(arm, layout, USUAL) if prior is None else prior
    lens = Lens.usual(*size)
    first = first_lens(lens, board, views)
    sights = first_sights(first, board, views)
    rig = first_rig(arm, first, board, carried, position, sights)
    state = Adjustment(
        arm=arm, layout=layout, belief=believed, rig=rig, lens=lens, sights=sights, views=tuple(views),
        position=position, approach=came, tip=tip,
        whitener=_whitener(arm, displacement_of(layout, believed.mean), position),
    )  # fmt: skip
    return _rounds(state, believed.mean[: layout.body])


def point_sigma(rig: Rig, sights: Array, spread: Array) -> Array:
    """Return standard deviations (V,) [m] of the tool's coordinates where ``sights`` have covariances (V, 6, 6)."""
    if rig.carried == "board":  # a turn of the board swings the tip about the board's origin
        lever = np.einsum("...ij,j->...i", sights[..., :3, :3], inverse(rig.mounted)[:3, 3])
    else:  # and the tip, which stands before the camera, about it as well
        lever = inverse(rig.mounted)[:3, 3] - sights[..., :3, 3]
    slope = np.zeros((*lever.shape[:-1], 3, 6))
    slope[..., :3] = np.eye(3)
    slope[..., 3:] = -np.cross(np.eye(3), lever[..., None, :])
    total = slope @ spread @ np.swapaxes(slope, -1, -2)
    return np.asarray(np.sqrt(np.trace(total, axis1=-2, axis2=-1) / 3.0))


def _check(arm: Arm, views: Sequence[BoardView], position: Array, carried: str, tip: Tip | None) -> None:
    if carried not in MOUNTINGS:
        raise InputError(f"the tool carries {carried!r}, expected one of: {', '.join(MOUNTINGS)}")
    if tip is not None and carried != "board":
        raise InputError("the place of the tip on the board makes sense where the tool carries the board only")
    if position.shape != (len(views), arm.joints) or not np.isfinite(position).all():
        raise InputError(
            f"expected finite joint positions of shape {(len(views), arm.joints)} [rad], one row a view, "
            f"got {position.shape}"
        )
    if len(views) < FEWEST:
        raise InputError(f"{len(views)} views of the board, expected at least {FEWEST}; take more pictures")


def _rounds(whole: Adjustment, vector: Array) -> Bundle:
    """Adjust, look at every view, mend or leave out what does not fit, and adjust again.

    What the first round leaves out is looked at once more: its lens is not settled yet, and with a wrong lens a board
    that is seen from its front seems turned by degrees.
    """
    count = len(whole.views)
    good, bad = np.ones(count, bool), dict[str, Unusable]()
    for number in range(_ROUNDS):
        whole, vector, slope = _adjusted(whole, good, vector, _STEPS[min(number, 1)])
        judged = judge(whole, vector)
        kept = judged.good if number < 2 else judged.good & good
        bad |= {one.name: one for one in judged.bad}
        if number > 0 and (kept == good).all() and not judged.mended[good].any():
            break
        whole, good = replace(whole, sights=judged.sights), kept
        if good.sum() < max(FEWEST, _KEEP * count):
            names = ", ".join(list(bad)[:5])
            raise InputError(
                f"{count - good.sum()} of {count} views do not fit the others (such as {names}); check that every "
                "picture is paired with the joint positions at which it was taken"
            )
    left = tuple(bad[view.name] for view, fits in zip(whole.views, good, strict=True) if not fits)
    return _result(_some(whole, good), vector, slope, left)


def _adjusted(
    whole: Adjustment, good: NDArray[np.bool_], vector: Array, steps: int
) -> tuple[Adjustment, Array, Array]:  # fmt: skip
    """Solve for the ``good`` (V,) views.

    Returns all of them about that solution, the arm's parameters, and the derivative that `_solved` returns.
    """
    state = _some(whole, good)
    x, slope = _solved(state, vector, steps)
    sights = whole.sights.copy()
    sights[good] = state.sights_of(x)
    found = replace(
        whole, rig=state.rig_of(x), sights=sights,
        whitener=_whitener(state.arm, state.displacement_of(x), whole.position),
    )  # fmt: skip
    return found, x[state.body], slope


def _solved(state: Adjustment, vector: Array, steps: int) -> tuple[Array, Array]:
    """Solve for the unknowns (p,); with the derivative (m, p) of the residuals there, as their loss weighs them."""
    from scipy.optimize import least_squares

    lower, upper = np.full(state.size, -np.inf), np.full(state.size, np.inf)
    body = slice(0, state.layout.body)
    low, high = state.belief.lower[body], state.belief.upper[body]
    room = np.where(high > low, 0.0, 2.0 * _INSIDE)  # what is not to be fitted; the solver wants to have some room
    lower[state.body], upper[state.body] = low - room, high + room
    inside = np.clip(vector, lower[state.body] + _INSIDE, upper[state.body] - _INSIDE)
    found = least_squares(
        state.residual, state.start(inside), state.derivative, bounds=(lower, upper), method="trf", x_scale="jac",
        loss="huber", f_scale=HUBER, max_nfev=steps, xtol=1e-6, ftol=1e-5, gtol=1e-6,
    )  # fmt: skip
    return found.x, found.jac


def _some(whole: Adjustment, good: NDArray[np.bool_]) -> Adjustment:
    """Return the adjustment of some views (V,)."""
    rows = np.flatnonzero(good).tolist()
    return replace(
        whole, sights=whole.sights[rows], views=tuple(whole.views[i] for i in rows), position=whole.position[rows],
        approach=whole.approach[rows], whitener=whole.whitener[rows],
    )  # fmt: skip


def _whitener(arm: Arm, displacement: Displacement, position: Array) -> Array:
    return np.asarray(np.linalg.inv(np.linalg.cholesky(looseness(arm, displacement, position))))


def _result(state: Adjustment, vector: Array, slope: Array, left: tuple[Unusable, ...]) -> Bundle:
    covariance = np.asarray(np.linalg.inv(slope.T @ slope))[: state.shared, : state.shared]
    x = state.start(vector)
    rms = _rms_of_views(state, x)
    off = np.linalg.solve(state.whitener, state.ties(x)[..., None])[..., 0]
    residuals = tuple(
        Residual(
            name=view.name, rms=float(r), away=float(np.linalg.norm(d[:3])), turned=float(np.linalg.norm(d[3:]))
        )
        for view, r, d in zip(state.views, rms, off, strict=True)
    )  # fmt: skip
    own = state.body.start
    return Bundle(
        arm=state.arm, rig=state.rig, displacement=displacement_of(state.layout, vector), vector=vector,
        covariance=covariance[own:, own:], rig_covariance=covariance[:own, :own], residuals=residuals, left_out=left,
        views=tuple(state.views), position=state.position, approach=state.approach, sights=state.sights,
    )  # fmt: skip


def _rms_of_views(state: Adjustment, x: Array) -> Array:
    """(V,) [px] of the corners of each view, per coordinate."""
    ends = np.cumsum([0, *(len(view.number) for view in state.views)])
    square = (state.corners(x) * CORNER) ** 2
    return np.sqrt([square[a:b].mean() for a, b in pairwise(ends)])


def _deviations(covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.diag(covariance)))
