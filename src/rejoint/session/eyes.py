"""Eyes of a deployment: what sees the tool, and what it saw at each target."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import TracebackType
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Displacement
from rejoint.arms.camera.rig import Rig, read_rig
from rejoint.control.controller import Controller
from rejoint.control.correction import Modelled, TrueError
from rejoint.control.deployment import Deployed, Visit
from rejoint.control.robot import Robot
from rejoint.control.seeing import Eye, Finishing, Seen, Sighting
from rejoint.diagnosis.calibration.camera.ties import ToolTracker
from rejoint.runs.run import Run
from rejoint.system.errors import InputError, RejointError

_LOGGER = logging.getLogger("rejoint")

EyeLike: TypeAlias = "Eye | Callable[[Robot], Eye] | str"
"""An eye, its factory, the number of a camera, or ``emulated``"""


@contextmanager
def opened_eye(given: EyeLike | None, robot: Robot, run: Run | None, seed: int) -> Iterator[Eye | None]:
    """Open the eye for ``robot``; InputError without one. A camera needs the ``camera.toml`` of ``run``."""
    if given is None:
        yield None
    elif given == "emulated":
        from rejoint.robots.cameras import simulated

        yield simulated(robot).eye(seed)
    elif not isinstance(given, str):
        yield given if hasattr(given, "sighting") else given(robot)
    elif given.isdecimal():
        from rejoint.robots.cameras import LiveCamera

        rig = _rig(given, robot, run)
        size = (rig.lens.width, rig.lens.height)
        with LiveCamera(int(given), size=size) as camera, LiveEye(camera, rig, name=f"camera {given}") as eye:
            yield eye
    else:
        raise InputError(f"no camera is called {given!r}; expected the number of a camera, or emulated")


def _rig(number: str, robot: Robot, run: Run | None) -> Rig:
    if np.isfinite(robot.true_tcp()).all():
        raise InputError(f"camera {number} cannot see {robot.address}; watch an emulated arm with --camera emulated")
    if run is None or not run.folder.camera.exists():
        raise InputError(
            f"camera {number}: it is not known where it stands; first "
            f"`rejoint calibrate ROBOT RUN --measure camera={number}`"
        )
    return read_rig(run.folder.camera, robot.arm)


def watched(robot: Robot, controller: Controller, model: Modelled | None, eye: Eye) -> tuple[Controller, Seen]:
    """Return the controller and the correction that use ``eye``."""
    arm = robot.arm
    seen = Seen(arm, Displacement.none(arm) if model is None else model.displacement, eye=eye)
    return Finishing(arm, controller, seen), seen


def with_sightings(done: Deployed, seen: Seen | None) -> Deployed:
    """Add what was seen at each target."""
    if seen is None:
        return done
    far = seen.shifted() if seen.displacement.play.any() else None  # without a calibration all of the sag is seen
    if far is not None:
        _LOGGER.warning(
            "the camera sees the tool %.1f mm to one side of where the calibration has it, at all targets alike: were "
            "camera or board moved? Then calibrate with the camera again, the arm went where it says",
            1e3 * far,
        )
    seen_at = [*seen.visits, *[(0, None)] * len(done.visits)]
    visits = [
        replace(visit, sightings=count, seen_error=error, true_error=_measured(visit, error))
        for visit, (count, error) in zip(done.visits, seen_at, strict=False)
    ]
    return replace(done, visits=tuple(visits))


def _measured(visit: Visit, seen: float | None) -> TrueError:
    """Take what was ``seen`` [m] as true error, unless it is known better."""
    if seen is None or visit.true_error.how == "known":
        return visit.true_error
    return TrueError(how="measured", value=seen)


LATE = 0.05
"""[s] from exposure to picture (chosen)"""
FROZEN = 10
"""Equal pictures after which a camera hangs (chosen)"""


class PictureStream(Protocol):
    """A camera that is open."""

    def picture(self) -> tuple[NDArray[np.uint8], float]:
        """Newest picture, and its time [s] by `time.monotonic`; InputError without."""


class LiveEye:
    """Looks at the pictures of an open camera in a thread of its own."""

    def __init__(self, camera: PictureStream, rig: Rig, name: str = "camera") -> None:
        self.name = name
        self.why = ""
        """why the last picture was unusable, or empty"""
        self._camera, self._tracker, self._size = camera, ToolTracker(rig), (rig.lens.width, rig.lens.height)
        self._newest: Sighting | None = None
        self._seen, self._gone = 0, False
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._watch, name=name, daemon=True)

    def __enter__(self) -> LiveEye:
        """Begin; InputError for pictures of another size than calibrated."""
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
        """End; warn where nothing was seen, or the camera is gone."""
        self._end.set()
        self._thread.join()
        if self.why and (self._seen == 0 or self._gone):
            _LOGGER.warning("%s: %s; the arm was driven by its calibration alone from then on", self.name, self.why)

    def sighting(self, now: float) -> Sighting | None:
        """Newest detection on the robot's clock, ``now`` [s], or None."""
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
