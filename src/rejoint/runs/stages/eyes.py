"""What a deployment is given to see the tool by, and what was seen at each target."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from rejoint.arms import Displacement
from rejoint.arms.camera.rig import Rig
from rejoint.arms.camera.rigfile import read_rig
from rejoint.control.accuracy import TrueError
from rejoint.control.controller import Controller
from rejoint.control.correction import Modelled
from rejoint.control.deployment import Deployed, Visit
from rejoint.control.finishing import Finishing
from rejoint.control.robot import Robot
from rejoint.control.seeing import Eye, Seen
from rejoint.runs.run import Run
from rejoint.system.errors import InputError

_LOGGER = logging.getLogger("rejoint")

EyeLike: TypeAlias = "Eye | Callable[[Robot], Eye] | str"
"""An eye, what makes one for an open robot, the number of a camera, or ``emulated``"""


@contextmanager
def opened_eye(given: EyeLike | None, robot: Robot, run: Run | None, seed: int) -> Iterator[Eye | None]:
    """Open the eye that sees the tool of ``robot``, and close it at the end; None where nothing watches.

    A camera by its number needs the ``camera.toml`` of ``run``. InputError where there is no such eye.
    """
    if given is None:
        yield None
    elif given == "emulated":
        from rejoint.robots.eye import EmulatedEye

        yield EmulatedEye(robot, seed=seed)
    elif not isinstance(given, str):
        yield given if hasattr(given, "sighting") else given(robot)
    elif given.isdecimal():
        from rejoint.robots.livecamera import LiveCamera
        from rejoint.runs.stages.liveeye import LiveEye

        rig = _rig(given, robot, run)
        size = (rig.lens.width, rig.lens.height)
        with LiveCamera(int(given), size=size) as camera, LiveEye(camera, rig, name=f"camera {given}") as eye:
            yield eye
    else:
        raise InputError(f"no camera is called {given!r}; expected the number of a camera, or emulated")


def _rig(number: str, robot: Robot, run: Run | None) -> Rig:
    """Return how the camera stands to the arm."""
    if np.isfinite(robot.true_tcp()).all():
        raise InputError(f"camera {number} cannot see {robot.address}; watch an emulated arm with --camera emulated")
    if run is None or not run.folder.camera.exists():
        raise InputError(
            f"camera {number}: it is not known where it stands; first `rejoint calibrate ROBOT RUN --camera {number}`"
        )
    return read_rig(run.folder.camera, robot.arm)


def watched(robot: Robot, controller: Controller, model: Modelled | None, eye: Eye) -> tuple[Controller, Seen]:
    """Return the controller that finishes by what ``eye`` sees, and the correction that goes with it."""
    arm = robot.arm
    seen = Seen(arm, Displacement.none(arm) if model is None else model.displacement, eye=eye)
    return Finishing(arm, controller, seen), seen


def with_sightings(done: Deployed, seen: Seen | None) -> Deployed:
    """Add what was seen at each target to what became of it."""
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
    """Return what was ``seen`` [m] as the true error of a visit, unless it is known better."""
    if seen is None or visit.true_error.how == "known":
        return visit.true_error
    return TrueError(how="measured", value=seen)
