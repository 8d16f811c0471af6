"""A camera of this computer: still pictures, and where it sees the tool while the arm moves."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from rejoint.arms import Arm
from rejoint.camera.board import BoardView, Detector, Picture
from rejoint.camera.rig import Rig, place, point_sigma, read_rig
from rejoint.control.seeing import Sighting
from rejoint.system.errors import LOGGER, InputError, RejointError

SIZE = (1920, 1080)
"""[px] wanted width and height"""
PAUSE = 0.4
"""[s] at rest before an image (chosen)"""
FRAMES = 5
"""Averaged images (chosen: halves noise and flicker)"""

_TRIES = 30  # frames that may fail before the camera counts as gone: a second


@dataclass(eq=False)
class LiveCamera:
    """A camera by its number, as a context manager; its settings stay."""

    number: int
    size: tuple[int, int] = SIZE

    def __enter__(self) -> LiveCamera:
        """Open the camera; InputError."""
        self._device = device = cv2.VideoCapture(self.number)
        if not device.isOpened():
            raise InputError(f"no camera answers as number {self.number}; plug it in, or give another number")
        wanted = {
            "FOURCC": cv2.VideoWriter.fourcc(*"MJPG"),
            "FRAME_WIDTH": self.size[0],
            "FRAME_HEIGHT": self.size[1],
            "AUTOFOCUS": 0,
            "AUTO_WB": 0,
        }
        for name, value in wanted.items():
            device.set(getattr(cv2, f"CAP_PROP_{name}"), value)
        return self

    def __exit__(self, *_: object) -> None:
        """Release the camera."""
        self._device.release()

    def picture(self) -> tuple[Picture, float]:
        """Newest grey image and its time [s] of `time.monotonic`; InputError."""
        for _ in range(_TRIES):
            good, frame = self._device.read()
            if good:
                return np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), np.uint8), time.monotonic()
        raise InputError(f"camera {self.number} gives no pictures any more; check its cable")

    def still(self, number: int) -> Picture:  # noqa: ARG002 - every picture is another one
        """Mean of a few images after a rest."""
        until = time.monotonic() + PAUSE
        while self.picture()[1] < until:
            pass
        frames = np.array([self.picture()[0] for _ in range(FRAMES)], dtype=np.float32)
        return np.rint(frames.mean(axis=0)).astype(np.uint8)


CROOKED = 1.0
"""[px] corner residual of an untrusted picture; chosen"""


def sighting(rig: Rig, view: BoardView, time: float) -> Sighting | str:
    """Locate the tool in a ``view`` of the board, or say why it cannot be."""
    if view.why:
        return view.why
    placed = place(rig.lens, rig.board, view)
    if placed.rms > CROOKED:
        return f"its corners lie {placed.rms:.1f} px beside those of a flat board"
    sigma = float(point_sigma(rig.spread(placed.pose, placed.covariance)))
    return Sighting(place=rig.tool(placed.pose)[:3, 3], sigma=sigma, time=time)


LATE = 0.05
"""[s] from exposure to picture (chosen)"""
FROZEN = 10
"""Equal pictures after which a camera hangs (chosen)"""


class LiveEye:
    """Looks at the pictures of an open camera in a thread of its own."""

    def __init__(self, camera: LiveCamera, rig: Rig) -> None:
        self.name = f"camera {camera.number}"
        self.why = ""
        """why the last picture was unusable, or empty"""
        self._camera, self._rig, self._detector = camera, rig, Detector(rig.board)
        self._newest: Sighting | None = None
        self._gone = False
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._watch, name=self.name, daemon=True)

    def __enter__(self) -> LiveEye:
        """Begin; InputError for pictures of another size than calibrated."""
        size, calibrated = self._camera.picture()[0].shape[::-1], self._rig.lens.size
        if size != calibrated:
            raise InputError(
                f"{self.name} gives pictures of {size[0]} x {size[1]} px, it was calibrated with {calibrated[0]} x "
                f"{calibrated[1]}; take that camera, or calibrate with this one"
            )
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End; warn where nothing was seen, or the camera is gone."""
        self._end.set()
        self._thread.join()
        if self.why and (self._newest is None or self._gone):
            LOGGER.warning("%s: %s; the arm was driven by its calibration alone from then on", self.name, self.why)

    def sighting(self, now: float) -> Sighting | None:
        """Newest detection on the robot's clock, ``now`` [s], or None."""
        newest = self._newest
        return None if newest is None else replace(newest, time=newest.time + (now - time.monotonic()))

    def _watch(self) -> None:
        last, alike = np.zeros(0, np.uint8), 0
        while not self._end.is_set():
            try:
                picture, came = self._camera.picture()
            except RejointError as error:
                self.why, self._gone = str(error), True
                return
            last, alike = picture, alike + 1 if np.array_equal(picture, last) else 0
            self._gone = alike >= FROZEN
            if alike:  # no news: it would tell that the tool stays where it was, whatever the arm does
                self.why = "gives the same picture for ever; plug it in again" if self._gone else self.why
                continue
            seen = sighting(self._rig, self._detector.find("picture", picture), came - LATE)
            self._newest, self.why = (self._newest, seen) if isinstance(seen, str) else (seen, "")


@contextmanager
def opened_camera(number: int, rig: Path | None, arm: Arm) -> Iterator[LiveEye]:
    """Watch an arm's tool with a camera whose place is in the file ``rig``; InputError without one."""
    if rig is None or not rig.exists():
        raise InputError(
            f"camera {number}: it is not known where it stands; first "
            f"`rejoint calibrate ROBOT RUN --measure camera={number}`"
        )
    found = read_rig(rig, arm)
    with LiveCamera(number, size=found.lens.size) as camera, LiveEye(camera, found) as eye:
        yield eye
