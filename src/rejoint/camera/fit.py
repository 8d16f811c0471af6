"""Lens, camera, board and arm from pictures of a board and encoder readings.

OpenCV finds the lens and the poses of the board. Then one fit refines all of it together
with the arm's displacement. Views that do not fit are named and left out, and a bent board is refused: it makes focal
lengths wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from rejoint.arms import Arm, Array, Displacement, jacobian, tcp_pose
from rejoint.arms.rotations import difference, inverse, moved, pose_of
from rejoint.camera.board import Board, BoardView
from rejoint.camera.detector import Unusable
from rejoint.camera.film import Film, positions
from rejoint.camera.lens import CORNER, FLAT, TERMS, Lens, Placed, place
from rejoint.camera.rig import Rig, point_sigma
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.fit import beliefs_of, earlier, judged, likeliest
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.parameters import (
    Belief,
    DisplacementLayout,
    PriorCase,
    belief,
    floor_of,
    play_variance,
)
from rejoint.diagnosis.calibration.solver import Fittable, Fitted, solve
from rejoint.diagnosis.regression import fit_clustered
from rejoint.system.errors import InputError

FEWEST = 10
"""Views that a fit needs, and that determine more of a lens than its focal length; chosen"""
CROOKED = 4.0
"""Rms of a view of a bent board, over their median; chosen"""
ELSEWHERE = 4.0
"""Rms of six deviations of a view that does not fit; chosen"""
USUAL = PriorCase(twist=0.5)
"""Prior of a worn arm on a table"""
_ROUNDS = 5  # of a fit and leaving out views, at most
_KEEP = 0.6  # share of the views that must remain: otherwise the few may be the wrong ones (chosen)
_FOCAL = (0.3, 5.0)  # least and most of a focal length, by the width of the picture (webcams: 0.6 to 1.3)


def first_lens(size: tuple[int, int], board: Board, views: Sequence[BoardView]) -> Lens:
    """Lens of pictures of ``size`` [px] that fits flat boards best."""
    usual, few = Lens.usual(*size), len(views) < FEWEST
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_K3
    flags |= few * (cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2)
    shown = list(views)
    for _ in range(_ROUNDS):
        corners = [board.corners[view.number].astype(np.float32) for view in shown]
        pixels = [view.pixel.astype(np.float32) for view in shown]
        found = cv2.calibrateCameraExtended(corners, pixels, size, usual.matrix, np.zeros(5), flags=flags)
        matrix, bent, rms = found[1], found[2], found[7][:, 0]
        good = rms <= max(CROOKED * float(np.median(rms)), FLAT)
        if good.all():
            break
        shown = [view for view, fits in zip(shown, good, strict=True) if fits]
    if not _FOCAL[0] < matrix[0, 0] / usual.width < _FOCAL[1]:
        return usual
    return usual.with_numbers(np.array([matrix[0, 0], matrix[0, 2], matrix[1, 2], *np.ravel(bent)[:4]]))


def first_places(lens: Lens, board: Board, views: Sequence[BoardView]) -> list[Placed]:
    """Find the board in each view by itself."""
    return [place(lens, board.corners[view.number], view.pixel) for view in views]


_FAR = 4.0  # times the median distance beyond which a view does not help the first estimate (chosen)
_LEVER = 0.1  # [m] that makes a length of a turn (chosen: the size of a board)
_STRETCH = 0.2
"""Relative error of lengths by another board; chosen: wear makes 0.05"""
_LEAST = 0.2
"""Factor of lengths below which motion and pictures do not match; chosen"""
_TURNED = np.radians(10.0)
"""[rad] least turn about two directions; chosen"""


def first_rig(arm: Arm, lens: Lens, board: Board, carried: str, position: Array, sights: Array) -> Rig:
    """Find the poses of camera and board by the encoders' ``position`` (V, n) [rad], without outliers.

    ``sights`` (V, 4, 4): board in the camera frame. InputError for too little rotation, or another board.
    """
    tool = tcp_pose(arm, position)
    axes = tool[:, :3, :3] - tool[:, :3, :3].mean(axis=0)
    turns = np.linalg.svd(axes.reshape(len(tool), -1), compute_uv=False) / np.sqrt(len(tool))
    if len(tool) < 3 or turns[1] < _TURNED:
        raise InputError(
            "the tool was turned too little between the views to tell where camera and board are; "
            "turn it by 20 degrees and more about at least two directions"
        )
    between = sights if carried == "board" else inverse(sights)
    used = np.ones(len(tool), bool)
    for _ in range(_ROUNDS):
        rig = Rig(lens=lens, board=board, carried=carried, **_hand_eye(between[used], tool[used]))
        shift, turn = np.split(difference(rig.tool(sights), tool), 2, axis=-1)
        off = np.linalg.norm(shift, axis=-1) + _LEVER * np.linalg.norm(turn, axis=-1)
        used = off <= _FAR * np.median(off)
    scale = _scale(tool[used], between[used], rig.standing)
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
    return rig


def _hand_eye(seen: Array, tool: Array) -> dict[str, Array]:
    """Poses ``standing`` and ``mounted`` of a rig: A M = F B by linear least squares (Dornaika and Horaud 1998).

    ``seen`` M (V, 4, 4): the carried one in the frame of the standing one; ``tool`` F (V, 4, 4) in the base. OpenCV's
    `calibrateRobotWorldHandEye` is missing from its version 5.
    """
    one, turn = np.eye(3), tool[:, :3, :3]
    rows = [np.hstack([np.kron(m.T, one), -np.kron(one, f)]) for m, f in zip(seen[:, :3, :3], turn, strict=True)]
    both = np.linalg.svd(np.vstack(rows), full_matrices=False)[2][-1].reshape(2, 3, 3).swapaxes(1, 2)
    a, b = Rotation.from_matrix(both / np.cbrt(np.linalg.det(both))[:, None, None]).as_matrix()
    left = np.concatenate([np.broadcast_to(one, turn.shape), -turn], axis=2).reshape(-1, 6)
    right = (tool[:, :3, 3] - seen[:, :3, 3] @ a.T).ravel()
    shift = np.linalg.lstsq(left, right, rcond=None)[0]
    return {"standing": pose_of(a, shift[:3]), "mounted": pose_of(b, shift[3:])}


def _scale(tool: Array, between: Array, standing: Array) -> float:
    """Factor of the pictures' lengths that fits the tool's motion best."""
    one = np.broadcast_to(np.eye(3), (len(tool), 3, 3))
    lengths = (between[:, :3, 3] @ standing[:3, :3].T)[..., None]
    left = np.concatenate([one, -tool[:, :3, :3], lengths], axis=2).reshape(-1, 7)
    return float(np.linalg.lstsq(left, tool[:, :3, 3].ravel(), rcond=None)[0][6])


HUBER = 3.55
"""Residual [sigma] from which the loss is linear: 95 % of six normal numbers"""
POSES = 12
"""Unknowns after the arm's, shift [m] and turn [rad] of `Rig.standing` and `Rig.mounted`; the lens follows"""
NOWHERE = 10.0
"""[m] and [rad] sigma of unknown poses"""
ASKEW = np.radians(0.15)
"""[rad] unexplained turn; chosen"""
JOINT = np.radians(0.1)
"""[rad] the same of each joint; chosen"""
_ANY = np.array([1e3] * 3 + [1.0] * 4)  # standard deviations of a lens of which nothing is known
_STEP = 1e-6  # [m] and [rad] of numerical derivatives


@dataclass(frozen=True, kw_only=True, eq=False)
class FilmProblem(Fittable):
    """Poses of the board in V views. Unknown: the arm, then the poses of camera and board, then the lens."""

    rig: Rig
    """first estimate"""
    sights: Array
    """(V, 4, 4) of the board in the camera frame"""
    by_lens: Array
    """(V, 6, 7) derivative of shift [m] and turn [rad] by the lens's `TERMS`"""
    spread: Array
    """(V, 6, 6) covariance of the tool's pose by corners, base axes"""
    position: Array
    """(V, n) [rad]"""
    posture: NDArray[np.int64]
    """(V,)"""
    huber: float = HUBER

    @classmethod
    def of(
        cls, arm: Arm, rig: Rig, position: Array, sights: Array, lens: Array, prior: Belief | None = None
    ) -> FilmProblem:
        """Take views without errors of their own; ``lens`` (7, 7): precision; the prior is `USUAL` or another."""
        layout, views = DisplacementLayout(joints=arm.joints), len(sights)
        return cls(
            arm=arm,
            layout=layout,
            belief=with_poses(belief(arm, layout, USUAL) if prior is None else prior, lens),
            rig=rig,
            sights=sights,
            by_lens=np.zeros((views, 6, len(TERMS))),
            spread=np.zeros((views, 6, 6)),
            position=np.asarray(position, dtype=float),
            posture=np.arange(views),
        )

    @property
    def postures(self) -> NDArray[np.int64]:
        """(V,)."""
        return self.posture

    @property
    def known(self) -> NDArray[np.bool_]:
        """(V, 6), all true."""
        return np.ones((len(self.posture), 6), dtype=bool)

    def rows(self, where: NDArray[np.bool_]) -> FilmProblem:
        """Problem of some views."""
        names = ("sights", "by_lens", "spread", "position", "posture")
        return replace(self, **{name: getattr(self, name)[where] for name in names})

    def rig_of(self, vector: Array) -> Rig:
        """Rig for the unknowns (k,)."""
        standing, mounted, lens = np.split(vector[self.layout.body :], [6, POSES])
        return replace(
            self.rig,
            standing=moved(self.rig.standing, standing),
            mounted=moved(self.rig.mounted, mounted),
            lens=self.rig.lens.with_numbers(self.rig.lens.numbers + lens),
        )

    def pose(self, vector: Array) -> Array:
        """Pose (4, 4) in the base of the measuring frame."""
        return self.rig_of(vector).standing

    def tool(self, vector: Array) -> Array:
        """Tool (V, 4, 4) in the base by the camera."""
        return self.rig_of(vector).tool(moved(self.sights, self.by_lens @ vector[self.layout.body + POSES :]))

    def reported(self, vector: Array) -> Array:
        """Tool (V, 4, 4) in the base by corrected kinematics."""
        return self.displacement(vector).tool_pose(self.arm, self.position)

    def misfit(self, vector: Array) -> Array:
        """Residual (V, 6) without derivative."""
        return difference(self.tool(vector), self.reported(vector))

    def residual(self, vector: Array) -> tuple[Array, Array]:
        """Shift [m] and turn [rad] (V, 6) of the tool, seen less predicted; derivative (V, 6, k)."""
        seen, told = self.tool(vector), self.reported(vector)
        base, body = difference(seen, told), self.layout.body
        slope = np.zeros((*base.shape, len(vector)))
        for i in np.flatnonzero(self.belief.upper > self.belief.lower).tolist():
            other = vector.copy()
            other[i] += _STEP
            ends = (seen, self.reported(other)) if i < body else (self.tool(other), told)
            slope[..., i] = (difference(*ends) - base) / _STEP
        return base, slope

    def noise(self, vector: Array) -> Array:
        """Covariance (V, 6, 6) of a residual: corners, floating joints, and what no model explains."""
        found = self.displacement(vector)
        variance = play_variance(found, found.torque(self.arm, self.position)) + JOINT**2
        lever = jacobian(self.arm, self.position)
        rest = np.diag([floor_of(self.arm) ** 2] * 3 + [ASKEW**2] * 3)
        return np.asarray((lever * variance[:, None, :]) @ np.swapaxes(lever, -1, -2) + rest + self.spread)

    def measurements(self, vector: Array, approach: Array) -> Measurements:
        """Tool in the measuring frame; ``approach`` (V, n) [rad]."""
        rig = self.rig_of(vector)
        return Measurements(
            position=self.position,
            approach=approach,
            point=(inverse(rig.standing) @ self.tool(vector))[:, :3, 3],
            sigma=point_sigma(self.spread),
            posture=self.posture,
            frame="camera" if rig.carried == "board" else "board",
            source="camera",
        )


def with_poses(own: Belief, lens: Array) -> Belief:
    """Append unknown `POSES` and a lens of precision (7, 7) to a belief."""
    anywhere = np.full(POSES + len(lens), np.inf)
    return Belief(
        mean=np.concatenate([own.mean, np.zeros_like(anywhere)]),
        precision=block_diag(own.precision, NOWHERE**-2.0 * np.eye(POSES), lens),
        lower=np.concatenate([own.lower, -anywhere]),
        upper=np.concatenate([own.upper, anywhere]),
    )


def _lens_ties(lens: Lens, board: Board, views: Sequence[BoardView], sights: Array) -> tuple[Array, Array]:
    """Boards' derivative (V, 6, 7) by the lens, and its precision (7, 7)."""
    ties, told = [], np.diag(_ANY**-2.0)
    for view, pose in zip(views, sights, strict=True):
        _, by_pose, by_terms = lens.slopes(board.corners[view.number], pose)
        ties.append(-np.linalg.lstsq(by_pose, by_terms, rcond=None)[0])
        left = (by_terms + by_pose @ ties[-1]) / CORNER
        told = told + left.T @ left
    return np.array(ties), told


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

    problem: FilmProblem
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
    carried: str = "board",
    prior: Belief | None = None,
) -> Bundle:
    """Fit lens, poses and arm to ``views`` of ``board`` with the encoders at ``position`` (V, n) [rad].

    ``size`` [px] of the pictures; ``carried`` of `MOUNTINGS`. InputError for too few views that fit.
    """
    count, lens = len(views), first_lens(size, board, views)
    placed = first_places(lens, board, views)
    sights = np.array([one.pose for one in placed])
    rig = first_rig(arm, lens, board, carried, position, sights)
    by_lens, told = _lens_ties(lens, board, views, sights)
    problem = replace(
        FilmProblem.of(arm, rig, position, sights, told, prior),
        by_lens=by_lens,
        spread=rig.spread(sights, np.array([one.covariance for one in placed])),
    )
    good, start = np.ones(count, bool), problem.belief.mean
    for number in range(_ROUNDS):
        fitted = solve(problem.rows(good), start)
        before, fitting, start = problem.sights, good, fitted.vector
        problem, rms, doubts = _judged(problem, fitted.vector, views)
        good = np.array([not why for why in doubts])
        if number > 0 and (good == fitting).all() and np.allclose(problem.sights, before, atol=1e-6):
            break
        if good.sum() < max(FEWEST, _KEEP * count):
            named = ", ".join(view.name for view, fits in zip(views, good, strict=True) if not fits)
            raise InputError(
                f"{count - good.sum()} of {count} views do not fit the others ({named}); check that every picture is "
                "paired with the joint positions at which it was taken"
            )
    shift, turn = np.split(problem.misfit(fitted.vector), 2, axis=-1)
    kept = np.flatnonzero(good).tolist()
    return Bundle(
        problem=problem.rows(good),
        fitted=fitted,
        views=tuple(views[v] for v in kept),
        residuals=tuple(
            Residual(
                name=views[v].name,
                rms=float(rms[v]),
                away=float(np.linalg.norm(shift[v])),
                turned=float(np.linalg.norm(turn[v])),
            )
            for v in kept
        ),
        left_out=tuple(Unusable(view.name, why) for view, why in zip(views, doubts, strict=True) if why),
    )


def _judged(problem: FilmProblem, vector: Array, views: Sequence[BoardView]) -> tuple[FilmProblem, Array, list[str]]:
    """Choose each view's tilt by the fit; return also residuals (V,) [px], and why a view does not fit, or empty."""
    rig, told = problem.rig_of(vector), problem.reported(vector)
    placed = [
        place(problem.rig.lens, rig.board.corners[view.number], view.pixel, near)
        for view, near in zip(views, rig.sight(told), strict=True)
    ]
    problem = replace(problem, sights=np.array([one.pose for one in placed]))
    rms, misfit = np.array([one.rms for one in placed]), problem.misfit(vector)
    off = np.sqrt(((problem.whitener(vector) @ misfit[..., None])[..., 0] ** 2).mean(axis=-1))
    limit = max(CROOKED * float(np.median(rms)), FLAT)
    usual = ELSEWHERE * max(1.0, float(np.median(off)))
    why = [""] * len(views)
    for v in np.flatnonzero(off > usual).tolist():
        shift, turn = np.linalg.norm(misfit[v].reshape(2, 3), axis=1)
        why[v] = (
            f"shows the tool {1e3 * shift:.0f} mm and {np.degrees(turn):.0f} deg from where the joint positions put "
            "it: not taken there, swapped with another one, or board or camera was shifted"
        )
    for v in np.flatnonzero(rms > limit).tolist():
        why[v] = (
            f"its corners lie {rms[v]:.1f} px beside those of a flat board, the others {float(np.median(rms)):.2f} px: "
            "blurred, moved during the exposure, or the board is bent"
        )
    return problem, rms, why


MOST = 0.005
"""Bow over the longer edge of a refused board; chosen: half of the true one"""
SURE = 5.0
"""Standard deviations of a significant bow; chosen"""


def bow(found: Bundle) -> tuple[float, float]:
    """Board's parabolic bow [m], and its sigma: what poses and lens leave of the corners."""
    board, rows, cluster = found.rig.board, [], []
    x, y = ((2.0 * board.corners[:, :2] - board.size) / board.size.max()).T
    surface = np.stack([x * x, x * y, y * y], axis=-1)  # bent along x, twisted, bent along y
    for number, (view, pose) in enumerate(zip(found.views, found.problem.sights, strict=True)):
        pixel, by_pose, by_terms = found.rig.lens.slopes(board.corners[view.number], pose)
        by_height = (by_pose[:, :3] @ pose[:3, 2])[:, None] * np.repeat(surface[view.number], 2, axis=0)
        both = np.column_stack([by_terms, by_height, (view.pixel - pixel).ravel()])
        taken, _ = np.linalg.qr(by_pose)
        rows.append(both - taken @ (taken.T @ both))
        cluster += [number] * len(both)
    every = np.concatenate(rows)
    fit = fit_clustered(every[:, :-1], every[:, -1], np.array(cluster))
    heights, shapes = surface @ fit.coefficients[len(TERMS) :], slice(len(TERMS), None)
    ends = surface[int(np.argmax(heights))] - surface[int(np.argmin(heights))]
    return float(np.ptp(heights)), float(np.sqrt(ends @ fit.covariance[shapes, shapes] @ ends))


@dataclass(frozen=True, kw_only=True, eq=False)
class Filmed:
    """Result of a fit to an image sequence."""

    calibration: Calibration
    measurements: Measurements
    """the tool in each view used"""
    rig: Rig
    rig_sigma: Array
    """(19,) sigma of the lens's `TERMS`, shift [m] and turn [rad] of camera and board"""
    residuals: tuple[Residual, ...]
    left_out: tuple[Unusable, ...]

    @property
    def rms(self) -> float:
        """[px] over all corners, per coordinate."""
        return float(np.sqrt(np.mean([one.rms**2 for one in self.residuals])))


def fit_film(arm: Arm, film: Film, *, prior: Calibration | None = None, date: str = "") -> Filmed:
    """Fit lens, camera, board and displacement, tested on views left out.

    ``prior``: an earlier calibration. InputError for too few views or a bent board.
    """
    shots, layout = film.usable, DisplacementLayout(joints=arm.joints)
    if film.size is None or len(shots) < FEWEST:
        why = "; ".join(f"{one.name}: {one.why}" for one in film.unusable[:3])
        raise InputError(
            f"camera: the board is seen well in {len(shots)} of {len(film)} pictures, expected at least {FEWEST}"
            f"{why and f' ({why})'}"
        )
    found = bundle(
        arm,
        film.board,
        film.views,
        positions(shots, arm)[0],
        size=film.size,
        carried=film.carried,
        prior=None if prior is None else earlier(arm, layout, prior),
    )
    height, sigma = bow(found)
    if height > MOST * film.board.size.max() and height > SURE * sigma:
        raise InputError(
            f"camera: the board is not flat: its corners stand by {1e3 * height:.1f} mm or more out of its plane; "
            "glue it on something flat and stiff, and take the pictures again"
        )
    names = {view.name for view in found.views}
    used = tuple(shot for shot in shots if shot.name in names)
    posture = np.array([shot.posture for shot in used], dtype=np.int64)
    lens = found.problem.belief.precision[-len(TERMS) :, -len(TERMS) :]
    cases = beliefs_of(arm, layout, prior, len(np.unique(posture)))
    beliefs = [(with_poses(own, lens), odds) for own, odds in cases]
    problem, fitted = likeliest(replace(found.problem, posture=posture), beliefs)
    measured = problem.measurements(fitted.vector, positions(used, arm)[1])
    return Filmed(
        calibration=judged(problem, fitted, measured, date),
        measurements=measured,
        rig=problem.rig_of(fitted.vector),
        rig_sigma=np.roll(np.sqrt(np.diag(fitted.covariance)[problem.layout.body :]), len(TERMS)),
        residuals=found.residuals,
        left_out=(*film.unusable, *found.left_out),
    )
