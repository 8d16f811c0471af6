"""Drawing of an arm: capsules, texts, colours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from rejoint.arms import Arm, Array, clearances
from rejoint.arms.collision import collision_shape, contact
from rejoint.arms.workspace import reach
from rejoint.control.guard import TRIPS, GuardLimits, Reason
from rejoint.control.loop import say_hot
from rejoint.control.start import Playback
from rejoint.pages.html import macros
from rejoint.pages.live.records import Records, Ring, Trails, lately

if TYPE_CHECKING:
    from rejoint.pages.live.page import WebPage
    from rejoint.pages.live.records import Ghost


Colour = tuple[int, int, int]

LINKS: tuple[Colour, Colour] = (214, 219, 225), (168, 179, 192)
"""of the links in turn"""
GHOST: Colour = (47, 111, 237)
TRAIL: Colour = (235, 120, 30)
TARGET: Colour = (30, 160, 90)
TRUE: Colour = (200, 30, 160)
"""of the tool"""
NARROWER = 0.97
"""Thickness of every other link, against flicker (chosen)"""
TOOL_SHARE = 0.3
"""Thickness of the tool over a link's (chosen)"""


def cell_of(size: float) -> float:
    """[m] edge of a ground square under an arm of reach ``size`` [m]."""
    return 0.05 if size < 1.0 else 0.1


def css(colour: Colour) -> str:
    """Colour in CSS."""
    return f"rgb{colour}"


class Skeleton:
    """Parts of an arm of n joints; link 0 is the base."""

    def __init__(self, arm: Arm) -> None:
        self.place: Array = arm.offset[:, :3, 3]
        """(n, 3) [m] joint origins, each in its parent"""
        self.end: Array = np.vstack([self.place, arm.tip[:3, 3]])
        """(n + 1, 3) [m] link ends, in the link's frame"""
        self.radius = collision_shape(arm).radius
        """[m]"""
        self._axis, self._zero = arm.axis, Rotation.from_matrix(arm.offset[:, :3, :3])

    def shape(self, link: int) -> tuple[Array, float]:
        """End (3,) [m] of a link's capsule in its frame, and radius [m]."""
        if link < len(self.place):
            return self.end[link], self.radius * (1.0 if link % 2 else NARROWER)
        thin, length = TOOL_SHARE * self.radius, float(np.linalg.norm(self.end[link]))
        return self.end[link] * max(1.0 - thin / length, 0.0) if length > thin else self.end[link], thin

    def turns(self, q: Array) -> Array:
        """Quaternions (n, 4), w first, of joint frames in their parents, at ``q`` (n,) [rad]."""
        turned: Array = (self._zero * Rotation.from_rotvec(q[:, None] * self._axis)).as_quat(scalar_first=True)
        return turned


KEPT = 1.5
"""[s] for which a limit is shown (chosen)"""

# What the guard keeps a command from exceeding; the joint is named whose command it changed most
_LIMITS = {
    Reason.POSITION: "joint limit",
    Reason.STEP: "speed",
    Reason.LEAD: "distance ahead of the joint",
    Reason.ACCELERATION: "acceleration",
}
_WORDS = {
    Reason.GAP: "no answers came for a while, or a joint was led back; the arm held and goes on slowly",
    Reason.NOT_FINITE: "a command or a position is not a number; check the controller and the connection",
    Reason.STALE: "no new joint state for too long; check the connection",
    Reason.OUT_OF_RANGE: "a joint reads far outside its limits; check the arm's zero",
    Reason.SERVO_FAULT: "a servo reports a fault; free the arm and clear the fault",
    Reason.NOT_FOLLOWING: "the reading of a joint does not change and is not trusted",
}


def guard_words(records: Records, limits: GuardLimits) -> tuple[str, ...]:
    """Actions of the guard in the last `KEPT` seconds, trips first."""
    recent = lately(records, KEPT)
    flags, said = recent.reasons.astype(np.int64), []
    for reason in sorted(Reason, key=lambda one: one not in TRIPS):
        met = np.flatnonzero(flags & reason.value)
        if not len(met):
            continue
        if reason in _LIMITS:
            changed = np.abs(recent.wanted[met[-1]] - recent.command[met[-1]])
            said.append(
                f"{_LIMITS[reason]}: the command of {limits.arm.joint_names[int(np.argmax(changed))]} is limited"
            )
        elif reason in (Reason.FLOOR, Reason.COLLISION):
            said.append(_touching(reason, recent.wanted[met[-1]], limits))
        elif reason is Reason.TEMPERATURE:
            said.append(say_hot(limits.arm.joint_names, recent.temperature[met[-1]], limits.max_temperature))
        else:
            said.append(_WORDS[reason])
    return tuple(said)


def _touching(reason: Reason, wanted: Array, limits: GuardLimits) -> str:
    """Name the contact or low point at the wanted posture (n,)."""
    clear, floors = clearances(limits.arm, wanted[None], limits.floors)[0], len(limits.floors)
    if reason is Reason.FLOOR:
        low = int(np.argmin(clear[:floors]))
        what = "the tool" if low == floors - 1 else limits.arm.joint_names[low + 1]
        return f"floor: {what} was asked to go lower than {1e3 * limits.floors[low]:.0f} mm"
    if len(clear) == floors:
        return "contact: a link would touch another one or the ground"
    what, other = contact(limits.arm, int(np.argmin(clear[floors:])))
    return f"contact: {what} would touch {other}"


RED, AMBER, GREEN, GREY = "#c92a2a", "#b35c00", "#2b8a3e", "#868e96"
HOT = 55.0
"""[deg C] of a marked temperature (chosen: 10 below the guard's limit)"""


@dataclass(frozen=True, kw_only=True)
class Doing:
    """A task and its progress."""

    title: str = ""
    """command, or stage of a repair"""
    what: str = ""
    """label"""
    share: float = 0.0
    """0 to 1"""
    since: float = 0.0
    """[s]"""

    @property
    def left(self) -> float | None:
        """[s] remaining, or None."""
        return self.since * (1.0 - self.share) / self.share if 0.02 < self.share < 1.0 and self.since > 2.0 else None


def duration(seconds: float) -> str:
    """``40 s``, ``3 min`` or ``1 h 20 min``."""
    if seconds < 90.0:
        return f"{5 * np.ceil(seconds / 5):.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def panel() -> Any:  # noqa: ANN401 - macros of a template
    """Macros of short texts in HTML; values in metres, radians and seconds."""
    return macros("live.html", red=RED, amber=AMBER, green=GREEN, grey=GREY)


SLOWER = 6
"""frames per text and curve (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Subject:
    """A shown arm."""

    arm: Arm
    address: str
    count: int
    """of arms; one is shown"""
    ring: Ring
    ghost: Ghost | None
    within: float
    """[m] accepted error"""
    paced: bool
    """slowed down to the page's pace"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Begun:
    """The last begun run."""

    number: int = 0
    controller: str = ""
    limits: GuardLimits | None = None


class Animation:
    """Draws one arm."""

    def __init__(self, page: WebPage, subject: Subject, before: Animation | None) -> None:
        self._page, self.subject = page, subject
        self._skeleton = Skeleton(subject.arm)
        same = before is not None and before.subject.arm is subject.arm
        self._trails: Trails = before._trails if same and before is not None else Trails(subject.arm)
        self._recent, self._read = subject.ring.since(max(subject.ring.count - 1, 0))
        self._count = 0
        if not same or before is None or before.subject.within != subject.within:
            page.show(subject.arm, within=subject.within, paced=subject.paced)
            now = self._skeleton.turns(self._recent.position[-1] if len(self._recent) else subject.arm.rest)
            page.pose(now, now)

    def draw(self, begun: Begun, doing: Doing, stopped: str) -> None:
        """Draw new records."""
        fresh, self._read = self.subject.ring.since(self._read)
        ghost = self._ghost(fresh)
        self._trails.follow(fresh)
        self._recent = lately(np.concatenate([self._recent, fresh]).view(np.recarray), KEPT)
        with self._page.atomic():
            if len(fresh):
                self._page.pose(self._skeleton.turns(fresh.position[-1]), self._skeleton.turns(ghost[-1]))
                self._page.aim(fresh.aim[-1], _miss(fresh), self._label(fresh))
            if self._count % SLOWER == 0:
                self._write(begun, doing, stopped)
        self._count += 1

    def _ghost(self, records: Records) -> Array:
        """Positions (K, n) [rad] of the ghost: the twin, or the commands."""
        return records.command if self.subject.ghost is None else self.subject.ghost.follow(records)

    def _label(self, records: Records) -> str:
        return "target" if self._trails.moves else f"target {int(records.index[-1]) + 1}"

    def _write(self, begun: Begun, doing: Doing, stopped: str) -> None:
        subject, recent, trails = self.subject, self._recent, self._trails
        words = () if begun.limits is None else guard_words(recent, begun.limits)
        controller = "" if begun.controller == Playback.name else begun.controller
        robot = subject.address
        if subject.count > 1 and len(recent):
            robot += f", arm {int(recent.arm[-1]) + 1} of {subject.count} side by side"
        self._page.trail(trails.tool, trails.target if trails.moves else trails.target[:0])
        write, left = panel(), doing.left
        self._page.tell(
            head=write.head(robot, controller, doing, "" if left is None else duration(left)),
            share=doing.share,
            error=write.error(*trails.errors, subject.within),
            guard=write.guard(words, stopped),
            joints=write.joints(subject.arm.joint_names, recent[-1], HOT) if len(recent) else "",
            legend=write.legend(_legend(subject, recent)),
        )


def _miss(records: Records) -> Array:
    """Place (3,) [m] of the drawn tool; NaN: unknown."""
    target, aim, true = records.target[-1], records.aim[-1], records.true_tcp[-1]
    return aim + true - target if np.isfinite(target).all() else true


def _legend(subject: Subject, recent: Records) -> tuple[tuple[str, str], ...]:
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
    return *entries, (GREY, f"squares of {1e3 * cell_of(reach(subject.arm)):.0f} mm")
