"""Options that several commands share, so that they read the same everywhere."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Mapping
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_type_hints

import typer

from rejoint.arms import Arm
from rejoint.arms.draft import UnfinishedArmError
from rejoint.arms.inertia import Payload as LoadedWith
from rejoint.arms.loading import read_arm, write_unfinished
from rejoint.cli.console import Terminal
from rejoint.logs.runfolder.folder import LOGS, RunFolder
from rejoint.robots import DEFAULT_ARM, place_of
from rejoint.runs.run import Run as OpenRun
from rejoint.runs.run import newest_or_new
from rejoint.session.settings import Settings
from rejoint.system.errors import InputError

ROBOT_HELP = (
    "Robot: emulated:PROFILE (in process), tcp://HOST:PORT, serial:///dev/ttyAMA0, or feetech:///dev/ttyACM0 (SO-101)."
)


def meaning(field: str) -> str:
    """Return what a field of `Settings` means, as its documentation says it: without the unit and what is Python's."""
    source = inspect.getsource(Settings)
    found = re.search(
        rf'^    {field}: [^\n]*\n    """(?:\[\S+\] )?(.*?)(?:\. In\s+Python .*?)?"""', source, re.M | re.S
    )
    assert found is not None, field  # noqa: S101 - a test asks for each
    return found[1][:1].upper() + re.sub(r"\s+", " ", found[1][1:])


Robot = Annotated[str, typer.Argument(help=ROBOT_HELP, metavar="ROBOT")]
OptionalRobot = Annotated[
    str | None, typer.Argument(help=f"{ROBOT_HELP} By default emulated:worn.", metavar="ROBOT", show_default=False)
]
LogsOption = Annotated[
    Path | None, typer.Option("--logs", help="Folder of run logs (see `rejoint import`) instead of a robot or a run.")
]
Run = Annotated[Path, typer.Argument(help="Run folder.", metavar="RUN")]
RunOption = Annotated[Path | None, typer.Option("--run", help="Run folder; by default a new one below runs/.")]
ArmOption = Annotated[
    str | None,
    typer.Option("--arm", help="Arm: mycobot280 (default), so101, or a .urdf, .xml (MJCF) or .toml file."),
]
Base = Annotated[str | None, typer.Option(help="Body of the file at which the arm begins; by default its root.")]
Tip = Annotated[str | None, typer.Option(help="Body or site of the file at which the arm ends.")]
Hold = Annotated[
    str | None,
    typer.Option(
        help="Joints of the file that are not driven, and where they stand: torso_lift_joint=200mm,waist=30deg. Joints "
        "that slide are never driven; they stand at zero where nothing is said."
    ),
]
Seed = Annotated[int, typer.Option(help="Seed of everything random.", min=0)]
RunSeed = Annotated[int | None, typer.Option("--seed", help=f"{meaning('seed')}.", min=0)]
Quick = Annotated[bool, typer.Option("--quick", help="Do little of everything, for a first try; no result.")]
RepairSets = Annotated[
    int | None, typer.Option("--sets", help="Target sets of ten targets each; by default 3, on a real arm 1.", min=1)
]
RepairRepetitions = Annotated[
    int | None,
    typer.Option("--repetitions", help="Repetitions of every target set; by default 2, on a real arm 1.", min=1),
]
Json = Annotated[bool, typer.Option("--json", help="End standard output with one line of JSON.")]
Preset = Annotated[
    str,
    typer.Option(
        help="Training recipe: default, scratch (from random weights), or paper (Park et al. 2024 to the letter)."
    ),
]
Measure = Annotated[
    str | None,
    typer.Option(
        "--measure",
        help="What measures the tool: touch (you, with a ruler or calliper), camera, camera=NUMBER, tracker=FILE (CSV, "
        "goes on being written), none; to `calibrate`, which moves nothing then, also camera=PICTURES or points=FILE. "
        "By default an emulated arm tells, and a real one is not calibrated.",
    ),
]
Targets = Annotated[Path | None, typer.Option(help="CSV file of targets in mm: x,y,z, and perhaps an orientation.")]
Controllers = Annotated[
    str,
    typer.Option(
        help="Comma-separated controllers, such as default,integrator,policy; all: those that suit the robot."
    ),
]
Live = Annotated[
    str | None,
    typer.Option(
        "--live",
        metavar="[HOST:PORT]",
        help="Show the arm on a page while it moves, by default at 127.0.0.1:8080, with a button that holds it.",
    ),
]
Full = Annotated[
    bool,
    typer.Option("--full", help="On a real arm, drive every controller to all targets and eliminate none."),
]


class ArmPick(NamedTuple):
    """What a user says of the arm: a name or a file, which part of it, and which joints are held."""

    source: str | None = None
    base: str | None = None
    tip: str | None = None
    hold: str | None = None


def choose_arm(terminal: Terminal, pick: ArmPick, robot: str | None = None) -> Arm:
    """Load an arm, by default the one that ``robot`` is, and say what its description left open.

    Without a rest posture the arm is written to a TOML file in the working folder, for its owner to give it.
    """
    source, base, tip, hold = pick
    source = source or (DEFAULT_ARM if robot is None else place_of(robot).default_arm)
    try:
        loaded = read_arm(source, base=base, tip=tip, hold=held_positions(hold))
    except UnfinishedArmError as error:
        if source.endswith(".toml"):
            raise
        path = Path(f"{re.sub(r'[^A-Za-z0-9_-]+', '-', error.arm.name)}.toml")
        if path.exists():
            raise InputError(f"{error}, and that as --arm; {path} is there already, so none was written") from error
        line = write_unfinished(path, error.arm, error.notes)
        raise InputError(f"{error}: {path} is written, give it in line {line}, and the file as --arm") from error
    for note in loaded.notes:
        terminal.say(f"arm {loaded.arm.name}: {note}")
    return loaded.arm


_HOLD_UNITS = {"mm": 1e-3, "m": 1.0, "deg": math.pi / 180, "rad": 1.0}


def held_positions(text: str | None) -> dict[str, float]:
    """Read ``torso_lift_joint=200mm,waist=30deg`` as positions in metres and radians; InputError for anything else."""
    found = {}
    for part in text.split(",") if text else []:
        name, _, place = part.strip().partition("=")
        number = re.fullmatch(r"\s*([-+]?(?:\d+\.?\d*|\.\d+))\s*(mm|m|deg|rad)", place)
        if not name or number is None:
            raise InputError(f"--hold {text!r}: expected joints with places, as torso_lift_joint=200mm,waist=30deg")
        found[name] = float(number[1]) * _HOLD_UNITS[number[2]]
    return found


def run_of_logs(terminal: Terminal, logs: Path, path: Path | None, seed: int, pick: ArmPick) -> OpenRun:
    """Prepare the run of a folder of logs: the one at ``path``, or the newest one of these logs, or a new one."""
    robot, begun = f"{LOGS}{logs}", path is not None and RunFolder(path).info.exists()
    if path is not None and begun and not any(pick):
        return OpenRun.plan(path, robot, OpenRun.open(path).arm, seed)
    chosen = choose_arm(terminal, pick)
    return OpenRun.plan(path or newest_or_new(robot, chosen, seed)[0], robot, chosen, seed)


def period_seconds(text: str | None) -> tuple[float, float] | None:
    """Read ``50`` or ``20-30`` [ms] as an interval [s]; InputError for anything else."""
    if text is None:
        return None
    try:
        parts = [float(part) / 1e3 for part in text.split("-")]
    except ValueError:
        parts = []
    if len(parts) not in (1, 2) or not 0.001 <= parts[0] <= parts[-1] <= 1.0:
        raise InputError(f"--period {text!r}: expected milliseconds such as 50 or 20-30, between 1 and 1000")
    return parts[0], parts[-1]


def controller_names(text: str) -> tuple[str, ...]:
    """Read a comma-separated list; empty for ``all``, InputError where it holds no name."""
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        raise InputError(f"{text!r}: expected names with commas between them, or all")
    return () if names == ("all",) else names


def payload_of(text: str | None) -> LoadedWith | None:
    """Read ``0.15`` [kg] or ``0.15@0,0,30`` [kg, mm]; InputError for anything else."""
    if text is None:
        return None
    mass, _, place = text.partition("@")
    try:
        kilograms, (x, y, z) = float(mass), map(float, (place or "0,0,0").split(","))
    except ValueError as error:
        raise InputError(f"--payload {text!r}: expected kg, such as 0.15, or with x,y,z in mm: 0.15@0,0,30") from error
    return LoadedWith(mass=kilograms, com=point_of(x, y, z, "--payload"))


def tool_of(text: str | None) -> tuple[float, float, float] | None:
    """Read ``x,y,z`` in mm as metres; InputError for anything else."""
    if text is None:
        return None
    try:
        x, y, z = map(float, text.split(","))
    except ValueError as error:
        raise InputError(f"--tool {text!r}: expected x,y,z in mm, such as 0,0,50") from error
    return point_of(x, y, z, "--tool")


def point_of(x: float, y: float, z: float, option: str = "goto") -> tuple[float, float, float]:
    """Return a place in mm as metres; InputError for lengths of the size of metres."""
    if 0.0 < max(abs(x), abs(y), abs(z)) < 1.0:
        raise InputError(f"{option}: x,y,z of {x:g},{y:g},{z:g} mm look like metres; give millimetres, such as 0,0,50")
    return 1e-3 * x, 1e-3 * y, 1e-3 * z


class SharedOption(NamedTuple):
    """An option that is a field of `Settings`, whose documentation is its help."""

    kind: object = str | None
    """type of the command's parameter"""
    read: Callable[[Any], object] = lambda given: given
    """makes the field of what the user wrote"""
    form: str = ""
    """unit, and how it is written"""
    field: str = ""
    """of `Settings`, where it is not called like the option"""
    limits: Mapping[str, float] = {}

    def parameter(self, name: str) -> tuple[object, object]:
        """Return annotation and default of a command's parameter called ``name``."""
        field = self.field or name
        what, default, usual = meaning(field).partition("; by default")
        text, flag = f"{what}{self.form and f', {self.form}'}{default}{usual}.", f"--{name.replace('_', '-')}"
        return Annotated[self.kind, typer.Option(flag, help=text, **self.limits)], getattr(Settings, field)  # type: ignore[arg-type]


SHARED = {
    "controller": SharedOption(),
    "dwell": SharedOption(float, form="in seconds", limits={"min": 0.1}),
    "within": SharedOption(
        float | None, lambda mm: None if mm is None else 1e-3 * mm, "in mm", limits={"min": 0.01, "max": 100.0}
    ),
    "calibration": SharedOption(),
    "payload": SharedOption(str | None, payload_of, "in kg: 0.15, or 0.15@x,y,z with its centre in mm from there"),
    "tool": SharedOption(str | None, tool_of, "in mm: x,y,z"),
    "camera": SharedOption(field="eye"),
    "period": SharedOption(str | None, period_seconds, "in ms, such as 50 or 20-30"),
    "seed": SharedOption(int | None, limits={"min": 0}),
    "dry_run": SharedOption(bool),
}
"""Options of several commands that become fields of `Settings`"""


ARM = {"arm": ArmOption, "base": Base, "tip": Tip, "hold": Hold}
"""Options of which an `ArmPick` is made"""


def with_arm(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options `ARM`; it receives them as ``pick``."""
    return _with_options(
        command, "pick", {name: (to, None) for name, to in ARM.items()}, lambda words: ArmPick(*words.values())
    )


def with_settings(*names: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the shared options ``names``; it receives them as ``settings``."""

    def settings(words: dict[str, Any]) -> Settings:
        return Settings(**{SHARED[name].field or name: SHARED[name].read(words[name]) for name in names})  # type: ignore[arg-type]

    options = {name: SHARED[name].parameter(name) for name in names}
    return lambda command: _with_options(command, "settings", options, settings)


def _with_options(
    command: Callable[..., None],
    what: str,
    options: Mapping[str, tuple[object, object]],
    make: Callable[[dict[str, Any]], object],
) -> Callable[..., None]:
    """Return the command with ``options`` (annotation, default) instead of its parameter ``what``, made of them."""

    @wraps(command)
    def with_options(**words: Any) -> None:  # noqa: ANN401 - what the user wrote
        command(**{what: make({name: words.pop(name) for name in options})}, **words)

    hints = get_type_hints(command, include_extras=True)
    own = [one.replace(annotation=hints[one.name]) for one in signature(command).parameters.values()]
    more = [
        Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=to)
        for name, (to, default) in options.items()
    ]
    kept = [one.replace(kind=Parameter.KEYWORD_ONLY) for one in own if one.name != what]
    last = [one for one in kept if one.name in ("json", "pick", "settings")]
    listed = [*[one for one in kept if one not in last], *more, *last]
    with_options.__signature__ = Signature(listed)  # type: ignore[attr-defined]
    with_options.__annotations__ = {one.name: one.annotation for one in listed}
    return with_options
