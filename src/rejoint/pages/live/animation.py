"""One arm on the page, frame by frame: what came from the ring, turned into what is drawn and said."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.workspace import reach
from rejoint.control.guard import GuardLimits
from rejoint.control.playback import Playback
from rejoint.pages.live import panel
from rejoint.pages.live.ring import Records, Ring
from rejoint.pages.live.skeleton import GHOST, LINKS, TARGET, TRAIL, TRUE, Skeleton, cell_of, css
from rejoint.pages.live.trails import Trails
from rejoint.pages.live.words import KEPT, guard_words

if TYPE_CHECKING:
    from rejoint.pages.live.ghost import Ghost
    from rejoint.pages.live.page import WebPage

SLOWER = 6
"""frames for each time that texts and the curve are written (chosen: nobody reads faster than four times a second)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Subject:
    """An arm that is shown."""

    arm: Arm
    address: str
    count: int
    """of arms side by side, of which one is shown"""
    ring: Ring
    ghost: Ghost | None
    within: float
    """[m] error that is accepted"""
    paced: bool
    """whether it is slowed down to the pace of the page"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Begun:
    """The run of the control loop that began last."""

    number: int = 0
    controller: str = ""
    limits: GuardLimits | None = None


class Animation:
    """Draws one arm; it begins with what comes from now on."""

    def __init__(self, page: WebPage, subject: Subject, before: Animation | None) -> None:
        self._page, self.subject = page, subject
        self._skeleton = Skeleton.of(subject.arm)
        same = before is not None and before.subject.arm is subject.arm
        self._trails: Trails = before._trails if same and before is not None else Trails(subject.arm)
        self._recent, self._read = subject.ring.since(max(subject.ring.count - 1, 0))
        self._count = 0
        if not same or before is None or before.subject.within != subject.within:
            page.show(subject.arm, within=subject.within, paced=subject.paced)
            now = self._skeleton.turns(self._recent.position[-1] if len(self._recent) else subject.arm.rest)
            page.pose(now, now)

    def draw(self, begun: Begun, doing: panel.Doing, stopped: str) -> None:
        """Read what came, and draw it."""
        fresh, self._read = self.subject.ring.since(self._read)
        ghost = self._ghost(fresh)
        self._trails.follow(fresh)
        self._recent = self._recent.then(fresh).lately(KEPT)
        with self._page.atomic():
            if len(fresh):
                self._page.pose(self._skeleton.turns(fresh.position[-1]), self._skeleton.turns(ghost[-1]))
                self._page.aim(fresh.aim[-1], _miss(fresh), self._label(fresh))
            if self._count % SLOWER == 0:
                self._write(begun, doing, stopped)
        self._count += 1

    def _ghost(self, records: Records) -> Array:
        """Joint positions (K, n) [rad] of what is drawn beside the arm: its twin, or where it is sent."""
        return records.command if self.subject.ghost is None else self.subject.ghost.follow(records)

    def _label(self, records: Records) -> str:
        return "target" if self._trails.moves else f"target {int(records.index[-1]) + 1}"

    def _write(self, begun: Begun, doing: panel.Doing, stopped: str) -> None:
        subject, recent, trails = self.subject, self._recent, self._trails
        words = () if begun.limits is None else guard_words(recent, begun.limits)
        controller = "" if begun.controller == Playback.name else begun.controller
        robot = subject.address
        if subject.count > 1 and len(recent):
            robot += f", arm {int(recent.arm[-1]) + 1} of {subject.count} side by side"
        self._page.trail(trails.tool, trails.target if trails.moves else trails.target[:0])
        self._page.plot(*_curve(trails), 1e3 * subject.within)
        self._page.tell(
            head=panel.head(robot, controller, doing), share=doing.share,
            error=panel.error(trails.errors, subject.within), guard=panel.guard(words, stopped),
            joints=panel.joints(subject.arm.joint_names, recent),
            legend=panel.legend(_legend(subject, recent)),
        )  # fmt: skip


def _miss(records: Records) -> Array:
    """Where the tool itself is (3,) [m], as far from the drawn target as it is from the real one.

    All is drawn as the encoders see it, and so is the target: where they are to see the tool. NaN where nobody knows.
    """
    target, aim, true = records.target[-1], records.aim[-1], records.true_tcp[-1]
    return aim + true - target if np.isfinite(target).all() else true


def _curve(trails: Trails) -> tuple[Array, Array, Array]:
    """Return times (M,) [s] and errors (M,) [mm], those that are shown: none where there is no target now."""
    t, error, true = trails.curve
    known = np.isfinite(error) & np.isfinite(trails.errors[0])
    return t[known], 1e3 * error[known], 1e3 * true[known]


def _legend(subject: Subject, recent: Records) -> tuple[tuple[str, str], ...]:
    """Name the colours of what is drawn: a check has no targets, and a real arm's tool is seen by nobody."""
    target, tool = (
        bool(len(recent)) and bool(np.isfinite(points[-1]).all()) for points in (recent.target, recent.true_tcp)
    )
    entries = [
        (css(LINKS[1]), "the arm"),
        (css(GHOST), "where it is sent" if subject.ghost is None else "its twin's prediction"),
        (css(TRAIL), "its tool, by its encoders"),
        *([(css(TARGET), "target, and what is accepted")] if target else []),
        *([(css(TRUE), "the tool itself")] if tool else []),
    ]
    return *entries, (panel.GREY, f"squares of {1e3 * cell_of(reach(subject.arm)):.0f} mm")
