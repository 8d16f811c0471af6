"""What the public functions are given: a path or the object itself, an address or the robot itself.

A robot, an arm, logs, a twin or a policy may be given either way; here each becomes the object.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol, TypeAlias, cast

from numpy.typing import ArrayLike

from rejoint.arms import CATALOGUE, Arm, Array, load_arm
from rejoint.control.comparison.targets import draw_targets, read_targets, require_reachable
from rejoint.control.poses import Pose, placed
from rejoint.control.robot import Robot
from rejoint.logs.found import describe
from rejoint.logs.runfolder.folder import LOGS, RunFolder
from rejoint.logs.runlog import RunLog, read_log
from rejoint.robots import open_robot, place_of
from rejoint.runs.run import Run
from rejoint.system.errors import FileError, InputError
from rejoint.system.numbers import as_floats, as_period, as_seed

if TYPE_CHECKING:
    from rejoint.arms.orientation import Orientation
    from rejoint.control.policy import Policy
    from rejoint.diagnosis.calibration.calibration import Calibration
    from rejoint.diagnosis.calibration.camera.filming import CameraGauge
    from rejoint.diagnosis.calibration.gauges import Gauge
    from rejoint.twin.twin import Twin

ArmLike: TypeAlias = "Arm | str | Path"
"""An arm, its name in the catalogue, or its TOML, URDF or MJCF file"""

RobotLike: TypeAlias = "Robot | str"
"""An open robot, or the address of one"""

LogsLike: TypeAlias = "RunLog | Path | str | Sequence[RunLog | Path | str]"
"""Run logs, or files of them, or a folder of such files"""

TwinLike: TypeAlias = "Twin | Path | str"
PolicyLike: TypeAlias = "Policy | Path | str"
CalibrationLike: TypeAlias = "Calibration | Path | str"
"""A calibration, its file, or ``none`` for no correction"""
GaugeLike: TypeAlias = "Gauge | CameraGauge | Literal['none']"
"""What measures the tool, or ``none`` where nothing is to"""

NO_GAUGE: Literal["none"] = "none"

RunLike: TypeAlias = "Run | Path | str"
"""A run, or its folder"""

Targets: TypeAlias = "ArrayLike | Sequence[Pose] | Path"
"""(K, 3) or (S, K, 3) [m], or poses, or a CSV file in millimetres with the header x,y,z and perhaps an orientation"""

Period: TypeAlias = "tuple[float, float]"
"""[s] interval from which the length of every control cycle is drawn"""


class Live(Protocol):
    """Somebody who looks on while an arm is driven, as a `LiveView` does."""

    def watch(
        self, robot: Robot, *, twin: Twin | None = None, within: float | None = None, paced: bool | None = None
    ) -> Robot:
        """Return the robot as one that is shown: with its ``twin``, and the error [m] that is accepted.

        ``paced`` says whether its time is virtual and may be slowed down; None: look at its address.
        """


FIRST_ROBOT = "emulated:worn"
"""The robot where none is named: a worn arm in this process"""


def unfit(given: object, expected: str) -> InputError:
    """Make the error for an object that is nothing a function takes."""
    return InputError(f"an object of type {type(given).__name__} was given, expected {expected}")


def as_arm(given: ArmLike) -> Arm:
    """Return the arm, from the catalogue or its file where it is not given itself."""
    if isinstance(given, Arm):
        return given
    if not isinstance(given, str | Path):
        raise unfit(given, "an arm, its name, or its TOML, URDF or MJCF file")
    return load_arm(given)


def is_robot(given: RobotLike | LogsLike) -> bool:
    """Tell a robot from logs: an address has a colon, which no path to logs has."""
    return ":" in given if isinstance(given, str) else isinstance(given, Robot)


def address_of(robot: RobotLike) -> str:
    """Address of a robot, as its user wrote it."""
    return robot if isinstance(robot, str) else robot.address


def arm_of(robot: RobotLike, arm: ArmLike | None) -> Arm:
    """Arm that a robot is driven as: its own where it is open, else ``arm``, by default what its address names."""
    if not isinstance(robot, str):
        if not hasattr(robot, "step"):
            raise unfit(robot, "a robot, as rejoint.connect opens it, or its address")
        return robot.arm
    return as_arm(place_of(robot).default_arm if arm is None else arm)


@contextmanager
def opened(robot: RobotLike, arm: Arm, seed: int, period: Period | None) -> Iterator[Robot]:
    """Open a robot and close it at the end; one that is open already stays open."""
    if not isinstance(robot, str):
        yield robot
        return
    with closing(open_robot(robot, arm=arm, seed=seed, period=period_of(robot, period))) as connection:
        yield connection


def shown(
    live: Live | None, robot: Robot, *, twin: Twin | None = None, within: float | None = None,
    paced: bool | None = None,
) -> Robot:  # fmt: skip
    """Return the robot as one that is shown to ``live``; as it is where nobody looks on."""
    return robot if live is None else live.watch(robot, twin=twin, within=within, paced=paced)


class Borrowed:
    """A robot that somebody else opened, and closes."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot

    def __getattr__(self, name: str) -> object:
        return getattr(self._robot, name)

    def close(self) -> None:
        """Leave it open."""


def borrowed(robot: Robot) -> Robot:
    """Return the robot as one that `Robot.close` leaves open."""
    return cast(Robot, Borrowed(robot))


def is_batchable(robot: RobotLike) -> bool:
    """Tell whether many arms of this robot can be opened side by side."""
    return isinstance(robot, str) and place_of(robot).virtual


def period_of(robot: RobotLike, period: Period | None) -> Period | None:
    """[s] interval of the control periods that a robot will have; None where only the open robot knows."""
    return as_period(period) or (place_of(robot).default_period if isinstance(robot, str) else None)


def as_logs(given: LogsLike) -> list[RunLog]:
    """Return run logs: those given, or of the files, or of every file in a folder; FileError if there is none."""
    if isinstance(given, RunLog):
        return [given]
    if isinstance(given, Iterable) and not isinstance(given, str):
        return [log for one in given for log in as_logs(one)]
    if not isinstance(given, Path | str):
        raise unfit(given, "run logs (rejoint.RunLog.of makes one of arrays), files of them, or a folder of such files")
    path = Path(given)
    if path.is_file():
        return [read_log(path)]
    files = sorted(path.glob("*.parquet")) if path.is_dir() else []
    if not files:
        found = describe(path) if path.exists() else "nothing there"
        raise FileError(
            path, f"no folder with run logs (.parquet): {found}", "make one with: rejoint import SOURCE FOLDER"
        )
    return [read_log(file) for file in files]


def source_of(logs: LogsLike) -> str:
    """Name what stands for the robot of a run that is made from logs."""
    return f"{LOGS}{logs}" if isinstance(logs, Path | str) else f"{LOGS}memory"


def as_twin(given: TwinLike) -> Twin:
    """Return the twin, from its file where it is not given itself."""
    if not isinstance(given, Path | str):
        if not hasattr(given, "parameters"):
            raise unfit(given, "a twin, as rejoint.identify returns it, or its file")
        return given
    from rejoint.twin.file import read_twin

    return read_twin(Path(given))


def as_policy(given: PolicyLike) -> Policy:
    """Return the policy, from its file where it is not given itself."""
    if not isinstance(given, Path | str):
        return given
    from rejoint.control.policy import Policy

    return Policy.load(given)


def as_calibration(given: CalibrationLike | None, run: Run | None, arm: Arm) -> Calibration | None:
    """Return the calibration given, that of its file, or that of the run; None where there is none, or for ``none``.

    ContractError where it is of another arm than ``arm``.
    """
    from rejoint.diagnosis.calibration.file import read_calibration

    if given is None:
        file = None if run is None else run.folder.calibration
        return None if file is None or not file.exists() else read_calibration(file, arm)
    if isinstance(given, Path | str):
        return None if str(given) == "none" else read_calibration(Path(given), arm)
    given.require(arm)
    return replace(given, arm=arm)  # with what was told of its hand


def as_run(given: RunLike) -> Run:
    """Return the run, from its folder where it is not given itself."""
    if isinstance(given, Run):
        return given
    if not isinstance(given, str | Path):
        raise unfit(given, "a run or its folder")
    return Run.open(given)


def run_about(run: RunLike | None, robot: str, arm: Arm, seed: int | None) -> Run | None:
    """Return the run that a stage writes into, without writing: as given, or what its folder holds or will hold.

    InputError if it is a run of another robot, arm or seed; ``seed`` None takes that of the folder, 0 for a new one.
    """
    if run is None:
        return None
    if isinstance(run, str | Path) and not RunFolder(Path(run)).info.exists():
        return Run.plan(run, robot, arm, as_seed(seed))
    run = as_run(run)
    run.require(robot=robot, arm=arm, seed=run.seed if seed is None else seed)
    return run


def run_of_logs(run: RunLike | None, logs: LogsLike, arm: ArmLike | None) -> tuple[Run | None, Arm]:
    """Return the run that a stage on logs writes into, without writing, and the arm, which the logs do not describe."""
    if isinstance(run, Run):
        return run, run.arm
    if arm is None and isinstance(run, str | Path) and RunFolder(Path(run)).info.exists():
        chosen = Run.open(run).arm  # described there
    else:
        chosen = arm_named(as_logs(logs)[0].arm, "the logs are") if arm is None else as_arm(arm)
    return run_about(run, source_of(logs), chosen, None), chosen


def arm_named(name: str, whose: str) -> Arm:
    """Return the arm of the catalogue that logs or a twin name; InputError asks for the file of any other."""
    if name not in CATALOGUE:
        raise InputError(f"{whose} of an arm {name!r}, which is described elsewhere; give its file as the arm")
    return load_arm(name)


def arm_of_twin(twin: TwinLike) -> Arm:
    """Return the arm of a twin: that of the run whose file it is, else the one of the catalogue that it names."""
    if isinstance(twin, Path | str):
        folder = RunFolder(Path(twin).parent)
        if folder.info.exists() and folder.twin.name == Path(twin).name:
            return Run.open(folder.path).arm
    return arm_named(as_twin(twin).arm, "the twin is")


def as_targets(given: Targets | None, arm: Arm, *, sets: int, seed: int) -> tuple[Array, Orientation | None]:
    """Return targets (S, K, 3) [m]: those given, those of a file, or drawn ones where none are given.

    Beside them how the tool is to be turned there, (S, K); None for points. InputError or FileError name those that
    the arm cannot reach: nothing is to move for them.
    """
    if given is None:
        return draw_targets(arm, sets=sets, seed=seed), None
    if isinstance(given, Path | str):
        points, turns = read_targets(Path(given), arm)
        return points[None], turns and turns[None]
    given = list(given) if isinstance(given, Iterator) else given  # else looking at them would leave none
    kinds = {isinstance(one, Pose) for one in given} if isinstance(given, Iterable) else set()
    if len(kinds) > 1:
        raise InputError("targets: some are poses and some are points; give a rejoint.Pose for each, or for none")
    if kinds == {True}:
        points, turns = placed(arm, cast("Sequence[Pose]", given))
        turns = turns and turns[None]
        require_reachable(arm, points[None], turns)
        return points[None], turns
    points = as_floats("targets", given, "(targets, 3) or (sets, targets, 3) in metres")
    if points.ndim not in (2, 3) or points.shape[-1] != 3:
        raise InputError(f"targets have shape {points.shape}, expected (targets, 3) or (sets, targets, 3) in metres")
    points = points[None] if points.ndim == 2 else points
    require_reachable(arm, points)
    return points, None
