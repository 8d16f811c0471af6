"""Inputs and results of an experiment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from rejoint.arms import Arm
from rejoint.control.comparison.result import Protocol
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.system.progress import Progress, no_progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SEEDS = 3
"""Trainings of each kind; chosen"""


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
class Number:
    """One number of the paper beside ours."""

    what: str
    ours: str
    """as printed, with unit and spread"""
    paper: str = ""
    """likewise; empty where the paper has none"""
    value: float | None = None
    """ours in that unit"""

    def __post_init__(self) -> None:
        if self.value is not None:
            object.__setattr__(self, "value", float(self.value))  # JSON knows no NumPy scalars


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """A figure of the page."""

    key: str
    """its file is KEY.png"""
    alt: str
    """text alternative"""
    caption: str


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A further table of the page."""

    title: str
    headers: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, kw_only=True)
class Findings:
    """What an experiment found."""

    text: tuple[str, ...]
    """paragraphs"""
    numbers: tuple[Number, ...]
    readings: tuple[str, ...] = ()
    """how we read open points"""
    grids: tuple[Grid, ...] = ()
    drawings: tuple[Drawing, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Finished:
    """A stored experiment."""

    experiment: str
    seed: int
    quick: bool
    software: str
    seconds: float
    """wall-clock time without trainings"""
    findings: Findings


@dataclass(frozen=True, kw_only=True, eq=False)
class Bench:
    """Folder and settings of an experiment."""

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

    def training(self, name: str) -> RunFolder:
        """Folder of a training (`rejoint.research.reproduction.trainings`)."""
        return RunFolder(self.folder / "trainings" / name)

    def draw(self, figure: Figure, drawing: Drawing) -> Drawing:
        """Save a figure of the page."""
        from rejoint.research.reproduction.figures import save

        save(figure, self.folder / "figures" / f"{drawing.key}.png")
        return drawing


@dataclass(frozen=True, kw_only=True, eq=False)
class Experiment:
    """One experiment of the paper."""

    name: str
    """on the command line"""
    also: tuple[str, ...] = ()
    """aliases"""
    title: str
    about: str
    """one line for the list"""
    trainings: tuple[str, ...] = ()
    run: Callable[[Bench], Findings]
