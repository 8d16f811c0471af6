"""What public functions take: paths or objects, addresses or robots, and the options that a run keeps."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias, cast

from numpy.typing import ArrayLike

from rejoint.arms import CATALOGUE, Arm, Array, Box, Motors, collides, differing, load_arm
from rejoint.arms import ArmLike as ArmLike
from rejoint.arms.inertia import Payload, bare, loaded
from rejoint.control.robot import Controller, Robot, RobotWrapper
from rejoint.control.targets import Pose, draw_targets, placed, read_targets, refused
from rejoint.diagnosis.calibration.calibration import Calibration, read_calibration
from rejoint.logs.runfolder import LOGS, KeptSettings, RunFolder, read_settings
from rejoint.logs.runlog import RunLog, describe
from rejoint.robots import place_of
from rejoint.runs.run import Run
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import as_path, write_json
from rejoint.system.numbers import as_period, as_place, as_seconds, as_seed, as_within
from rejoint.system.records import as_options
from rejoint.twin.twin import Twin, read_twin

if TYPE_CHECKING:
    from rejoint.arms.rotations import Orientation
    from rejoint.control.controllers.policy import Policy
    from rejoint.control.seeing import Eye
    from rejoint.diagnosis.calibration.procedure import FilmingGauge, Gauge

RobotLike: TypeAlias = "Robot | str"
"""An open robot, or the address of one"""

LogsLike: TypeAlias = "RunLog | Path | str | Sequence[RunLog | Path | str]"
"""Run logs, their files, or a folder of them"""

PayloadLike: TypeAlias = "float | Payload"
"""[kg] at the tool centre point, or with its centre of mass"""

ControllerLike: TypeAlias = "str | Path | Policy | Controller | Callable[[Arm], Controller]"
"""A controller, its name, a policy or its file, or a factory"""

TwinLike: TypeAlias = "Twin | Path | str"
CalibrationLike: TypeAlias = "Calibration | Path | str"
"""A calibration, its file, or ``none`` for no correction"""
GaugeLike: TypeAlias = "Gauge | FilmingGauge | Literal['none']"
"""What measures the tool, or ``none`` where nothing is to"""

NO_GAUGE: Literal["none"] = "none"

RunLike: TypeAlias = "Run | Path | str"
"""A run, or its folder"""

Targets: TypeAlias = "ArrayLike | Sequence[Pose] | Path"
"""(K, 3) or (S, K, 3) [m], poses, or a CSV file in millimetres"""

EyeLike: TypeAlias = "Eye | Callable[[Robot], Eye] | str | int"
"""An eye, its factory, the number of a camera, or ``emulated``"""

Period: TypeAlias = "tuple[float, float]"
"""[s] interval of the control periods"""


FIRST_ROBOT = "emulated:worn"
"""The default robot: a worn arm in this process"""


def is_robot(given: RobotLike | LogsLike) -> bool:
    """Whether it is a robot and no logs: addresses begin with a word and a colon, and no drive of Windows."""
    return bool(re.match(r"[\w.+-]{2,}:", given)) if isinstance(given, str) else isinstance(given, Robot)


def address_of(robot: RobotLike) -> str:
    """Address of a robot, as its user wrote it; AddressError for what is none."""
    return robot.address if isinstance(robot, Robot) else place_of(robot).text


def arm_of(robot: RobotLike | None, arm: ArmLike | None) -> Arm:
    """Arm of a robot: its own, else ``arm``, else the address's; InputError without any."""
    if isinstance(robot, Robot):
        return robot.arm
    if arm is not None:
        return load_arm(arm)
    if robot is None:
        raise InputError("no arm is given; give one, or what it belongs to: a run, a robot or a twin")
    return load_arm(place_of(robot).default_arm)


class Borrowed(RobotWrapper):
    """A robot that the caller opened, and closes."""

    def close(self) -> None:
        """Leave it open."""


def period_of(robot: RobotLike, period: Period | None) -> Period | None:
    """Control periods [s] of a robot; None: only the open robot knows."""
    return as_period(period) or (place_of(robot).default_period if isinstance(robot, str) else None)


def as_logs(given: LogsLike) -> list[RunLog]:
    """Run logs from objects, files or a folder; InputError, or FileError, without any."""
    if isinstance(given, RunLog):
        return [given]
    if not isinstance(given, Path | str):
        if isinstance(given, Iterable) and (found := [log for one in given for log in as_logs(one)]):
            return found
        raise InputError(f"no run logs were given, expected at least one, got {given!r:.80}")
    path = Path(given)
    files = [path] if path.is_file() else sorted(path.glob("*.parquet"))
    if not files:
        there = f"no folder with run logs (.parquet): {describe(path) if path.exists() else 'nothing there'}"
        raise FileError(path, there, "make one with: rejoint import SOURCE FOLDER")
    return [RunLog.load(file) for file in files]


def source_of(logs: LogsLike) -> str:
    """Name the source of a run made from logs."""
    return f"{LOGS}{logs}" if isinstance(logs, Path | str) else f"{LOGS}memory"


def as_twin(given: TwinLike, arm: Arm | None = None) -> Twin:
    """Twin, or read it; ContractError if it is not of ``arm``."""
    found = given if isinstance(given, Twin) else read_twin(as_path("a twin or its file", given))
    if arm is not None:
        found.require(arm)
    return found


def as_calibration(given: CalibrationLike | None, run: Run | None, arm: Arm) -> Calibration | None:
    """Calibration given, read, or of the run; None for ``none``.

    ContractError for another arm's.
    """
    if given is None:
        given = run.folder.calibration if run is not None and run.folder.calibration.exists() else "none"
    if isinstance(given, Path | str):
        return None if str(given) == "none" else read_calibration(Path(given), arm)
    given.require(arm)
    return replace(given, arm=arm)  # with what was told of its hand


def opened(run: RunLike, arm: ArmLike | None) -> Run:
    """Open a run, with boxes of the ``arm``; InputError for another."""
    found = Run.open(run)
    if arm is None:
        return found
    given = load_arm(arm)
    found.require(given)
    return replace(found, arm=replace(found.arm, keep_out=each_once(*found.arm.keep_out, *given.keep_out)))


def run_of_logs(run: RunLike | None, logs: LogsLike, arm: ArmLike | None) -> tuple[Run | None, Arm]:
    """Run of a stage on logs, without writing, and the arm."""
    if isinstance(run, Run):
        return opened(run, arm), run.arm
    if arm is None and isinstance(run, str | Path) and RunFolder(Path(run)).info.exists():
        chosen = Run.open(run).arm  # described there
    else:
        chosen = arm_named(as_logs(logs)[0].arm, "the logs are") if arm is None else load_arm(arm)
    return None if run is None else Run.plan(run, source_of(logs), chosen, None), chosen


def arm_named(name: str, whose: str) -> Arm:
    """Catalogue arm that logs or a twin name; else InputError."""
    if name not in CATALOGUE:
        raise InputError(f"{whose} of an arm {name!r}, which is described elsewhere; give its file as the arm")
    return load_arm(name)


def run_of_twin(twin: TwinLike) -> Run | None:
    """Return the run that holds a twin's file, if any."""
    if isinstance(twin, Twin):
        return None
    path = as_path("a twin or its file", twin)
    folder = RunFolder(path.parent)
    return Run.open(folder.path) if folder.info.exists() and folder.twin == path else None


def arm_of_twin(twin: TwinLike, arm: ArmLike | None = None) -> Arm:
    """Arm of a twin, by default its run's or the catalogue's, with the load of the run."""
    run = run_of_twin(twin)
    if arm is None:
        arm = arm_named(as_twin(twin).arm, "the twin is") if run is None else run.arm
    found = load_arm(arm)
    return found if bare(found) is not found else kept(run).laden(found)


def as_targets(
    given: Targets | None, arm: Arm, *, sets: int, seed: int, motors: Motors | None = None
) -> tuple[Array, Orientation | None]:
    """Return targets (S, K, 3) [m], given, read or drawn, and orientations (S, K) or None.

    InputError or FileError for those out of reach or too heavy.
    """
    if given is None:
        return draw_targets(arm, sets=sets, seed=seed), None
    if isinstance(given, Path | str):
        points, turns = read_targets(Path(given), arm, motors)
        return points[None], turns and turns[None]
    kinds = {isinstance(one, Pose) for one in given} if isinstance(given, Iterable) else set()
    if len(kinds) > 1:
        raise InputError("targets: some are poses and some are points; give a rejoint.Pose for each, or for none")
    turns = None
    if kinds == {True}:
        points, turns = placed(arm, cast("Sequence[Pose]", given))
    else:
        points = as_place("targets", given, "points (targets, 3) or (sets, targets, 3) in metres", (2, 3))
    points = points[None] if points.ndim == 2 else points
    sets, count, _ = points.shape
    names = [f"number {k + 1}{f' of set {s + 1}' * (sets > 1)}" for s in range(sets) for k in range(count)]
    if problem := refused(arm, names, points.reshape(-1, 3), turns, motors):
        raise InputError(f"targets: {problem}")
    return points, turns and turns[None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Settings:
    """Options of a session; those of the command line have the same names.

    A run keeps payload, tool, boxes, period and accepted error of its diagnosis.

    Examples
    --------
    >>> settings = rejoint.Settings(payload=0.1, controller="integrator")
    >>> rejoint.deploy("emulated:worn", run="runs/mine", settings=settings)
    """

    controller: ControllerLike | None = None
    """name of a controller or a policy file; by default what the run recommends, else the generic policy; along a path
    the tracker. In Python also a policy, controller or factory"""
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
    """what sees the tool: number of the run's camera, or emulated. In Python also an `Eye`"""
    period: Period | None = None
    """[s] shortest and longest control period; by default what the robot suits"""
    seed: int | None = None
    """seed of everything random; by default that of the run, else 0"""
    dwell: float = 4.0
    """[s] time per target"""
    within: float | None = None
    """[m] accepted error by the encoders; by default 2 mm at a point, 10 mm for `deploy`, 5 mm rms along a path"""
    dry_run: bool = False
    """move nothing: simulate it, and say how far, how long and how close to limits"""

    def __post_init__(self) -> None:
        as_seed(self.seed)
        as_seconds("dwell", self.dwell)
        boxes = tuple(self.keep_out) if isinstance(self.keep_out, Iterable) else (None,)
        if not all(isinstance(box, Box) for box in boxes):
            raise InputError("settings: keep_out takes boxes, such as [rejoint.arms.Box(lower=..., upper=...)]")
        object.__setattr__(self, "keep_out", boxes)  # not an iterator, which is used up
        to_keep(self)  # refuses what it cannot keep
        if self.within is not None:
            as_within("settings", self.within)


def to_keep(settings: Settings) -> KeptSettings:
    """Return what a run keeps of ``settings``."""
    mass, tool = settings.payload, settings.tool
    return KeptSettings(
        payload=mass if mass is None or isinstance(mass, Payload) else Payload(mass=mass),
        tool=None if tool is None else as_place("settings: tool", tool),
        keep_out=tuple(settings.keep_out),
        period=as_period(settings.period),
        within=settings.within,
    )


def keep(run: Run, settings: Settings) -> None:
    """Write what ``run`` keeps; FileError where that fails."""
    kept = to_keep(settings)
    if kept.given() or run.folder.settings.exists():
        write_json(run.folder.settings, kept)


def kept(run: Run | None) -> KeptSettings:
    """Return what ``run`` keeps; FileError where that is damaged."""
    return KeptSettings() if run is None else read_settings(run.folder)


def settled(given: Settings | None, run: Run | None, robot: RobotLike | None) -> tuple[Settings, str]:
    """Complete ``given`` settings by those that ``run`` keeps; return a sentence on the latter too.

    An open robot has its own payload and tool.
    """
    settings = as_options(given, Settings)
    own = to_keep(settings).given().keys() | ({"payload", "tool"} if isinstance(robot, Robot) else set())
    used = {name: value for name, value in kept(run).given().items() if name not in own}
    if settings.keep_out and (boxes := kept(run).keep_out):  # they add up
        used["keep_out"] = each_once(*boxes, *settings.keep_out)
    if run is None or not used:
        return settings, ""
    said = shlex.join(KeptSettings(**used).options())
    return replace(settings, **used), f"Settings of {run.path}, used unless others are given: {said}"


def each_once(*boxes: Box) -> tuple[Box, ...]:
    """Drop equal ones."""
    return tuple({str(box): box for box in boxes}.values())


def laden(run: Run) -> Arm:
    """Return the arm with payload and tool of its diagnosis."""
    return kept(run).laden(run.arm)


def equipped(arm: Arm, robot: RobotLike | None, settings: Settings) -> Arm:
    """Arm with payload, tool and boxes of the settings.

    InputError for another payload or tool than an open robot has, and for a box that holds a part of the resting arm.
    """
    opened = isinstance(robot, Robot)
    own = bare(arm) if opened else arm
    found = loaded(own, settings.payload, settings.tool)
    if not opened:
        arm = found
    elif found is not own and differing(found, arm):
        raise InputError("give a payload or a tool with the address of a robot, not with an open one")
    if not settings.keep_out:
        return arm
    found = replace(arm, keep_out=(*arm.keep_out, *settings.keep_out))
    if collides(found, arm.rest) and not collides(arm, arm.rest):
        raise InputError("keep_out: a part of the arm in its rest posture is inside a box; give boxes around the arm")
    return found
