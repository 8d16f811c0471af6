"""Cameras: of this computer, rendered, and an emulated detector."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rejoint.system.errors import InputError
from rejoint.system.extras import require

if TYPE_CHECKING:
    import cv2
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field

from rejoint.arms import Array
from rejoint.arms.camera.board import Board
from rejoint.control.robot import Robot, part_of
from rejoint.control.seeing import Sighting
from rejoint.robots.emulated import EmulatedRobot
from rejoint.robots.lab.camera.scene import Picture, Scene, beside, on_tool

SIZE = (1920, 1080)
"""[px] wanted width and height"""
PAUSE = 0.4
"""[s] at rest before an image (chosen)"""
FRAMES = 5
"""Averaged images (chosen: halves noise and flicker)"""

_MANUAL = 1.0  # what Video4Linux calls an exposure by hand
_TRIES = 30  # frames that may fail before the camera counts as gone: a second


class LiveCamera:
    """A camera by its number, as a context manager; its settings stay."""

    def __init__(self, number: int = 0, size: tuple[int, int] = SIZE, exposure: float | None = None) -> None:
        require("a camera", "camera")
        self.number, self.size, self.exposure = number, size, exposure
        self._device: cv2.VideoCapture | None = None

    def __enter__(self) -> LiveCamera:
        """Open the camera; InputError."""
        import cv2

        device = cv2.VideoCapture(self.number)
        if not device.isOpened():
            device.release()
            raise InputError(f"no camera answers as number {self.number}; plug it in, or give another number")
        device.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
        device.set(cv2.CAP_PROP_FRAME_WIDTH, self.size[0])
        device.set(cv2.CAP_PROP_FRAME_HEIGHT, self.size[1])
        device.set(cv2.CAP_PROP_AUTOFOCUS, 0.0)
        device.set(cv2.CAP_PROP_AUTO_WB, 0.0)
        if self.exposure is not None:
            device.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL)
            device.set(cv2.CAP_PROP_EXPOSURE, self.exposure)
        self._device = device
        return self

    def __exit__(self, *_: object) -> None:
        """Release the camera."""
        if self._device is not None:
            self._device.release()
            self._device = None

    def picture(self) -> tuple[NDArray[np.uint8], float]:
        """Newest grey image and its time [s] of `time.monotonic`; InputError."""
        import cv2

        if self._device is None:
            raise InputError("the camera is not open; use it in a with statement")
        for _ in range(_TRIES):
            good, frame = self._device.read()
            if good:
                return cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), time.monotonic()
        raise InputError(f"camera {self.number} gives no pictures any more; check its cable")

    def still(self, number: int = 0) -> NDArray[np.uint8]:  # noqa: ARG002 - every picture is another one
        """Mean of a few images after a rest."""
        until = time.monotonic() + PAUSE
        while self.picture()[1] < until:
            pass
        frames = np.array([self.picture()[0] for _ in range(FRAMES)], dtype=np.float32)
        return np.rint(frames.mean(axis=0)).astype(np.uint8)


class EmulatedCamera:
    """Rendered images; noise by seed and number."""

    def __init__(self, scene: Scene, tool: Callable[[], Array], seed: int = 0) -> None:
        """``tool`` returns the tool's pose (4, 4) in the base."""
        self.scene, self._tool, self._seed = scene, tool, seed

    def still(self, number: int) -> Picture:
        """Render image ``number``."""
        return self.scene.shows(self._tool(), (self._seed, number))


def watching(board: Board, carried: str, seed: int) -> Callable[[Robot], AbstractContextManager[EmulatedCamera]]:
    """Return what opens a camera beside an emulated arm, or on its tool."""

    def opened(robot: Robot) -> AbstractContextManager[EmulatedCamera]:
        arm = robot.arm
        scene = beside(arm, board=board) if carried == "board" else on_tool(arm, board=board)
        emulated = part_of(robot, EmulatedRobot)
        if emulated is None:
            raise InputError(
                f"camera emulated: {robot.address} is not emulated in this process; give the number of a camera"
            )
        return nullcontext(EmulatedCamera(scene, lambda: emulated.plant.true_pose()[0], seed))

    return opened


LATERAL, DEPTH = 1e-4, 5e-4
"""[m] deviations of a detection across and along the line of sight (chosen)"""


@dataclass(eq=False)
class EmulatedEye:
    """Detects the tool of one emulated arm."""

    robot: Robot
    rate: float = 15.0
    """[1/s] images (chosen)"""
    late: float = 0.1
    """[s] from image to detection (chosen)"""
    sight: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """line of sight in the base frame"""
    lateral: float = LATERAL
    depth: float = DEPTH
    hidden: tuple[tuple[float, float], ...] = ()
    """(from, to) [s] robot time of a hidden tool"""
    seed: int = 0
    _taken: deque[Sighting] = field(default_factory=lambda: deque(maxlen=64), init=False)
    _next: float = field(default=-np.inf, init=False)  # [s] when the next picture is due

    def __post_init__(self) -> None:
        if self.robot.count != 1 or not np.isfinite(self.robot.true_tcp()).all():
            raise InputError(
                f"camera emulated: it sees one arm that is emulated in this process, not {self.robot.address}; give "
                "emulated:WEAR as the robot"
            )
        if not (self.rate > 0.0 and self.late >= 0.0):
            raise InputError(f"camera emulated: expected a positive rate, got {self.rate} 1/s and {self.late} s")
        self._rng = np.random.default_rng(self.seed)
        along = np.array(self.sight) / np.linalg.norm(self.sight)
        self._noise: Array = self.lateral * np.eye(3) + (self.depth - self.lateral) * np.outer(along, along)

    def sighting(self, now: float) -> Sighting | None:
        """Newest detection at robot time ``now`` [s], or None."""
        if now >= self._next:
            due = self._next if now - self._next < 1.0 / self.rate else now  # pictures that were not taken are lost
            self._next = due + 1.0 / self.rate
            if not any(start <= now < end for start, end in self.hidden):
                place = self.robot.true_tcp()[0] + self._noise @ self._rng.normal(size=3)
                self._taken.append(Sighting(time=now, place=place))
        ready = [one for one in self._taken if one.time <= now - self.late]
        return ready[-1] if ready else None
