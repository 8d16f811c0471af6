"""Cameras of this computer, and those that a simulated robot brings."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rejoint.arms.camera.board import Board
from rejoint.control.robot import Robot, part_of
from rejoint.control.seeing import Eye
from rejoint.system.errors import InputError
from rejoint.system.extras import require

if TYPE_CHECKING:
    import cv2

SIZE = (1920, 1080)
"""[px] wanted width and height"""
PAUSE = 0.4
"""[s] at rest before an image (chosen)"""
FRAMES = 5
"""Averaged images (chosen: halves noise and flicker)"""

Picture: TypeAlias = "NDArray[np.uint8]"
"""(height, width) grey"""

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
        wanted: dict[str, float] = {
            "FOURCC": cv2.VideoWriter.fourcc(*"MJPG"),
            "FRAME_WIDTH": self.size[0],
            "FRAME_HEIGHT": self.size[1],
        }
        wanted |= {"AUTOFOCUS": 0, "AUTO_WB": 0}
        if self.exposure is not None:
            wanted |= {"AUTO_EXPOSURE": _MANUAL, "EXPOSURE": self.exposure}
        for name, value in wanted.items():
            device.set(getattr(cv2, f"CAP_PROP_{name}"), value)
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


class StillCamera(Protocol):
    """A camera beside a stationary arm."""

    def still(self, number: int) -> Picture:
        """Take picture ``number``; InputError without an answer."""


@runtime_checkable
class Simulated(Protocol):
    """A simulated robot, which brings the cameras that see it."""

    def eye(self, seed: int) -> Eye:
        """Detector of the tool; noise by ``seed``."""

    def camera(self, board: Board, carried: str, seed: int) -> StillCamera:
        """Camera that sees the ``board``; the tool has ``carried``, which is ``board`` or ``camera``."""


def simulated(robot: Robot) -> Simulated:
    """Return the robot that brings its cameras; InputError without."""
    found = part_of(robot, Simulated)
    if found is None:
        raise InputError(
            f"camera emulated: it sees one arm that is emulated in this process, not {robot.address}; give the number "
            "of a camera, or emulated:WEAR as the robot"
        )
    return found
