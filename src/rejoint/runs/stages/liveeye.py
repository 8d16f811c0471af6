"""A camera that watches a real arm while it is driven: pictures are looked through in a thread of their own."""

from __future__ import annotations

import logging
import threading
import time
from types import TracebackType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rejoint.arms.camera.rig import Rig
from rejoint.control.seeing import Sighting
from rejoint.diagnosis.calibration.camera.track import ToolTracker
from rejoint.system.errors import InputError, RejointError

LATE = 0.05
"""[s] from the middle of an exposure until the picture is here (chosen: one picture at 30 a second, and its way)"""
FROZEN = 10
"""Pictures without a single other bit from which a camera hangs (chosen: one or two are sent twice at low light)"""
_LOGGER = logging.getLogger("rejoint")


class PictureStream(Protocol):
    """A camera that is open."""

    def picture(self) -> tuple[NDArray[np.uint8], float]:
        """Newest picture, and when it came [s] by `time.monotonic`; InputError if none comes."""


class LiveEye:
    """Sees the tool of one arm through an open camera; a context manager, in which its thread looks at pictures."""

    def __init__(self, camera: PictureStream, rig: Rig, name: str = "camera") -> None:
        self.name = name
        self.why = ""
        """why the last picture was of no use; empty where it was"""
        self._camera, self._tracker, self._size = camera, ToolTracker(rig), (rig.lens.width, rig.lens.height)
        self._newest: Sighting | None = None
        self._seen, self._gone = 0, False
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._watch, name=name, daemon=True)

    def __enter__(self) -> LiveEye:
        """Begin to look; InputError where the pictures are of another size than those of the calibration."""
        height, width = self._camera.picture()[0].shape[:2]
        if (width, height) != self._size:
            raise InputError(
                f"{self.name} gives pictures of {width} x {height} px, it was calibrated with {self._size[0]} x "
                f"{self._size[1]}; take that camera, or calibrate with this one"
            )
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Look no more; warn where nothing was seen, or the camera went."""
        self._end.set()
        self._thread.join()
        if self.why and (self._seen == 0 or self._gone):
            _LOGGER.warning("%s: %s; the arm was driven by its calibration alone from then on", self.name, self.why)

    def sighting(self, now: float) -> Sighting | None:
        """Return the newest sighting, on the robot's clock, which shows ``now`` [s]; None where there is none yet."""
        newest = self._newest
        if newest is None:
            return None
        return Sighting(time=newest.time + (now - time.monotonic()), place=newest.place, sigma=newest.sigma)

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
            seen = self._tracker.see(picture, came - LATE)
            self.why = self._tracker.why
            if seen is not None:
                self._newest, self._seen = seen, self._seen + 1
