"""Folder, settings and results of the experiments."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from pathlib import Path
from string import Formatter
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from rejoint.arms import Arm, Array
from rejoint.control.comparison.result import Protocol
from rejoint.control.targets import draw_targets
from rejoint.logs.runfolder import RunFolder
from rejoint.system.files import write_whole
from rejoint.system.progress import Progress, no_progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI, COLOURS = 120, 64
"""of a figure; chosen"""


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Size of the experiments."""

    sets: int = 5
    """the paper has one"""
    repetitions: int = 6
    """n of the paper's Table 4"""
    targets: int = 10
    """Park et al. 2024, section IV-A"""
    protocol: Protocol = field(default_factory=Protocol)
    """20 s per target, 10 mm"""
    agents: int = 512
    """Table 3"""
    updates: int | None = None
    """None: Table 3's 5000 time steps"""
    snapshot_every: int = 5
    """updates between policies of Fig. 12; chosen"""
    judged: int = 96
    """arms per such policy; chosen"""


FULL = Scale()
QUICK = Scale(
    sets=1,
    repetitions=2,
    targets=3,
    protocol=Protocol(dwell=2.0, hold=2.0),
    agents=16,
    updates=2,
    snapshot_every=2,
    judged=8,
)
"""Enough to try every step"""


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Folder and settings of all experiments."""

    folder: Path
    arm: Arm
    seed: int
    scale: Scale = FULL
    threads: int = 2
    """of simulations, and parallel trainings"""
    on_progress: Progress = no_progress

    @property
    def quick(self) -> bool:
        """Whether it is too small for a result."""
        return self.scale != FULL

    @cached_property
    def targets(self) -> Array:
        """(S, K, 3) [m] of all sets."""
        return draw_targets(self.arm, sets=self.scale.sets, count=self.scale.targets, seed=self.seed)

    def training(self, name: str) -> RunFolder:
        """Folder of a training (`rejoint.research.reproduction.trainings`)."""
        return RunFolder(self.folder / "trainings" / name)

    def draw(self, figure: Figure, key: str) -> None:
        """Save a figure of the page as a small PNG."""
        from PIL import Image

        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=DPI, facecolor="white", metadata={"Software": None})
        small = Image.open(buffer).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
        path = self.folder / "figures" / f"{key}.png"
        write_whole(path, lambda temporary: small.save(temporary, format="png", optimize=True))


class Printed(NamedTuple):
    """A number with its spread, as it is printed."""

    value: float
    text: str

    def __str__(self) -> str:
        return self.text


class Number(NamedTuple):
    """One number of the paper beside ours."""

    what: str
    ours: str
    """as printed, with unit and spread"""
    paper: str = ""
    """likewise; empty where the paper has none"""
    value: float | None = None
    """ours in that unit"""


class Grid(NamedTuple):
    """A further table of the page."""

    title: str
    headers: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, kw_only=True)
class Finished:
    """What an experiment found."""

    experiment: str
    software: str
    text: tuple[str, ...]
    """paragraphs"""
    numbers: tuple[Number, ...]
    grids: tuple[Grid, ...]


Found = dict[str, Any]
"""Values by name: numbers, text or `Printed`; ``grids`` are further tables"""


class Experiment(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An experiment of the paper; text and numbers are formats of what is measured."""

    name: str = ""
    """on the command line"""
    also: str = ""
    """a second name"""
    title: str
    measure: str
    """module and function in this package"""
    trainings: tuple[str, ...] = ()
    text: tuple[str, ...]
    numbers: tuple[tuple[str, ...], ...]
    """what, ours, perhaps the paper's"""
    readings: tuple[str, ...]
    """how we read open points"""
    figure: str = ""
    """its file is FIGURE.png"""
    alt: str = ""
    caption: str = ""

    def run(self, bench: Bench) -> Found:
        """Measure."""
        module, _, name = self.measure.partition(".")
        found: Found = getattr(import_module(f"rejoint.research.reproduction.{module}"), name)(bench)
        return found

    def finish(self, found: Found, software: str) -> Finished:
        """Put what was ``found`` into words."""

        def number(what: str, ours: str, paper: str = "") -> Number:
            value = found[next(name for _, name, _, _ in Formatter().parse(ours) if name)]
            value = value.value if isinstance(value, Printed) else value
            return Number(what, ours.format_map(found), paper, None if isinstance(value, str) else float(value))

        return Finished(
            experiment=self.name,
            software=software,
            text=tuple(paragraph.format_map(found) for paragraph in self.text),
            numbers=tuple(number(*row) for row in self.numbers),
            grids=tuple(found.get("grids", ())),
        )
