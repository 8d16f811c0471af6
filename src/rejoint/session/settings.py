"""Options of driving an arm, and those that a run keeps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from rejoint.arms import Arm, Box
from rejoint.arms.inertia import Payload, loaded
from rejoint.runs.run import Run
from rejoint.session.inputs import CalibrationLike, Period, RobotLike, TwinLike, unfit
from rejoint.system.files import read_json, write_json
from rejoint.system.numbers import as_period, as_seconds, as_seed, as_within

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from rejoint.session.controllers import ControllerLike
    from rejoint.session.eyes import EyeLike
    from rejoint.session.payload import PayloadLike


@dataclass(frozen=True, kw_only=True, eq=False)
class Settings:
    """Options of a session; those of the command line have the same names.

    A run keeps payload, tool, boxes, period and accepted error of its diagnosis; they hold for that run by default.

    Examples
    --------
    >>> settings = rejoint.Settings(payload=0.1, controller="integrator")
    >>> rejoint.deploy("emulated:worn", run="runs/mine", settings=settings)
    """

    controller: ControllerLike | None = None
    """name of a controller or a policy file; by default what the run recommends, without one the generic policy; along
    a path the tracker. In Python also a policy, a controller or a factory"""
    twin: TwinLike | None = None
    """twin or its file; by default that of the run"""
    calibration: CalibrationLike | None = None
    """file to correct by (calibration.toml), or none; by default that of the run. In Python also a calibration"""
    payload: PayloadLike | None = None
    """[kg] mass that the hand carries at the tool's tip. In Python also a `Payload`"""
    tool: ArrayLike | None = None
    """[m] tip of a tool from the tip in the arm's description, in its frame"""
    keep_out: Sequence[Box] = ()
    """boxes [m] in the base frame to keep out of, besides the arm's own"""
    eye: EyeLike | None = None
    """what sees the tool, for the last millimetres: the number of the run's camera, or emulated for an emulated arm. In
    Python also an `Eye`"""
    period: Period | None = None
    """[s] shortest and longest control period; by default what the robot suits"""
    seed: int | None = None
    """seed of everything random; by default that of the run, else 0"""
    dwell: float = 4.0
    """[s] time per target"""
    within: float | None = None
    """[m] accepted error by the encoders; by default 2 mm at a point, 5 mm rms along a path"""
    dry_run: bool = False
    """move nothing: simulate it, and say how far, how long and how close to limits"""

    def __post_init__(self) -> None:
        as_seed(self.seed)
        as_period(self.period)
        as_seconds("dwell", self.dwell)
        if self.within is not None:
            as_within("settings", self.within)
        for box in self.keep_out:
            if not isinstance(box, Box):
                raise unfit(box, "a rejoint.Box in keep_out")


@dataclass(frozen=True, kw_only=True)
class KeptSettings:
    """What a run keeps of its diagnosis (`settings.json`); fields as in `Settings`."""

    payload: Payload | None = None
    tool: tuple[float, ...] | None = None
    keep_out: tuple[tuple[tuple[float, ...], tuple[float, ...]], ...] | None = None
    """lower and upper corner of each box"""
    period: tuple[float, float] | None = None
    within: float | None = None

    @classmethod
    def of(cls, settings: Settings) -> KeptSettings:
        """Return what is kept of ``settings``."""
        mass, tool, period = settings.payload, settings.tool, as_period(settings.period)
        return cls(
            payload=mass if mass is None or isinstance(mass, Payload) else Payload(mass=float(mass)),
            tool=None if tool is None else tuple(np.asarray(tool, dtype=float).tolist()),
            keep_out=tuple((tuple(box.lower.tolist()), tuple(box.upper.tolist())) for box in settings.keep_out) or None,
            period=period,
            within=settings.within,
        )

    def given(self) -> dict[str, Any]:
        """Return the fields of `Settings` that were given."""
        boxes = [Box(lower=np.array(low), upper=np.array(high)) for low, high in self.keep_out or ()]
        fields = {**vars(self), "keep_out": boxes or None}
        return {name: value for name, value in fields.items() if value is not None}

    def __str__(self) -> str:
        said = (
            "" if self.payload is None else f"payload {self.payload.mass:g} kg",
            "" if self.tool is None else f"tool {','.join(f'{1e3 * value:g}' for value in self.tool)} mm",
            "" if self.keep_out is None else f"{len(self.keep_out)} box(es) to keep out of",
            "" if self.period is None else f"period {1e3 * self.period[0]:g}-{1e3 * self.period[1]:g} ms",
            "" if self.within is None else f"within {1e3 * self.within:g} mm",
        )
        return ", ".join(filter(None, said))


def keep(run: Run, settings: Settings) -> None:
    """Write what ``run`` keeps; FileError where that fails."""
    kept = KeptSettings.of(settings)
    if kept.given() or run.folder.settings.exists():
        write_json(run.folder.settings, kept)


def kept(run: Run | None) -> KeptSettings:
    """Return what ``run`` keeps; FileError where that is damaged."""
    there = run is not None and run.folder.settings.exists()
    return read_json(run.folder.settings, KeptSettings) if run is not None and there else KeptSettings()


def settled(given: Settings | None, run: Run | None, robot: RobotLike | None) -> tuple[Settings, str]:
    """Complete ``given`` settings by those that ``run`` keeps; return a sentence on the latter too.

    An open robot has its own payload and tool. InputError for what are no settings.
    """
    settings = Settings() if given is None else given
    if not isinstance(settings, Settings):
        raise unfit(settings, "rejoint.Settings")
    mine = kept(run)
    mine = mine if isinstance(robot, str) else replace(mine, payload=None, tool=None)
    told = {name: getattr(settings, name) for name in vars(mine)}
    used = replace(mine, **{name: None for name, value in told.items() if value is not None and np.size(value)})
    if run is None or not used.given():
        return settings, ""
    said = f"Settings of {run.path}, used unless others are given: {used}."
    return replace(settings, **used.given()), said


def laden(run: Run) -> Arm:
    """Return the arm with payload and tool of its diagnosis."""
    mine = kept(run)
    return loaded(run.arm, mine.payload, mine.tool)
