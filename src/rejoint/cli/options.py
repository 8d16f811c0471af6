"""The options that commands share, each declared once, and the call of a command that receives them."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, TypeVar, get_type_hints
from urllib.parse import urlsplit

import numpy as np
import typer

from rejoint.arms import Arm, Box
from rejoint.arms.inertia import Payload as LoadedWith
from rejoint.arms.loading import read_arm
from rejoint.cli import show, texts
from rejoint.cli.console import OPTION, Terminal
from rejoint.control.recording import Observer, Observers
from rejoint.logs.runfolder import LOGS, RunFolder
from rejoint.robots import DEFAULT_ARM, place_of
from rejoint.runs.fleet.file import FleetArm, named_arm
from rejoint.runs.run import Run as OpenRun
from rejoint.session.inputs import Settings
from rejoint.system.errors import InputError, UnsavedError
from rejoint.system.extras import compiles_first
from rejoint.system.progress import Progress, no_progress
from rejoint.system.shell import host_and_port

if TYPE_CHECKING:
    from rejoint.pages.live.view import LiveView

T = TypeVar("T")


class ArmPick(NamedTuple):
    """What a user says of the arm: a name or a file, which part of it, and which joints are held."""

    arm: str | None = None
    base: str | None = None
    tip: str | None = None
    hold: str | None = None


class Call(Terminal, Observer):
    """One call of a command: what the user wrote in the options that commands share, and the observer of its arm.

    It shows what the arm does, and the stages of a repair.
    """

    def __init__(self, given: Mapping[str, Any]) -> None:
        """Take the shared options by their fields in `Settings`, in `ArmPick` or here."""
        self.settings = Settings(**{name: given[name] for name in Settings.__dataclass_fields__ if name in given})
        self.pick = ArmPick(**{name: given[name] for name in ArmPick._fields if name in given})
        self.named = FleetArm(name="", address="")
        """arm given by name"""
        self.code = 0
        """exit code"""
        self._bar: Progress = no_progress
        self._view: LiveView | None = None
        self._title = ""
        self.live = given.get("live")
        super().__init__(json=given["json"], dry=self.settings.dry_run)

    def address(self, robot: str) -> str:
        """Return the address of a robot that may be given by name; what is known of it holds by default."""
        self.named = named_arm(robot) or self.named
        return self.named.address or robot

    def arm(self, robot: str | None = None) -> Arm:
        """Load the arm, by default the one that ``robot`` is, and say what its description left open."""
        source, base, tip, hold = self.pick
        source = source or self.named.description or (DEFAULT_ARM if robot is None else place_of(robot).default_arm)
        loaded = read_arm(source, base=base, tip=tip, hold=held_positions(hold))
        for note in loaded.notes:
            self.message(f"arm {loaded.arm.name}: {note}")
        return loaded.arm

    def job(self, robot: str, path: Path | None, seed: int) -> OpenRun:
        """Prepare the run of a robot or of logs.

        It is the one at ``path``, else the newest interrupted one, or a new one.
        """
        if path is not None and RunFolder(path).info.exists() and not (any(self.pick) or self.named.description):
            chosen = OpenRun.open(path).arm
        else:
            chosen = self.arm(None if robot.startswith(LOGS) else robot)
        return OpenRun.plan(path, robot, chosen, seed, name=self.named.name)

    def do(self, work: Callable[..., T], *given: object, **options: object) -> T:
        """Do a stage, ``work`` of the front door, and print its result, also one cut short."""
        name = work.__name__
        with self.watched(name) as observer:
            found = work(*given, observer=observer, **options)
        if not (self.settings.dry_run and name in ("diagnose", "gains")):  # of a simulation they say nothing of the arm
            self.show(show.stage(name, found))
        return found

    @contextmanager
    def watched(self, title: str, *, bar: bool = True) -> Iterator[Observer]:
        """Show what an arm does, on the page too where one is asked for, and a result of `show` that is cut short."""
        self.say_compiling()
        self._title = title
        with ExitStack() as stack, self.bars:
            if self.live is not None:
                from rejoint.pages.live.view import LiveView

                host, port = host_and_port(OPTION, self.live)
                self._view = stack.enter_context(LiveView(host, port))
                self.message(f"Live view: {self._view.address}")
                self.say_open(host)
                self._view.begin(title)
            if bar:
                self._show_bar(title)
            try:
                yield self if self._view is None else Observers(self, self._view)
            except UnsavedError as error:
                self.partial(error.result)
                raise

    def say_compiling(self) -> None:
        """Say that the first motion will take longer than others, where it will."""
        if compiles_first():
            self.message("The first motion compiles its loops, once: about 15 s.")

    def _show_bar(self, title: str) -> None:
        self._bar = self.bars.enter_context(self.bar(title))

    # --- as an observer -----------------------------------------------------------------------------

    def progress(self, share: float, what: str) -> None:
        """Move the bar."""
        self._bar(share, what)

    def stage(self, stage: Any) -> None:  # noqa: ANN401 - a `Stage`
        """Show how a stage of a repair stands."""
        self.bars.close()
        if stage.state != "done":
            heading = f"{stage.number}/{stage.total}  {texts('rejoint.cli')['stages'][stage.name]}"
            self.notes.print(f"\n[bold]{heading}[/bold]")
            if self._view is not None:
                self._view.begin(heading)
        if stage.state == "kept":
            self.message(f"already done, as it was asked for then: {stage.file}")
        if stage.state != "started":
            self.show(show.stage(stage.name, stage.result))
            return
        self._title = stage.name
        self._show_bar(stage.name)

    def partial(self, result: object) -> None:
        """Print what was done until an error."""
        self.bars.close()
        self.show(show.stage(self._title, result))

    def served(self, address: str) -> None:
        """Print where a served arm is."""
        self.message(f"The arm is served at {address}  (Ctrl-C brings it to a hold and ends)")
        self.say_open(urlsplit(address).hostname or "localhost")


def held_positions(text: str | None) -> dict[str, float | str]:
    """Read ``torso_lift_joint=200mm,waist=30deg`` as places with units; InputError for anything else."""
    pairs = [part.partition("=") for part in listed(text or "")]
    if not all(name and place for name, _, place in pairs):
        raise InputError(f"--hold {text!r}: expected joints with places, as torso_lift_joint=200mm,waist=30deg")
    return {name: place for name, _, place in pairs}


def period_seconds(text: str) -> tuple[float, float]:
    """Read ``50`` or ``20-30`` [ms] as an interval [s]; InputError for anything else."""
    first, _, last = text.partition("-")
    refusal = f"--period {text!r}: expected milliseconds such as 50 or 20-30, between 1 and 1000"
    low, high = _numbers(f"{first},{last or first}", 2, refusal)
    if not 1.0 <= low <= high <= 1000.0:
        raise InputError(refusal)
    return 1e-3 * low, 1e-3 * high


def listed(text: str) -> tuple[str, ...]:
    """Read a comma-separated list."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def controller_names(text: str) -> tuple[str, ...]:
    """Read a comma-separated list; empty for ``all``, InputError where it holds no name."""
    names = listed(text)
    if not names:
        raise InputError(f"{text!r}: expected names with commas between them, or all")
    return () if names == ("all",) else names


def payload_of(text: str) -> LoadedWith:
    """Read ``0.15`` [kg] or ``0.15@0,0,30`` [kg, mm]; InputError for anything else."""
    mass, _, place = text.partition("@")
    expected = "kg, such as 0.15, or with x,y,z in mm: 0.15@0,0,30"
    kilograms, *com = _numbers(f"{mass},{place or '0,0,0'}", 4, f"--payload {text!r}: expected {expected}")
    return LoadedWith(mass=kilograms, com=point_of("--payload", *com))


def _numbers(text: str, count: int, refusal: str) -> list[float]:
    try:
        found = list(map(float, text.split(",")))
    except ValueError:
        found = []
    if len(found) != count:
        raise InputError(refusal)
    return found


def point_of(option: str, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a place in mm as metres; InputError for what is no number, or of the size of metres."""
    largest = np.max(np.abs((x, y, z)))
    if not (largest == 0.0 or 1.0 <= largest < np.inf):
        raise InputError(f"{option}: x,y,z of {x:g},{y:g},{z:g} are no millimetres (metres?); give such as 0,0,50")
    return 1e-3 * x, 1e-3 * y, 1e-3 * z


def keyword(name: str, kind: object, entry: str | Mapping[str, Any], default: object) -> Parameter:
    """Return a command's parameter: an argument or an option, as an ``entry`` of `texts` describes it."""
    words = {"help": entry} if isinstance(entry, str) else dict(entry)
    argument, flag = words.pop("argument", None), words.pop("flag", f"--{name.replace('_', '-')}")
    described = typer.Argument(metavar=argument, **words) if argument else typer.Option(flag, **words)
    return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, described])


def box_of(text: str) -> Box:
    """Read ``x,y,z,x,y,z`` of two opposite corners in mm; InputError for anything else."""
    expected = "two opposite corners x,y,z,x,y,z in mm, such as 150,-200,0,300,200,120"
    numbers = _numbers(text, 6, f"--keep-out {text!r}: expected {expected}")
    corners = [point_of("--keep-out", *numbers[k : k + 3]) for k in (0, 3)]
    return Box(lower=np.min(corners, axis=0), upper=np.max(corners, axis=0))


KINDS = {
    "dwell": float,
    "within": float | None,
    "keep_out": list[str],
    "seed": int | None,
    "dry_run": bool,
    "json": bool,
}
"""Types of shared options that are no text"""
READ: dict[str, Callable[[Any], object]] = {
    "within": lambda mm: 1e-3 * mm,
    "payload": payload_of,
    "tool": lambda text: point_of(
        "--tool", *_numbers(text, 3, f"--tool {text!r}: expected x,y,z in mm, such as 0,0,50")
    ),
    "keep_out": lambda texts: tuple(map(box_of, texts)),
    "period": period_seconds,
}
"""What makes fields of `Settings` of shared options, where it is not what the user wrote"""


def _read(name: str, given: Any) -> object:  # noqa: ANN401 - what the user wrote
    return READ[name](given) if name in READ and given is not None else given


def takes(command: Callable[..., object]) -> Callable[..., None]:
    """Give a command its options, as `texts` describes them: its own, what it ``takes`` of the shared ones, ``json``.

    It takes a `Call`, and returns the object of its last line with --json; None prints none. Of a parameter that is a
    dataclass, the fields that it ``fills`` are options.
    """
    known, ours, hints = texts("rejoint.cli"), texts(command.__module__.rpartition(".")[0]), get_type_hints(command)
    mine = ours[command.__name__.rstrip("_")]
    entries, fills, shown = known["all"] | ours["all"] | mine, mine.get("fills", {}), []
    for one in [*signature(command).parameters.values()][1:]:
        kind = hints[one.name]
        if one.name in fills:
            kinds = get_type_hints(kind)
            shown += [keyword(name, kinds[name], entries[name], getattr(kind, name)) for name in fills[one.name]]
        else:
            shown.append(keyword(one.name, kind, entries[one.name], one.default))
    shared = [name for name in known["shared"] if name in (*mine.get("takes", ()), "json")]
    for name in shared:
        kind = KINDS.get(name, str | None)
        default = getattr(Settings, name, False if kind is bool else None)
        shown.append(keyword(name, kind, known["shared"][name], default))

    @wraps(command)
    def run(**words: Any) -> None:  # noqa: ANN401 - what the user wrote
        call = Call({name: _read(name, words.pop(name)) for name in shared})
        if words.get("robot") is not None:
            words["robot"] = call.address(words["robot"])
        for name, parts in fills.items():
            words[name] = hints[name](**{part: words.pop(part) for part in parts})
        value = command(call, **words)
        if value is not None:
            call.finish(value)
        if call.code:
            raise typer.Exit(call.code)

    run.__signature__ = Signature(shown)  # type: ignore[attr-defined]
    run.__annotations__ = {one.name: one.annotation for one in shown}
    return run
