"""Taking an image sequence: the first pictures locate the camera, which decides the other postures."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, collides, heights, tcp_pose, tcp_position
from rejoint.arms.camera.board import Board
from rejoint.arms.camera.lens import TERMS
from rejoint.arms.camera.rig import Rig
from rejoint.arms.camera.views import Detector, Unusable
from rejoint.control.guard import GuardLimits
from rejoint.control.robot import Robot
from rejoint.control.start import Stance
from rejoint.diagnosis.calibration.camera.bundle import USUAL
from rejoint.diagnosis.calibration.camera.film import Film, Shot, positions
from rejoint.diagnosis.calibration.camera.starting import first_lens, first_rig, first_sights
from rejoint.diagnosis.calibration.camera.ties import TieProblem, with_poses
from rejoint.diagnosis.calibration.parameters import DisplacementLayout, belief, displacement_of
from rejoint.diagnosis.calibration.postures import BEFORE, narrowed
from rejoint.diagnosis.calibration.procedure import StandingDrive
from rejoint.system.errors import InputError
from rejoint.system.progress import Progress, no_progress
from rejoint.system.stopping import check

CANDIDATES = 240
"""Postures to choose from; chosen"""
SPREAD = np.radians(40.0)
"""[rad] of joints about rest; chosen"""
SCOUTING = {"board": np.radians(20.0), "camera": np.radians(12.0)}
"""[rad] the same before the camera is located; chosen"""
_DRAWS = 4000  # at a time
_TRIES = 25  # of so many draws
_ROOM = np.radians(5.0)  # from the joint limits
_AROUND = 0.04  # [m] around the region of targets in which the tool stays (chosen)
_LOOK = 1.0  # [m] and [rad] of camera and board around where they are believed to be


def choose_postures(arm: Arm, rig: Rig, count: int, seed: int = 0, before: float = 0.0) -> Array:
    """Choose ``count`` postures (count, n) [rad] in which ``rig`` shows the board, approached from ``before`` [rad].

    D-optimal: the poses of camera and board count too. InputError for too few views.
    """
    candidates = seen_postures(arm, rig, max(CANDIDATES, 2 * count), seed, before=before)
    if len(candidates) < count:
        raise InputError(
            f"the camera sees the board in {len(candidates)} of {_TRIES * _DRAWS} postures around the rest posture, "
            f"expected at least {count}; turn the camera to the tool, or the board to the camera"
        )
    layout = DisplacementLayout(joints=arm.joints)
    believed = belief(arm, layout, USUAL)
    displacement = displacement_of(layout, believed.mean)
    problem = TieProblem(
        arm=arm,
        layout=layout,
        belief=with_poses(believed, np.eye(len(TERMS))),
        rig=rig,
        position=candidates,
        posture=np.arange(len(candidates)),
        sights=rig.sight(displacement.tool_pose(arm, candidates)),
        approach=np.full_like(candidates, np.nan),
        spread=np.zeros((len(candidates), 6, 6)),
        by_lens=np.zeros((len(candidates), 6, len(TERMS))),
    )
    slope = problem.whitener(problem.belief.mean) @ problem.residual(problem.belief.mean)[1][..., : -len(TERMS)]
    spread = np.diag(np.concatenate([1.0 / np.diag(believed.precision), np.full(12, _LOOK**2)]))
    chosen: list[int] = []
    for _ in range(count):
        gain = np.linalg.slogdet(np.eye(6) + slope @ spread @ np.swapaxes(slope, -1, -2))[1]
        gain[chosen] = -np.inf
        chosen.append(int(np.argmax(gain)))
        spread = narrowed(spread, slope[chosen[-1]], np.eye(6))
    return candidates[chosen]


def scouting_postures(arm: Arm, carried: str, count: int, before: float) -> Array:
    """Choose postures (count, n) [rad] about rest, far apart."""
    drawn = seen_postures(arm, None, CANDIDATES, 0, spread=SCOUTING[carried], before=before)
    if len(drawn) < count:
        raise InputError(
            f"arm {arm.name}: {len(drawn)} postures about the rest posture are free of floor, limits and collisions, "
            f"expected at least {count}; give the arm another rest posture"
        )
    chosen = [arm.rest]
    while len(chosen) < count:
        apart = np.linalg.norm(drawn[:, None] - np.array(chosen), axis=-1).min(axis=1)
        chosen.append(drawn[int(np.argmax(apart))])
    return np.array(chosen)


def seen_postures(
    arm: Arm, rig: Rig | None, count: int, seed: int, *, spread: float = SPREAD, before: float = 0.0
) -> Array:
    """Draw up to ``count`` free postures (C, n) [rad] about rest that a ``rig`` shows."""
    rng, room = np.random.default_rng(seed), _ROOM + before
    low, high = np.maximum(arm.lower + room, arm.rest - spread), np.minimum(arm.upper - room, arm.rest + spread)
    found, enough = [np.zeros((0, arm.joints))], 0
    for _ in range(_TRIES):
        drawn = rng.uniform(low, high, (_DRAWS, arm.joints))
        tool = tcp_position(arm, drawn)
        near = ((tool > arm.targets.lower - _AROUND) & (tool < arm.targets.upper + _AROUND)).all(axis=-1)
        drawn = drawn[near & (heights(arm, drawn)[:, 1:].min(axis=-1) > arm.floor)]
        drawn = drawn if rig is None else drawn[rig.shows(tcp_pose(arm, drawn))]
        for away in (0.0, before, -before) if before else (0.0,):
            drawn = drawn[(heights(arm, drawn - away)[:, 1:].min(axis=-1) > arm.floor)]
            drawn = drawn[~collides(arm, drawn - away)]
        found.append(drawn)
        enough += len(drawn)
        if enough >= count:
            break
    return np.concatenate(found)[:count]


SCOUTS = 12
"""Pictures about the rest posture; chosen"""
FEWEST_SCOUTS = 6
"""Those that must show the board; chosen: three locate the camera"""
POSTURES = 14
"""Postures chosen then, each from two sides; chosen"""

Picture = NDArray[np.uint8]
OnShot = Callable[[Film, str, Picture], object]
"""Called after each picture; the text is its name"""


class StillCamera(Protocol):
    """A camera beside a stationary arm."""

    def still(self, number: int) -> Picture:
        """Take picture ``number``, grey (height, width); InputError without an answer."""


class UnseenBoardError(InputError):
    """The board is not visible; move camera or board."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraGauge:
    """A camera as measuring device."""

    camera: Callable[[Robot], AbstractContextManager[StillCamera]]
    board: Board
    carried: str = "board"
    """by the tool: ``board`` or ``camera``"""


@dataclass(kw_only=True, eq=False)
class FilmDrive:
    """Takes or resumes the image sequence of one arm."""

    robot: Robot
    camera: StillCamera
    film: Film
    limits: GuardLimits | None = None
    stance: Stance | None = None
    on_shot: OnShot | None = None
    on_progress: Progress = no_progress

    def take(self, count: int = POSTURES, visits: int = 2) -> Film:
        """Take the pictures about rest, then ``count`` postures from ``visits`` sides each.

        InputError if the board is hardly visible; errors of `rejoint.control.loop.run`.
        """
        arm, total = self._arm, SCOUTS + count * visits
        for number, posture in enumerate(scouting_postures(arm, self.film.carried, SCOUTS, BEFORE), start=1):
            self._shoot(number, total, posture, number - 1)
        rig = believed_rig(arm, self.film.numbered(1, SCOUTS))
        chosen = np.repeat(choose_postures(arm, rig, count, before=BEFORE), visits, axis=0)
        for row, posture in enumerate(chosen):
            self._shoot(SCOUTS + 1 + row, total, posture, SCOUTS + row // visits)
        if "_drive" in self.__dict__:
            self._drive.rest()
        return self.film

    @property
    def _arm(self) -> Arm:
        return self.robot.arm

    @cached_property
    def _drive(self) -> StandingDrive:
        return StandingDrive(self.robot, self.limits, self.stance)

    @cached_property
    def _detector(self) -> Detector:
        return Detector(self.film.board)

    def _shoot(self, number: int, total: int, posture: Array, place: int) -> None:
        if any(shot.number == number for shot in self.film.shots):
            return
        self.on_progress((number - 1) / total, f"picture {number} of {total}")
        side = 1 if number % 2 else -1
        position, approach = self._drive.stand(posture, posture - BEFORE * side)
        picture = self.camera.still(number)
        check()
        seen = self._detector.find(f"view-{number:03}.jpg", picture)
        shot = Shot(number=number, position=position, approach=approach, posture=place, side=side, seen=seen)
        self.film = self.film.with_shot(shot, (int(picture.shape[1]), int(picture.shape[0])))
        if self.on_shot is not None:
            self.on_shot(self.film, seen.name, picture)
        if number == 1 and isinstance(seen, Unusable):
            raise UnseenBoardError(
                f"camera: in the rest posture, where the arm stands now, {seen.why}; let the camera see all of "
                "the board there, and begin again"
            )


def believed_rig(arm: Arm, scouted: Film) -> Rig:
    """Locate camera and board by pictures about rest; InputError on failure."""
    shots = scouted.usable
    if len(shots) < FEWEST_SCOUTS or scouted.size is None:
        raise UnseenBoardError(
            f"camera: the board is seen well in {len(shots)} of the {len(scouted)} pictures about the rest posture, "
            f"expected at least {FEWEST_SCOUTS}; turn camera and board to each other, hold the camera "
            "still, focus it, add light, or put it farther away"
        )
    lens = first_lens(scouted.size, scouted.board, scouted.views)
    sights = first_sights(lens, scouted.board, scouted.views)
    return first_rig(arm, lens, scouted.board, scouted.carried, positions(shots, arm)[0], sights)
