"""Drawing of an arm: capsules, texts, colours."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rejoint.arms import Arm, Array, clearances, tcp_position
from rejoint.arms.collision import contact
from rejoint.arms.workspace import reach
from rejoint.control.guard import TRIPS, GuardLimits, Reason
from rejoint.control.loop import say_hot
from rejoint.control.recording import Cycle
from rejoint.control.robot import JointState
from rejoint.control.start import Playback
from rejoint.pages.html import macros
from rejoint.twin.simulation import Draw, Simulation

if TYPE_CHECKING:
    from rejoint.twin.twin import Twin


SLOTS = 512
"""(chosen: ten seconds at the shortest usual period)"""


class SeenCycle(NamedTuple):
    """One cycle of an arm; NaN: unknown."""

    run: int
    arm: int
    """index"""
    wanted: Array
    """(n,) [rad] command of the controller, before the guard"""
    temperature: Array
    """(n,) [deg C]"""
    time: float
    """[s]"""
    target_index: int
    reasons: int
    """flags of the guard"""
    target: Array
    """(3,) [m]"""
    aim: Array
    true_tcp: Array
    position: Array
    """(n,) [rad]"""
    command: Array
    load: Array
    """(n,) share of torque"""

    @classmethod
    def of(cls, run: int, cycle: Cycle, state: JointState, wanted: Array) -> SeenCycle:
        """Newest arm of a cycle."""
        b = int(cycle.active.argmax())
        heat = np.full(wanted.shape[1], np.nan) if state.temperature is None else state.temperature[b]
        return cls(run, b, wanted[b], heat, *(getattr(cycle, name)[b] for name in cls._fields[4:]))


def lately(seen: Sequence[SeenCycle], seconds: float) -> list[SeenCycle]:
    """Return what was seen of the newest run and arm in the last ``seconds``."""
    if not seen:
        return []
    now = seen[-1]
    return [one for one in seen if one[:2] == now[:2] and one.time > now.time - seconds]


class Ring:
    """Newest cycles of an arm: one thread writes, another one reads."""

    def __init__(self, slots: int = SLOTS) -> None:
        self._slots: list[tuple[int, tuple[int, Cycle, JointState, Array]] | None] = [None] * slots
        self.count = 0
        """of written cycles"""

    def write(self, run: int, cycle: Cycle, state: JointState, wanted: Array) -> None:
        """Write a cycle."""
        count = self.count
        self._slots[count % len(self._slots)] = count, (run, cycle, state, wanted)
        self.count = count + 1

    def since(self, count: int) -> tuple[list[SeenCycle], int]:
        """Return cycles after the first ``count``, as far as kept, the oldest first, and the new count."""
        end, found = self.count, []
        for number in range(max(count, end - len(self._slots), 0), end):
            slot = self._slots[number % len(self._slots)]
            if slot is not None and slot[0] == number:  # not yet written over
                found.append(SeenCycle.of(*slot[1]))
        return found, end


LONGEST = 0.5
"""[s] gap after which the twin restarts (chosen)"""


class Ghost:
    """A twin that receives the arm's commands; restarts with every run."""

    def __init__(self, arm: Arm, twin: Twin) -> None:
        self._draw = Draw.of(twin.parameters.repeat(1), twin.stiction, twin.acceleration)
        self._simulation = Simulation(arm, 1)
        self._last: SeenCycle | None = None

    def follow(self, seen: Sequence[SeenCycle]) -> Array | None:
        """Position (n,) [rad] of the twin at the last cycle; None: none was seen."""
        for now in seen:
            last = self._last
            passed = np.nan if last is None or last[:2] != now[:2] else now.time - last.time
            if 0.0 < passed <= LONGEST:
                self._simulation.advance(np.array([passed]))
            elif passed != 0.0:
                self._simulation.place(self._draw, now.position[None], now.command[None])
            self._simulation.send(now.command[None])
            self._last = now
        return self._simulation.measured[0] if seen else None


if TYPE_CHECKING:
    from rejoint.pages.live.page import WebPage


Colour = tuple[int, int, int]

LINKS: tuple[Colour, Colour] = (214, 219, 225), (168, 179, 192)
"""of the links in turn"""
GHOST: Colour = (47, 111, 237)
TRAIL: Colour = (235, 120, 30)
TARGET: Colour = (30, 160, 90)
TRUE: Colour = (200, 30, 160)
"""of the tool"""

TRAIL_POINTS = 400
"""(chosen: at `APART` that is 0.8 m)"""
APART = 2e-3
"""[m] between points of a trail (chosen)"""
MOVES = 5
"""Points of a moving target (chosen)"""


def cell_of(size: float) -> float:
    """[m] edge of a ground square under an arm of reach ``size`` [m]."""
    return 0.05 if size < 1.0 else 0.1


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


def guard_words(seen: Sequence[SeenCycle], limits: GuardLimits) -> tuple[str, ...]:
    """Actions of the guard in the last `KEPT` seconds, trips first."""
    recent, said = lately(seen, KEPT)[::-1], []
    for reason in sorted(Reason, key=lambda one: one not in TRIPS):
        met = next((one for one in recent if int(one.reasons) & reason.value), None)
        if met is None:
            continue
        if reason in _LIMITS:
            joint = limits.arm.joint_names[int(np.argmax(np.abs(met.wanted - met.command)))]
            said.append(f"{_LIMITS[reason]}: the command of {joint} is limited")
        elif reason in (Reason.FLOOR, Reason.COLLISION):
            said.append(_touching(reason, met.wanted, limits))
        elif reason is Reason.TEMPERATURE:
            said.append(say_hot(limits.arm.joint_names, met.temperature, limits.max_temperature))
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
    begun: float = field(default_factory=time.monotonic)
    """[s]"""

    @property
    def left(self) -> str:
        """Remaining time in words, or empty."""
        passed = time.monotonic() - self.begun
        return duration(passed / self.share - passed) if 0.02 < self.share < 1.0 and passed > 2.0 else ""


def duration(seconds: float) -> str:
    """``40 s``, ``3 min`` or ``1 h 20 min``."""
    if seconds < 90.0:
        return f"{5 * np.ceil(seconds / 5):.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


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
    """Draws what is shown of an arm, and of the next one."""

    def __init__(self, page: WebPage) -> None:
        self._page, self._count = page, 0
        self._panel = macros("live.html", red=RED, amber=AMBER, green=GREEN, grey=GREY)
        self._subject: Subject | None = None
        self._tool: deque[Array] = deque(maxlen=TRAIL_POINTS)
        self._target: deque[Array] = deque(maxlen=TRAIL_POINTS)

    def _turn_to(self, subject: Subject) -> None:
        before, self._subject = self._subject, subject
        same = before is not None and before.arm is subject.arm
        self._recent, self._read = subject.ring.since(max(subject.ring.count - 1, 0))
        if not same:
            self._tool.clear()
            self._target.clear()
        if not same or before is None or before.within != subject.within:
            self._page.show(subject.arm, within=subject.within, paced=subject.paced)
            now = self._recent[-1].position if self._recent else subject.arm.rest
            self._page.pose(now, now)

    def draw(self, subject: Subject, begun: Begun, doing: Doing, stopped: str) -> None:
        """Draw new records of ``subject``."""
        if subject is not self._subject:
            self._turn_to(subject)
        fresh, self._read = subject.ring.since(self._read)
        ghost = None if subject.ghost is None else subject.ghost.follow(fresh)
        for one in fresh:
            _extend(self._tool, tcp_position(subject.arm, one.position))
            _extend(self._target, one.aim)
        self._recent = lately([*self._recent, *fresh], KEPT)
        with self._page.atomic():
            if fresh:
                now = fresh[-1]
                known = np.isfinite(now.target).all()
                true = now.aim + now.true_tcp - now.target if known else now.true_tcp
                self._page.pose(now.position, now.command if ghost is None else ghost)
                self._page.aim(now.aim, true, "target" if self._moves else f"target {int(now.target_index) + 1}")
            if self._count % SLOWER == 0:
                self._write(subject, begun, doing, stopped)
        self._count += 1

    @property
    def _moves(self) -> bool:
        """Whether the target moves."""
        return len(self._target) > MOVES

    def _write(self, subject: Subject, begun: Begun, doing: Doing, stopped: str) -> None:
        recent, write, robot = self._recent, self._panel, subject.address
        words = () if begun.limits is None else guard_words(recent, begun.limits)
        controller = "" if begun.controller == Playback.name else begun.controller
        error = true = np.nan
        if recent:
            now = recent[-1]
            error = float(np.linalg.norm(now.aim - tcp_position(subject.arm, now.position)))
            true = float(np.linalg.norm(now.target - now.true_tcp))
            robot += f", arm {now.arm + 1} of {subject.count} side by side" if subject.count > 1 else ""
        self._page.trail(_points(self._tool), _points(self._target if self._moves else ()))
        self._page.tell(
            doing.share,
            head=write.head(robot, controller, doing, doing.left),
            error=write.error(error, true, subject.within),
            guard=write.guard(words, stopped),
            joints=write.joints(subject.arm.joint_names, recent[-1], HOT) if recent else "",
            legend=write.legend(_legend(subject, recent)),
        )


def _extend(trail: deque[Array], point: Array) -> None:
    if not np.isfinite(point).all():
        return
    way = np.inf if not trail else float(np.linalg.norm(point - trail[-1]))
    if way > 25.0 * APART:
        trail.clear()
    if way > APART:
        trail.append(point.copy())


def _points(trail: Collection[Array]) -> Array:
    return np.array(trail).reshape(-1, 3)


def _legend(subject: Subject, recent: Sequence[SeenCycle]) -> list[tuple[str, str]]:
    last = recent[-1] if recent else None
    entries = {
        "the arm": LINKS[1],
        "where it is sent" if subject.ghost is None else "its twin's prediction": GHOST,
        "its tool, by its encoders": TRAIL,
        **({"target, and what is accepted": TARGET} if last is not None and np.isfinite(last.target).all() else {}),
        **({"the tool itself": TRUE} if last is not None and np.isfinite(last.true_tcp).all() else {}),
    }
    squares = (GREY, f"squares of {1e3 * cell_of(reach(subject.arm)):.0f} mm")
    return [*((f"rgb{colour}", text) for text, colour in entries.items()), squares]
