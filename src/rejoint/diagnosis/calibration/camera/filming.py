"""Taking a film: the arm goes from posture to posture, and a picture is taken in each.

Nobody knows beforehand where the camera stands. So the arm first goes to some postures about its rest posture; what the
pictures show there tells where camera and board are, well enough to choose the others, in which the board is seen and
which tell most. What is taken is kept picture by picture, and an interrupted film goes on where it was.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array
from rejoint.arms.camera.board import Board
from rejoint.arms.camera.lens import Lens
from rejoint.arms.camera.rig import Rig
from rejoint.arms.camera.views import Detector, Unusable
from rejoint.control.guard import GuardLimits
from rejoint.control.robot import Robot
from rejoint.control.start import Stance
from rejoint.diagnosis.calibration.camera.adjustment import Tip
from rejoint.diagnosis.calibration.camera.choosing import choose_postures, scouting_postures
from rejoint.diagnosis.calibration.camera.film import Film, Shot, positions
from rejoint.diagnosis.calibration.camera.starting import first_lens, first_rig, first_sights
from rejoint.diagnosis.calibration.postures import BEFORE
from rejoint.diagnosis.calibration.procedure import StandingDrive
from rejoint.system.errors import InputError
from rejoint.system.progress import Progress, no_progress
from rejoint.system.stopping import check

SCOUTS = 12
"""Pictures about the rest posture, by which the others are chosen (chosen: they count as all others do)"""
FEWEST_SCOUTS = 6
"""of which so many must show the board (chosen: three tell where the camera is, and some may be wrong)"""
POSTURES = 14
"""Postures that are chosen then, each from two sides (chosen: 40 pictures with the first ones)"""

Picture = NDArray[np.uint8]
OnShot = Callable[[Film, str, Picture], object]
"""Called after each picture with the film so far, the picture's name and the picture, so that they can be kept"""


class StillCamera(Protocol):
    """Takes pictures of what stands still."""

    def still(self, number: int) -> Picture:
        """Take picture ``number`` of a film, grey (height, width); InputError where the camera does not answer."""


class UnseenBoardError(InputError):
    """The board is not seen where it has to be, so that camera or board are to be moved."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraGauge:
    """Sees a board: a gauge for `rejoint.calibrate` that needs no ruler."""

    camera: Callable[[Robot], AbstractContextManager[StillCamera]]
    """opens the camera for an open robot"""
    board: Board
    carried: str = "board"
    """what the tool carries: ``board`` or ``camera``"""
    tip: Tip | None = None
    """where the tool's tip is on the board that it carries, if somebody measured it"""


@dataclass(kw_only=True, eq=False)
class FilmDrive:
    """Takes the film of one arm; what ``film`` holds already is not taken again."""

    robot: Robot
    camera: StillCamera
    film: Film
    limits: GuardLimits | None = None
    stance: Stance | None = None
    on_shot: OnShot | None = None
    on_progress: Progress = no_progress

    def take(self, count: int = POSTURES, visits: int = 2) -> Film:
        """Take the pictures about the rest posture, then those of ``count`` postures from ``visits`` sides each.

        InputError where the board is not seen at rest, or hardly anywhere; what `rejoint.control.loop.run` raises
        where the motion had to be ended.
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
        """Begin to move; nothing moves where all pictures are there."""
        return StandingDrive(self.robot, self.limits, self.stance)

    @cached_property
    def _detector(self) -> Detector:
        return Detector(self.film.board)

    def _shoot(self, number: int, total: int, posture: Array, place: int) -> None:
        """Take one picture, unless it is there."""
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
    """Where camera and board are, by pictures about the rest posture and the encoders; InputError where they fail."""
    shots = scouted.usable
    if len(shots) < FEWEST_SCOUTS or scouted.size is None:
        raise UnseenBoardError(
            f"camera: the board is seen well in {len(shots)} of the {len(scouted)} pictures about the rest posture, "
            f"expected at least {FEWEST_SCOUTS}; {_remedy(scouted)}"
        )
    lens = first_lens(Lens.usual(*scouted.size), scouted.board, scouted.views)
    sights = first_sights(lens, scouted.board, scouted.views)
    return first_rig(arm, lens, scouted.board, scouted.carried, positions(shots, arm)[0], sights)


def _remedy(scouted: Film) -> str:
    """Say what to do about pictures that are of no use, by what most of them have in common."""
    whys = [one.why for one in scouted.unusable]
    if sum(why.startswith("blurred") for why in whys) > len(whys) / 2:
        return "hold the camera still, focus it, add light"
    return "turn camera and board to each other, or put the camera farther away"
