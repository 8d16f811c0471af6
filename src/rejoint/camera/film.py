"""An image sequence: pictures of a board in many postures of one arm, with encoder readings, and what they tell.

Columns of ``postures.csv`` beside pictures: ``picture``, ``position.JOINT_deg``; optional ``posture``.

OpenCV finds the lens and the poses of the board; one fit refines them with the arm's displacement. Views that do not
fit are left out; a bent board is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import compress
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.csv as pc
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from rejoint.arms import Arm, Array, tcp_pose
from rejoint.arms.rotations import difference, inverse, pose_of
from rejoint.camera.board import KINDS, Board, BoardView, Detector, read_picture
from rejoint.camera.rig import CORNER, FLAT, TERMS, Lens, Rig, place, point_sigma, write_rig
from rejoint.diagnosis.calibration.calibration import ANYWHERE, Belief, Calibration, PriorCase, belief
from rejoint.diagnosis.calibration.fit import ToolProblem, beliefs_of, judged, likeliest, solve
from rejoint.diagnosis.calibration.measurements import SHEET_MOST, Measurements, joint_columns, require_degrees
from rejoint.diagnosis.regression import fit_clustered
from rejoint.logs.runfolder import RunFolder
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import set_aside, write_whole
from rejoint.system.records import entity, value_type
from rejoint.system.textfile import ANGLES, COUNT, read_columns

POSTURES = "postures.csv"


@entity
class Shot:
    """One picture and its posture."""

    position: Array
    """(n,) [rad] by encoders"""
    posture: int
    """shots of the same number visit one posture from different sides"""
    seen: BoardView

    @property
    def name(self) -> str:
        """Name of the picture."""
        return self.seen.name


class UnseenBoardError(InputError):
    """The board is not visible; move camera or board."""


@entity
class Film:
    """Pictures by one camera of one board in a fixed setup."""

    board: Board
    carried: str
    """by the tool, see `rejoint.camera.rig.Rig`"""
    size: tuple[int, int] = (0, 0)
    """[px] width and height; zero before the first picture that can be read"""
    shots: tuple[Shot, ...] = ()
    """by name"""

    def with_shot(self, shot: Shot, size: tuple[int, int]) -> Film:
        """Add a picture, in place of one of its name; InputError for another ``size``."""
        if any(self.size) and size != self.size:
            raise InputError(
                f"picture {shot.name} has {size[0]} x {size[1]} px, those before it {self.size[0]} x {self.size[1]}; "
                "take all of them with one camera and one setting"
            )
        shots = {one.name: one for one in (*self.shots, shot)}
        return replace(self, size=size, shots=tuple(shots[name] for name in sorted(shots)))

    @property
    def usable(self) -> tuple[Shot, ...]:
        """Shots that show the board well."""
        return tuple(shot for shot in self.shots if not shot.seen.why)

    @property
    def unusable(self) -> tuple[tuple[str, str], ...]:
        """Names of the other shots, and why."""
        return tuple((shot.name, shot.seen.why) for shot in self.shots if shot.seen.why)

    def located(self, arm: Arm, least: int) -> tuple[Rig, Array, Array]:
        """Rig by flat boards and encoders; boards (V, 4, 4) in usable shots, and the tool's covariance (V, 6, 6).

        InputError for fewer than ``least``.
        """
        views = [shot.seen for shot in self.usable]
        if len(views) < least:
            why = "; ".join(f"{name}: {why}" for name, why in self.unusable[:3])
            raise UnseenBoardError(
                f"camera: the board is seen well in {len(views)} of {len(self.shots)} pictures, expected at least "
                f"{least}{why and f' ({why})'}; take more, or turn camera and board to each other, hold the camera "
                "still, focus it, add light, or put it farther away"
            )
        lens = first_lens(self.size, self.board, views)
        placed = [place(lens, self.board, view) for view in views]
        sights = np.array([one.pose for one in placed])
        rig = first_rig(arm, lens, self.board, self.carried, positions(self.usable), sights)
        return rig, sights, rig.spread(sights, np.array([one.covariance for one in placed]))

    def fit(self, arm: Arm, prior: Calibration | None = None, date: str = "") -> Filmed:
        """Fit lens, camera, board and displacement, tested on views left out.

        ``prior``: an earlier calibration. InputError for too few views that fit, or a bent board.
        """
        shots, board = self.usable, self.board
        views = [shot.seen for shot in shots]
        rig, sights, spread = self.located(arm, FEWEST)
        by_lens, told = _lens_ties(rig.lens, board, views, sights)
        outside = block_diag(ANYWHERE**-2.0 * np.eye(POSES), told)
        problem = replace(
            film_problem(belief(arm, USUAL, outside), arm, rig, positions(shots), sights),
            by_lens=by_lens,
            spread=spread,
            posture=np.array([shot.posture for shot in shots], dtype=np.int64),
        )
        good, vector = np.ones(len(shots), bool), problem.belief.mean
        for number in range(_ROUNDS):
            vector = solve(problem.rows(good), vector).vector
            before, fitting = problem.seen, good
            problem, residuals, doubts = _judged(problem, rig, vector, views)
            good = np.array([view.name not in doubts for view in views])
            if number > 0 and (good == fitting).all() and np.allclose(problem.seen, before, atol=1e-6):
                break
            if good.sum() < max(FEWEST, _KEEP * len(shots)):
                raise InputError(
                    f"{len(doubts)} of {len(shots)} views do not fit the others ({', '.join(doubts)}); check that "
                    "every picture is paired with the joint positions at which it was taken"
                )
        problem = problem.rows(good)
        sights = rig.carried_in(problem.seen)
        height, sigma = bow(rig_of(problem, rig, vector), list(compress(views, good)), sights)
        if height > MOST * board.size.max() and height > SURE * sigma:
            raise InputError(
                f"camera: the board is not flat: its corners stand by {1e3 * height:.1f} mm or more out of its plane; "
                "glue it on something flat and stiff, and take the pictures again"
            )
        problem, fitted = likeliest(problem, beliefs_of(arm, prior, outside))
        measured = Measurements(
            position=problem.position,
            point=problem.tool(fitted.vector)[:, :3, 3],
            sigma=point_sigma(problem.spread),
            posture=problem.posture,
            frame="camera" if self.carried == "board" else "board",
            source="camera",
        )
        return Filmed(
            calibration=judged(problem, fitted, measured, date),
            measurements=measured,
            rig=rig_of(problem, rig, fitted.vector),
            rig_sigma=np.roll(np.sqrt(np.diag(fitted.covariance)[problem.layout.body :]), len(TERMS)),
            residuals=tuple(compress(residuals, good)),
            left_out=(*self.unusable, *doubts.items()),
        )


def positions(shots: tuple[Shot, ...]) -> Array:
    """Positions (V, n) [rad] of shots."""
    return np.array([shot.position for shot in shots])


def write_postures(path: Path, arm: Arm, film: Film) -> None:
    """Write ``postures.csv``."""
    columns = {
        "picture": [shot.name for shot in film.shots],
        "posture": [shot.posture for shot in film.shots],
    }
    angles = np.degrees(positions(film.shots).T)
    table = pa.table(columns | {f"{name}_deg": row for name, row in zip(joint_columns(arm), angles, strict=True)})
    write_whole(path, lambda temporary: pc.write_csv(table, temporary))


def read_folder(pattern: str, arm: Arm, board: Board, carried: str = "board") -> Film:
    """Find ``board`` in the pictures of a folder, or of a pattern such as ``pictures/*.jpg``.

    FileError without pictures or `POSTURES`, InputError for several sizes.
    """
    folder = Path(pattern)
    there = folder.iterdir() if folder.is_dir() else folder.parent.glob(folder.name)
    paths = sorted(path for path in there if path.suffix.lower() in KINDS)
    if not paths:
        remedy = f"give a folder or a pattern of pictures ({', '.join(KINDS)})"
        raise FileError(folder, "holds no pictures" if folder.is_dir() else "no such pictures", remedy)
    position, posture = _postures(paths[0].parent / POSTURES, arm, [path.name for path in paths])
    detector, film = Detector(board), Film(board=board, carried=carried)
    for row, path in enumerate(paths):
        picture, size = read_picture(path), film.size
        seen = BoardView(
            name=path.name,
            number=np.zeros(0, np.int64),
            pixel=np.zeros((0, 2)),
            why="is no picture that OpenCV can read",
        )
        if picture is not None:
            seen, size = detector.find(path.name, picture), picture.shape[::-1]
        film = film.with_shot(Shot(position=position[row], posture=int(posture[row]), seen=seen), size)
    return film


def _postures(path: Path, arm: Arm, pictures: list[str]) -> tuple[Array, Array]:
    """Positions (V, n) [rad] and numbers (V,) of the postures of ``pictures``; FileError."""
    joints = joint_columns(arm)
    remedy = "write one line for each picture"
    meanings = {"picture": None, **dict.fromkeys(joints, ANGLES), "posture": COUNT}
    if not path.exists():
        raise FileError(path, "no such file: the joint positions of each picture are missing", remedy)
    found, lines = read_columns(path, meanings, ["picture", *joints], joints, most=SHEET_MOST)
    position = np.array([found[name] for name in joints]).T
    require_degrees(path, position)
    rows = {Path(word).name: row for row, word in enumerate(found["picture"])}
    if len(rows) < len(lines):
        raise FileError(path, "two lines name the same picture", "leave one line out")
    if without := [name for name in pictures if name not in rows]:
        raise FileError(path, f"no joint positions for {', '.join(without[:3])} ({len(without)} pictures)", remedy)
    order = [rows[name] for name in pictures]
    posture = found.get("posture", np.full(len(lines), np.nan))[order]
    return position[order], np.where(np.isnan(posture), np.arange(1, len(order) + 1), posture)


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
    shown = views
    for _ in range(_ROUNDS):
        corners = [board.corners[view.number].astype(np.float32) for view in shown]
        pixels = [view.pixel.astype(np.float32) for view in shown]
        found = cv2.calibrateCameraExtended(corners, pixels, size, usual.matrix, np.zeros(5), flags=flags)
        matrix, bent, rms = found[1], found[2], found[7][:, 0]
        good = rms <= max(CROOKED * np.median(rms), FLAT)
        if good.all():
            break
        shown = [view for view, fits in zip(shown, good, strict=True) if fits]
    if not _FOCAL[0] < matrix[0, 0] / usual.width < _FOCAL[1]:
        return usual
    return usual.with_numbers(np.array([matrix[0, 0], matrix[0, 2], matrix[1, 2], *np.ravel(bent)[:4]]))


_FAR = 4.0  # times the median distance beyond which a view does not help the first estimate (chosen)
_LEVER = 0.1  # [m] that makes a length of a turn (chosen: the size of a board)
_STRETCH, _ROUGH, _MANY = 0.02, 0.2, 15
"""Relative error of another print, for fewer views, and their number; chosen: worn arms make 0.015, 12 views 0.055"""
_TURNED = np.radians(10.0)
"""[rad] least turn about two directions; chosen"""


def first_rig(arm: Arm, lens: Lens, board: Board, carried: str, position: Array, sights: Array) -> Rig:
    """Find the poses of camera and board by the encoders' ``position`` (V, n) [rad], without outliers.

    ``sights`` (V, 4, 4): board in the camera frame. InputError for too little rotation, or another board.
    """
    tool = tcp_pose(arm, position)
    axes = tool[:, :3, :3] - tool[:, :3, :3].mean(axis=0)
    turns = np.linalg.svd(axes.reshape(len(tool), -1), compute_uv=False) / np.sqrt(len(tool))
    if turns[1] < _TURNED:
        raise InputError(
            "the tool was turned too little between the views to tell where camera and board are; "
            "turn it by 20 degrees and more about at least two directions"
        )
    between = sights if carried == "board" else inverse(sights)
    used = np.ones(len(tool), bool)
    for _ in range(_ROUNDS):
        standing, mounted = _hand_eye(between[used], tool[used])
        rig = Rig(lens=lens, board=board, carried=carried, standing=standing, mounted=mounted)
        shift, turn = np.split(difference(rig.tool(sights), tool), 2, axis=-1)
        off = np.linalg.norm(shift, axis=-1) + _LEVER * np.linalg.norm(turn, axis=-1)
        used = off <= _FAR * np.median(off)
    own = belief(arm, USUAL, block_diag(ANYWHERE**-2.0 * np.eye(POSES), 1.0))
    away = np.pad(sights[:, :3, 3], ((0, 0), (0, 3)))[..., None]  # by which larger squares move a board
    problem = replace(film_problem(own, arm, rig, position, sights), by_lens=away)
    found = solve(problem.rows(used), own.mean)
    larger, drawn = found.vector[-1], 1e3 * board.square
    if abs(larger) > max(_STRETCH if len(tool) >= _MANY else _ROUGH, SURE * np.sqrt(found.covariance[-1, -1])):
        raise InputError(
            "the pictures do not fit the joint positions: the squares of the board seem to measure "
            f"{max(drawn * (1.0 + larger), 0.0):.1f} mm, expected {drawn:.1f}. Either camera or board was shifted "
            "between the pictures: take them again. Or the print has another size: measure its rulers, and describe it "
            "with `rejoint board FILE --measured-x MM --measured-y MM`. Or the joint positions, in degrees, are "
            "those of other pictures, or --board-on is wrong"
        )
    return rig


def _hand_eye(seen: Array, tool: Array) -> tuple[Array, Array]:
    """Poses ``standing`` and ``mounted`` of a rig: A M = F B by linear least squares (Dornaika and Horaud 1998).

    ``seen`` M (V, 4, 4): the carried one in the frame of the standing one; ``tool`` F (V, 4, 4) in the base. OpenCV 5
    lacks `calibrateRobotWorldHandEye`.
    """
    one, turn = np.eye(3), tool[:, :3, :3]
    rows = [np.hstack([np.kron(m.T, one), -np.kron(one, f)]) for m, f in zip(seen[:, :3, :3], turn, strict=True)]
    both = np.linalg.svd(np.vstack(rows), full_matrices=False)[2][-1].reshape(2, 3, 3).mT
    a, b = Rotation.from_matrix(both / np.cbrt(np.linalg.det(both))[:, None, None]).as_matrix()
    left = np.concatenate([np.broadcast_to(one, turn.shape), -turn], axis=2).reshape(-1, 6)
    shift = np.linalg.lstsq(left, (tool[:, :3, 3] - seen[:, :3, 3] @ a.T).ravel(), rcond=None)[0]
    return pose_of(a, shift[:3]), pose_of(b, shift[3:])


JOINT = np.radians(0.1)
"""[rad] unexplained turn of each joint; chosen"""
POSES = 12
"""Unknowns after the arm's, shift [m] and turn [rad] of `Rig.standing` and `Rig.mounted`; the lens follows"""
_ANY = np.array([1e3] * 3 + [1.0] * 4)  # standard deviations of a lens of which nothing is known


def film_problem(own: Belief, arm: Arm, rig: Rig, position: Array, sights: Array) -> ToolProblem:
    """Problem of boards seen at ``sights`` (V, 4, 4), camera frame, without errors of their own or of the lens."""
    return ToolProblem(
        arm=arm,
        belief=own,
        seen=rig.carried_in(sights),
        inverted=rig.carried == "camera",
        by_lens=np.zeros((len(sights), 6, 0)),
        known=np.ones((len(sights), 6), dtype=bool),
        spread=np.zeros((len(sights), 6, 6)),
        position=position,
        posture=np.arange(len(sights)),
        frame=rig.standing,
        mounted=rig.mounted,
        joint=JOINT,
    )


def rig_of(problem: ToolProblem, rig: Rig, vector: Array) -> Rig:
    """Rig for the unknowns (k,), from its first estimate."""
    standing, mounted, lens = problem.outside(vector)
    return replace(rig, standing=standing, mounted=mounted, lens=rig.lens.with_numbers(rig.lens.numbers + lens))


def _lens_ties(lens: Lens, board: Board, views: Sequence[BoardView], sights: Array) -> tuple[Array, Array]:
    """Boards' derivative (V, 6, 7) by the lens, and its precision (7, 7)."""
    ties, told = [], np.diag(_ANY**-2.0)
    for view, pose in zip(views, sights, strict=True):
        _, by_pose, by_terms = lens.slopes(board.corners[view.number], pose)
        ties.append(-np.linalg.lstsq(by_pose, by_terms, rcond=None)[0])
        left = (by_terms + by_pose @ ties[-1]) / CORNER
        told = told + left.T @ left
    return np.array(ties), told


@value_type
class Residual:
    """Residual of one view."""

    name: str
    rms: float
    """[px] per coordinate"""
    away: float
    """[m] of the tool, picture against corrected kinematics"""
    turned: float
    """[rad] the same of its orientation"""


MOST = 0.005
"""Bow over the longer edge of a refused board; chosen: half of the true one"""
SURE = 5.0
"""Standard deviations of a significant bow or stretch; chosen"""


def bow(rig: Rig, views: Sequence[BoardView], sights: Array) -> tuple[float, float]:
    """Board's parabolic bow [m], and its sigma: what poses and lens leave of the corners."""
    board, rows, cluster = rig.board, [], []
    x, y = ((2.0 * board.corners[:, :2] - board.size) / board.size.max()).T
    surface = np.stack([x * x, x * y, y * y], axis=-1)  # bent along x, twisted, bent along y
    for number, (view, pose) in enumerate(zip(views, sights, strict=True)):
        pixel, by_pose, by_terms = rig.lens.slopes(board.corners[view.number], pose)
        by_height = (by_pose[:, :3] @ pose[:3, 2])[:, None] * np.repeat(surface[view.number], 2, axis=0)
        both = np.column_stack([by_terms, by_height, (view.pixel - pixel).ravel()])
        taken, _ = np.linalg.qr(by_pose)
        rows.append(both - taken @ (taken.T @ both))
        cluster += [number] * len(both)
    every = np.concatenate(rows)
    fit = fit_clustered(every[:, :-1], every[:, -1], np.array(cluster))
    heights, shapes = surface @ fit.coefficients[len(TERMS) :], slice(len(TERMS), None)
    ends = surface[np.argmax(heights)] - surface[np.argmin(heights)]
    return float(np.ptp(heights)), float(np.sqrt(ends @ fit.covariance[shapes, shapes] @ ends))


@entity
class Filmed:
    """Result of a fit to an image sequence."""

    calibration: Calibration
    measurements: Measurements
    """the tool in each view used"""
    rig: Rig
    rig_sigma: Array
    """(19,) sigma of the lens's `TERMS`, shift [m] and turn [rad] of camera and board"""
    residuals: tuple[Residual, ...]
    left_out: tuple[tuple[str, str], ...]
    """names of views, and why"""

    @property
    def rms(self) -> float:
        """[px] over all corners, per coordinate."""
        return float(np.sqrt(np.mean([one.rms**2 for one in self.residuals])))

    def write(self, folder: RunFolder) -> None:
        """Write the camera's setup to a run."""
        write_rig(set_aside(folder.camera), self.calibration.arm, self.rig, self.rig_sigma, self.calibration.date)


def _judged(
    problem: ToolProblem, rig: Rig, vector: Array, views: Sequence[BoardView]
) -> tuple[ToolProblem, list[Residual], dict[str, str]]:
    """Choose each view's tilt by the fit; return also residuals, and by name why views do not fit."""
    told = rig_of(problem, rig, vector).sight(
        problem.layout.displacement(vector).tool_pose(problem.arm, problem.position)
    )
    placed = [place(rig.lens, rig.board, view, near) for view, near in zip(views, told, strict=True)]
    problem = replace(problem, seen=rig.carried_in(np.array([one.pose for one in placed])))
    off = np.sqrt((problem.weighed(vector)[1] ** 2).mean(axis=1))
    away, turned = np.linalg.norm(problem.misfit(vector).reshape(-1, 2, 3), axis=2).T
    usual, flat = max(1.0, np.median(off)), np.median([one.rms for one in placed])
    residuals, doubts = [], {}
    for view, one, far, shift, turn in zip(views, placed, off, away.tolist(), turned.tolist(), strict=True):
        residuals.append(Residual(name=view.name, rms=one.rms, away=shift, turned=turn))
        if one.rms > max(CROOKED * flat, FLAT):
            doubts[view.name] = (
                f"its corners lie {one.rms:.1f} px beside those of a flat board, the others {flat:.2f} px: "
                "blurred, moved during the exposure, or the board is bent"
            )
        elif far > ELSEWHERE * usual:
            doubts[view.name] = (
                f"shows the tool {1e3 * shift:.0f} mm and {np.degrees(turn):.0f} deg from where the joint positions "
                "put it: not taken there, swapped with another one, or board or camera was shifted"
            )
    return problem, residuals, doubts
