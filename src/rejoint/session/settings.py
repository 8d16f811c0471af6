"""The options that every way of driving an arm shares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rejoint.arms import Box
from rejoint.session.inputs import CalibrationLike, Period, TwinLike

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from rejoint.session.controllers import ControllerLike
    from rejoint.session.eyes import EyeLike
    from rejoint.session.payload import PayloadLike


@dataclass(frozen=True, kw_only=True, eq=False)
class Settings:
    """Options of a session; those of the command line have the same names.

    Examples
    --------
    >>> settings = rejoint.Settings(payload=0.1, controller="integrator")
    >>> rejoint.deploy("emulated:worn", run="runs/mine", settings=settings)
    """

    controller: ControllerLike | None = None
    """policy, its file, a name, or an object; None: as the run recommends"""
    twin: TwinLike | None = None
    """twin or its file; None: that of the run"""
    calibration: CalibrationLike | None = None
    """calibration or its file, or ``none``; None: the run's"""
    payload: PayloadLike | None = None
    """[kg] at the tool centre point, or a `Payload`"""
    tool: ArrayLike | None = None
    """(3,) [m] of a tool's tip in the frame of the described TCP"""
    keep_out: Sequence[Box] = ()
    """boxes [m] in the base frame to keep out of, besides the arm's own"""
    eye: EyeLike | None = None
    """camera number, ``emulated``, or an object that sees the tool"""
    period: Period | None = None
    """[s] interval of the control periods; None: what the robot suits"""
    seed: int | None = None
    """of everything random; None: that of the run, else 0"""
    dwell: float = 4.0
    """[s] per target of `deploy`"""
    within: float | None = None
    """[m] accepted encoder error, at most 0.1; None: 2 mm at a point, 5 mm rms along a path"""
    dry_run: bool = False
    """drive a simulation instead, and report on it"""
