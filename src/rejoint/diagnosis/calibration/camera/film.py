"""A film: pictures of a board in many postures of one arm, with what the encoders said at each."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.camera.board import Board, BoardView
from rejoint.arms.camera.views import Unusable
from rejoint.system.errors import InputError


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """One picture, and the posture in which it was taken."""

    number: int
    """its place in the plan, from 1"""
    position: Array
    """(n,) [rad] what the encoders said while the arm stood"""
    approach: Array
    """(n,) [rad] where they came from; NaN where nobody knows"""
    posture: int
    """number of the posture: shots of the same number are visits of it from different sides"""
    side: int
    """1: come to with joints turning upwards, -1: downwards, 0: not known"""
    seen: BoardView | Unusable

    @property
    def name(self) -> str:
        """Name of the picture."""
        return self.seen.name


@dataclass(frozen=True, kw_only=True, eq=False)
class Film:
    """Pictures of one size, taken by one camera of one board, nothing of which was shifted meanwhile."""

    board: Board
    carried: str
    """what the tool carries: ``board`` or ``camera`` (`rejoint.arms.camera.rig.MOUNTINGS`)"""
    size: tuple[int, int] | None = None
    """[px] width and height of the pictures; None before the first"""
    shots: tuple[Shot, ...] = field(default=())
    """in the order of their numbers"""
    afresh: bool = False
    """whether no earlier calibration is to be believed with it"""

    def __len__(self) -> int:
        """Count the pictures."""
        return len(self.shots)

    def with_shot(self, shot: Shot, size: tuple[int, int]) -> Film:
        """Return the film with one more picture of ``size``; InputError where the others have another one."""
        if self.size is not None and size != self.size:
            raise InputError(
                f"picture {shot.name} has {size[0]} x {size[1]} px, those before it {self.size[0]} x {self.size[1]}; "
                "take all of them with one camera and one setting"
            )
        return replace(self, size=size, shots=tuple(sorted((*self.shots, shot), key=lambda one: one.number)))

    @property
    def usable(self) -> tuple[Shot, ...]:
        """Those in which the board is seen well."""
        return tuple(shot for shot in self.shots if isinstance(shot.seen, BoardView))

    @property
    def unusable(self) -> tuple[Unusable, ...]:
        """The others, and why."""
        return tuple(shot.seen for shot in self.shots if isinstance(shot.seen, Unusable))

    @property
    def views(self) -> tuple[BoardView, ...]:
        """What the usable ones show."""
        return tuple(shot.seen for shot in self.shots if isinstance(shot.seen, BoardView))

    def numbered(self, first: int, last: int) -> Film:
        """Return those of a part of the plan, both ends included."""
        return replace(self, shots=tuple(shot for shot in self.shots if first <= shot.number <= last))

    def again(self) -> Film:
        """Return what an interrupted film goes on from: what could not be used is taken again."""
        return replace(self, shots=self.usable)


def positions(shots: tuple[Shot, ...], arm: Arm) -> tuple[Array, Array]:
    """Return the encoders (V, n) [rad] at shots, and where they came from (V, n)."""
    rows = [(shot.position, shot.approach) for shot in shots]
    return tuple(np.array([row[i] for row in rows]).reshape(-1, arm.joints) for i in (0, 1))  # type: ignore[return-value]
