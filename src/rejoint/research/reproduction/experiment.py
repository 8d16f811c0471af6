"""Inputs and results of an experiment."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rejoint.arms import Arm
from rejoint.control.comparison.result import Protocol
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.system.files import write_whole
from rejoint.system.progress import Progress, no_progress
from rejoint.system.statistics import Estimate, Spread

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI, COLOURS = 120, 64
"""of a figure; chosen"""
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

    @classmethod
    def of(cls, what: str, value: float | np.floating[Any], shown: str, paper: str = "") -> Number:
        """Our ``value``, as ``shown`` formats it."""
        return cls(what=what, ours=shown.format(value), paper=paper, value=float(value))  # JSON knows no NumPy scalars

    @classmethod
    def spread(cls, what: str, found: Spread | None, paper: str = "", places: tuple[int, int] = (2, 2)) -> Number:
        """Mean and deviation [m] in millimetres, with ``places``."""
        if found is None:
            return cls(what=what, ours="-", paper=paper)
        mean, std = 1e3 * found.mean.value, "" if found.std is None else f" ± {1e3 * found.std:.{places[1]}f}"
        return cls(what=what, ours=f"{mean:.{places[0]}f}{std} mm", paper=paper, value=mean)


def likely(estimate: Estimate, factor: float, places: int) -> str:
    """Interval in brackets, or empty."""
    if estimate.low is None or estimate.high is None:
        return ""
    return f" ({factor * estimate.low:.{places}f} to {factor * estimate.high:.{places}f})"


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

    def draw(self, figure: Figure, key: str, alt: str, caption: str) -> Drawing:
        """Save a figure of the page as a small PNG."""
        from PIL import Image

        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=DPI, facecolor="white", metadata={"Software": None})
        small = Image.open(buffer).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
        path = self.folder / "figures" / f"{key}.png"
        write_whole(path, lambda temporary: small.save(temporary, format="png", optimize=True))
        return Drawing(key=key, alt=alt, caption=caption)


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
