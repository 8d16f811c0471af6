"""What an experiment is given and what it hands back."""

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
"""Trainings of each kind (chosen: the smallest number that shows a spread)."""


@dataclass(frozen=True, kw_only=True)
class Scale:
    """How much is run."""

    sets: int = 5
    """target sets; the paper has one"""
    repetitions: int = 6
    """n of the paper's Table 4"""
    targets: int = 10
    """Park et al. 2024, section IV-A"""
    protocol: Protocol = field(default_factory=Protocol)
    """20 s per target, 10 mm"""
    agents: int = 512
    """Table 3"""
    updates: int | None = None
    """of a training; None: Table 3's 5000 time steps"""
    snapshot_every: int = 5
    """updates between policies of Fig. 12 (chosen)"""
    judged: int = 96
    """arms on which such a policy is judged (chosen)"""


FULL = Scale()
QUICK = Scale(
    sets=1, repetitions=2, targets=3, protocol=Protocol(dwell=2.0, hold=2.0), agents=16, updates=2, snapshot_every=2,
    judged=8,
)  # fmt: skip
"""Enough to try every step, too little for a result."""


@dataclass(frozen=True, kw_only=True)
class Number:
    """One number of the paper beside ours."""

    what: str
    ours: str
    """as it is printed, with unit and spread"""
    paper: str = ""
    """likewise; empty where the paper prints none"""
    value: float | None = None
    """ours, bare, in the unit of ``ours``"""

    def __post_init__(self) -> None:
        if self.value is not None:
            object.__setattr__(self, "value", float(self.value))  # JSON knows no NumPy scalars


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """A figure of the page."""

    key: str
    """its file is KEY.png"""
    alt: str
    """what it shows, for those who do not see it"""
    caption: str


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A table of the page beyond the numbers."""

    title: str
    headers: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, kw_only=True)
class Findings:
    """What an experiment found."""

    text: tuple[str, ...]
    """what was run and what came out, in paragraphs"""
    numbers: tuple[Number, ...]
    readings: tuple[str, ...] = ()
    """where the paper is open, and what was run"""
    grids: tuple[Grid, ...] = ()
    drawings: tuple[Drawing, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Finished:
    """A finished experiment, as it is kept."""

    experiment: str
    seed: int
    quick: bool
    software: str
    seconds: float
    """wall-clock time it took, trainings that it waited for not counted"""
    findings: Findings


@dataclass(frozen=True, kw_only=True, eq=False)
class Bench:
    """Where an experiment works."""

    folder: Path
    arm: Arm
    seed: int
    scale: Scale = FULL
    threads: int = 2
    """of simulations, and trainings at a time"""
    on_progress: Progress = no_progress

    @property
    def quick(self) -> bool:
        """Whether less is run than a result needs."""
        return self.scale != FULL

    def training(self, name: str) -> RunFolder:
        """Folder of a training, see `rejoint.research.reproduction.trainings`."""
        return RunFolder(self.folder / "trainings" / name)

    def draw(self, figure: Figure, drawing: Drawing) -> Drawing:
        """Keep a figure as a file of the page."""
        from rejoint.research.reproduction.figures import save

        save(figure, self.folder / "figures" / f"{drawing.key}.png")
        return drawing


@dataclass(frozen=True, kw_only=True, eq=False)
class Experiment:
    """One experiment of the paper."""

    name: str
    """as it is chosen on the command line"""
    also: tuple[str, ...] = ()
    """other names that choose it"""
    title: str
    about: str
    """one line for the list"""
    trainings: tuple[str, ...] = ()
    """trainings that must be finished before it runs"""
    run: Callable[[Bench], Findings]
