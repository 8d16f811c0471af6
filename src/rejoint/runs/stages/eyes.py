"""What a deployment is given to see the tool by, and what was seen at each target."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

from rejoint.arms import Displacement
from rejoint.control.accuracy import TrueError
from rejoint.control.controller import Controller
from rejoint.control.correction import Modelled
from rejoint.control.deployment import Deployed, Visit
from rejoint.control.finishing import Finishing
from rejoint.control.robot import Robot
from rejoint.control.seeing import Eye, Seen
from rejoint.system.errors import InputError

EyeLike: TypeAlias = "Eye | Callable[[Robot], Eye] | str"
"""An eye, what makes one for an open robot, or ``emulated``"""


def eye_of(given: EyeLike, robot: Robot, seed: int) -> Eye:
    """Return the eye that sees the tool of ``robot``; InputError where there is none such."""
    if given == "emulated":
        from rejoint.robots.eye import EmulatedEye

        return EmulatedEye(robot, seed=seed)
    if isinstance(given, str):
        raise InputError(f"no camera is called {given!r}; expected emulated")
    return given if hasattr(given, "sighting") else given(robot)


def watched(robot: Robot, controller: Controller, model: Modelled | None, eye: Eye) -> tuple[Controller, Seen]:
    """Return the controller that finishes by what ``eye`` sees, and the correction that goes with it."""
    arm = robot.arm
    seen = Seen(arm, Displacement.none(arm) if model is None else model.displacement, eye=eye)
    return Finishing(arm, controller, seen), seen


def with_sightings(done: Deployed, seen: Seen | None) -> Deployed:
    """Add what was seen at each target to what became of it."""
    if seen is None:
        return done
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
