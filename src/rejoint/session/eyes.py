"""Eyes of a deployment: what sees the tool, and what it saw at each target."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from rejoint.arms import Displacement
from rejoint.control.correction import Modelled, TrueError
from rejoint.control.deployment import Deployed, Visit
from rejoint.control.robot import Controller, Robot
from rejoint.control.seeing import Eye, Finishing, Seen
from rejoint.runs.run import Run
from rejoint.system.errors import InputError

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
        if np.isfinite(robot.true_tcp()).all():
            raise InputError(f"camera {given} cannot see {robot.address}; watch an emulated arm with --camera emulated")
        from rejoint.camera.tracker import opened_camera

        with opened_camera(int(given), None if run is None else run.folder.camera, robot.arm) as eye:
            yield eye
    else:
        raise InputError(f"no camera is called {given!r}; expected the number of a camera, or emulated")


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
