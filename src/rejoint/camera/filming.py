"""Taking an image sequence: the first pictures locate the camera, which decides the other postures."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import ClassVar, Protocol

import cv2
import numpy as np

from rejoint.arms import Arm, Array, collides, heights, tcp_pose, tcp_position
from rejoint.camera.board import Board, BoardView, Detector, Picture
from rejoint.camera.film import (
    POSES,
    POSTURES,
    USUAL,
    Film,
    Shot,
    UnseenBoardError,
    film_problem,
    read_folder,
    write_postures,
)
from rejoint.camera.rig import Rig
from rejoint.camera.tracker import LiveCamera
from rejoint.control.robot import Robot
from rejoint.control.seeing import simulated
from rejoint.diagnosis.calibration.calibration import DisplacementLayout, belief
from rejoint.diagnosis.calibration.procedure import BEFORE, StandingDrive, kept, log_resumed, narrowed
from rejoint.logs.runfolder import RunFolder
from rejoint.system.errors import InputError
from rejoint.system.files import set_aside, write_bytes
from rejoint.system.progress import Progress
from rejoint.system.records import entity
from rejoint.system.stopping import check

CANDIDATES = 240
"""Postures to choose from; chosen"""
SPREAD = np.radians(40.0)
"""[rad] of joints about rest; chosen"""
SCOUTING = {"board": np.radians(20.0), "camera": np.radians(12.0)}
"""[rad] the same before the camera is located; chosen"""
_DRAWS, _TRIES = 4000, 25  # at a time, and how often
_ROOM = np.radians(5.0)  # from the joint limits
_AROUND = 0.04  # [m] around the region of targets in which the tool stays (chosen)
_LOOK = 1.0  # [m] and [rad] of camera and board around where they are believed to be


def choose_postures(arm: Arm, rig: Rig, count: int) -> Array:
    """Choose ``count`` postures (count, n) [rad] in which ``rig`` shows the board: D-optimal.

    InputError for too few views.
    """
    candidates = seen_postures(arm, rig, max(CANDIDATES, 2 * count))
    if len(candidates) < count:
        raise InputError(
            f"the camera sees the board in {len(candidates)} of {_TRIES * _DRAWS} postures around the rest posture, "
            f"expected at least {count}; turn the camera to the tool, or the board to the camera"
        )
    own = belief(arm, USUAL, _LOOK**-2.0 * np.eye(POSES))
    expected = DisplacementLayout(arm).displacement(own.mean).tool_pose(arm, candidates)
    problem = film_problem(own, arm, rig, candidates, rig.sight(expected))
    slope = problem.weighed(own.mean)[0] @ problem.slope(own.mean)
    spread = np.linalg.inv(own.precision).astype(float)
    chosen: list[int] = []
    for _ in range(count):
        gain = np.linalg.slogdet(np.eye(6) + slope @ spread @ slope.mT)[1]
        gain[chosen] = -np.inf
        chosen.append(int(np.argmax(gain)))
        spread = narrowed(spread, slope[chosen[-1]], np.eye(6))
    return candidates[chosen]


def scouting_postures(arm: Arm, carried: str) -> Array:
    """Choose `SCOUTS` postures (s, n) [rad] about rest, far apart."""
    drawn = seen_postures(arm, None, CANDIDATES, spread=SCOUTING[carried])
    if len(drawn) < SCOUTS:
        raise InputError(
            f"arm {arm.name}: {len(drawn)} postures about the rest posture are free of floor, limits and collisions, "
            f"expected at least {SCOUTS}; give the arm another rest posture"
        )
    chosen = [arm.rest]
    while len(chosen) < SCOUTS:
        apart = np.linalg.norm(drawn[:, None] - np.array(chosen), axis=-1).min(axis=1)
        chosen.append(drawn[np.argmax(apart)])
    return np.array(chosen)


def seen_postures(arm: Arm, rig: Rig | None, count: int, *, spread: float = SPREAD) -> Array:
    """Draw up to ``count`` postures (C, n) [rad] about rest that a ``rig`` shows, with room around (`BEFORE`)."""
    rng, room = np.random.default_rng(0), _ROOM + BEFORE
    low, high = np.maximum(arm.lower + room, arm.rest - spread), np.minimum(arm.upper - room, arm.rest + spread)
    found = np.zeros((0, arm.joints))
    for _ in range(_TRIES):
        if len(found) >= count:
            break
        drawn = rng.uniform(low, high, (_DRAWS, arm.joints))
        tool = tcp_position(arm, drawn)
        drawn = drawn[((tool > arm.targets.lower - _AROUND) & (tool < arm.targets.upper + _AROUND)).all(axis=-1)]
        drawn = drawn if rig is None else drawn[rig.shows(tcp_pose(arm, drawn))]
        for away in (0.0, BEFORE, -BEFORE):
            drawn = drawn[heights(arm, drawn - away)[:, 1:].min(axis=-1) > arm.floor]
            drawn = drawn[~collides(arm, drawn - away)]
        found = np.concatenate([found, drawn])
    return found[:count]


SCOUTS = 12
"""Pictures about the rest posture; chosen"""
FEWEST_SCOUTS = 6
"""Those that must show the board; chosen: three locate the camera"""
CHOSEN = 14
"""Postures chosen then, each from two sides; chosen"""


class StillCamera(Protocol):
    """A camera beside a stationary arm."""

    def still(self, number: int) -> Picture:
        """Take picture ``number``, grey (height, width); InputError without an answer."""


@entity
class CameraGauge:
    """A camera as measuring device."""

    camera: Callable[[Robot], AbstractContextManager[StillCamera]]
    board: Board
    carried: str = "board"
    """by the tool: ``board`` or ``camera``"""
    postures: int = CHOSEN
    """after those about rest"""
    show: Callable[[Picture, BoardView], object] = lambda *_: None
    """receives each picture, and what is seen in it"""
    scouts: ClassVar[int] = SCOUTS
    """pictures about rest"""

    def film(
        self,
        drive: StandingDrive,
        folder: RunFolder | None,
        count: int,
        visits: int,
        on_progress: Progress,
        *,
        fresh: bool = False,
    ) -> Film:
        """Take the pictures about rest, then ``count`` postures from ``visits`` sides each.

        A run ``folder`` keeps each; resumes unless ``fresh``. InputError if the board is hardly visible; errors of
        `rejoint.control.loop.run`.
        """
        pictures, total = None if folder is None else folder.pictures, SCOUTS + count * visits
        film = Film(board=self.board, carried=self.carried)
        if folder is not None and pictures is not None and not fresh and _unfitted(folder):
            film = read_folder(str(pictures), drive.robot.arm, self.board, self.carried)
            log_resumed(pictures / POSTURES, f"{len(film.usable)} pictures are there")
        arm, detector = drive.robot.arm, Detector(self.board)
        with kept(lambda: pictures if film.shots else None, fresh=fresh), self.camera(drive.robot) as camera:

            def shoot(number: int, posture: Array, place: int) -> None:
                nonlocal film
                name = f"view-{number:03}.png"
                if any(shot.name == name for shot in film.usable):
                    return
                on_progress((number - 1) / total, f"picture {number} of {total}")
                position = drive.stand(posture, number - 1)
                picture = camera.still(number)
                check()
                seen = detector.find(name, picture)
                self.show(picture, seen)
                shot = Shot(position=position, posture=place, seen=seen)
                film = film.with_shot(shot, picture.shape[::-1])
                if pictures is not None:
                    if len(film.shots) == 1:
                        set_aside(pictures)
                    write_postures(pictures / POSTURES, arm, film)
                    write_bytes(pictures / name, cv2.imencode(".png", picture)[1].tobytes())
                if number == 1 and seen.why:
                    raise UnseenBoardError(
                        f"camera: in the rest posture, where the arm stands now, {seen.why}; let the camera see all of "
                        "the board there, and begin again"
                    )

            try:
                for place, posture in enumerate(scouting_postures(arm, self.carried)):
                    shoot(place + 1, posture, place)
                scouted = replace(film, shots=film.shots[:SCOUTS])
                for place, posture in enumerate(choose_postures(arm, scouted.located(arm, FEWEST_SCOUTS)[0], count)):
                    for visit in range(visits):
                        shoot(SCOUTS + 1 + place * visits + visit, posture, SCOUTS + place)
                drive.rest()
            except UnseenBoardError:  # camera or board will be moved, so nothing of this belongs to what comes
                if pictures is not None:
                    set_aside(pictures)
                raise
        return film


def _unfitted(folder: RunFolder) -> bool:
    """Whether there are pictures that came after the last fit."""
    postures, fitted = folder.pictures / POSTURES, folder.camera
    begun = postures.exists() and any(folder.pictures.glob("view-*.png"))
    return begun and not (fitted.exists() and fitted.stat().st_mtime > postures.stat().st_mtime)


def camera_gauge(number: int | None, board: Board, *, carried: str = "board", seed: int = 0) -> CameraGauge:
    """Gauge of the camera of this ``number``, or None: of an emulated arm's."""

    def camera(robot: Robot) -> AbstractContextManager[StillCamera]:
        return nullcontext(simulated(robot).camera(board, carried, seed)) if number is None else LiveCamera(number)

    return CameraGauge(camera=camera, board=board, carried=carried)
