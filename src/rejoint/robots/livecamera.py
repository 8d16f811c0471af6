"""A camera at this computer: opened with settings that stay as they are, and asked for one still picture at a time."""

from __future__ import annotations

import time
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rejoint.system.errors import InputError
from rejoint.system.extras import require

if TYPE_CHECKING:
    import cv2

SIZE = (1920, 1080)
"""[px] width and height that are asked for"""
PAUSE = 0.4
"""[s] of rest before a picture counts (chosen: an arm has stopped swinging, and the camera's buffer is old)"""
FRAMES = 5
"""Pictures that are averaged into one: noise and ripple of the light fall by half (chosen)"""

_MANUAL = 1.0  # what Video4Linux calls an exposure by hand
_TRIES = 30  # frames that may fail before the camera counts as gone: a second


class LiveCamera:
    """A camera by its number; a context manager, since the device is to be given back.

    Focus, exposure and white balance are held as they are: a lens that focuses anew is another lens.
    """

    def __init__(self, number: int = 0, size: tuple[int, int] = SIZE, exposure: float | None = None) -> None:
        require("a camera", "camera")
        self.number, self.size, self.exposure = number, size, exposure
        self._device: cv2.VideoCapture | None = None

    def __enter__(self) -> LiveCamera:
        """Open the camera; InputError where there is none."""
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give the camera back."""
        if self._device is not None:
            self._device.release()
            self._device = None

    def picture(self) -> tuple[NDArray[np.uint8], float]:
        """Newest grey picture and when it came [s], on the clock of `time.monotonic`; InputError if none comes."""
        import cv2

        if self._device is None:
            raise InputError("the camera is not open; use it in a with statement")
        for _ in range(_TRIES):
            good, frame = self._device.read()
            if good:
                return cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), time.monotonic()
        raise InputError(f"camera {self.number} gives no pictures any more; check its cable")

    def still(self, number: int = 0) -> NDArray[np.uint8]:  # noqa: ARG002 - every picture is another one
        """Mean of a few pictures after a rest, for an arm that stands still."""
        until = time.monotonic() + PAUSE
        while self.picture()[1] < until:
            pass
        frames = np.array([self.picture()[0] for _ in range(FRAMES)], dtype=np.float32)
        return np.rint(frames.mean(axis=0)).astype(np.uint8)
