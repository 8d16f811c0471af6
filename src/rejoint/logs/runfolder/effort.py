"""Cost of the stages of a repair."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from rejoint.logs.runfolder.folder import RunFolder
from rejoint.system.errors import FileError
from rejoint.system.files import read_json, write_json


@dataclass(frozen=True, kw_only=True)
class StageCost:
    """Cost of a stage, all attempts together."""

    name: str
    wall: float = 0.0
    """[s] wall clock; 0: unknown"""
    moving: float = 0.0
    """[s] of the arm"""
    travel: float = 0.0
    """[rad] of all joints"""


@dataclass(frozen=True, kw_only=True)
class Effort:
    """Cost of all stages, in order."""

    stages: tuple[StageCost, ...] = ()

    @property
    def wall(self) -> float:
        """[s] of all stages."""
        return sum(stage.wall for stage in self.stages)

    @property
    def moving(self) -> float:
        """[s] of all stages."""
        return sum(stage.moving for stage in self.stages)

    @property
    def travel(self) -> float:
        """[rad] of all stages."""
        return sum(stage.travel for stage in self.stages)


def cost(one: StageCost | Effort) -> str:
    """In words."""
    time = f"{one.wall / 60:.1f} min"
    if not one.moving:
        return time
    turns = f"{one.travel / (2 * np.pi):.1f} turns of its joints"
    return f"{f'{time}; ' if one.wall else ''}{one.moving / 60:.1f} min of the arm's time with {turns}"


def add(folder: RunFolder, cost: StageCost) -> None:
    """Add a stage's cost to the run's file, if there."""
    if not folder.info.exists():
        return
    with suppress(FileError):
        _add(folder, cost)


def _add(folder: RunFolder, cost: StageCost) -> None:
    stages = {stage.name: stage for stage in (read_effort(folder) or Effort()).stages}
    sofar = stages.get(cost.name, StageCost(name=cost.name))
    stages[cost.name] = replace(
        sofar, wall=sofar.wall + cost.wall, moving=sofar.moving + cost.moving, travel=sofar.travel + cost.travel
    )
    write_json(folder.effort, Effort(stages=tuple(stages.values())))


def read_effort(folder: RunFolder) -> Effort | None:
    """Cost of a run's stages, or None."""
    return read_json(folder.effort, Effort) if folder.effort.exists() else None
