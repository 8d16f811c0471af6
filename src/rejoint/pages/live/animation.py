"""Drawing of an arm: what was seen of it, its ghost, trails and texts."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.arms.workspace import reach
from rejoint.control.guard import Reason
from rejoint.control.recording import Cycle
from rejoint.control.robot import JointState, Robot
from rejoint.pages.html import macros
from rejoint.twin.simulation import Draw, Simulation

if TYPE_CHECKING:
    from rejoint.pages.live.page import WebPage
    from rejoint.twin.twin import Twin

SLOTS = 512
"""Cycles that wait to be drawn (chosen: ten seconds at the shortest usual period)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Shown:
    """A run of an arm: the control loop writes its cycles, the thread of the page takes them."""

    robot: Robot
    twin: Twin | None
    within: float
    """[m] accepted error"""
    paced: bool
    """slowed down to the page's pace"""
    controller: str = ""
    cycles: deque[tuple[Cycle, JointState, Array]] = field(default_factory=lambda: deque(maxlen=SLOTS))
    """the newest, each with the wanted command before the guard"""


class SeenCycle(NamedTuple):
    """One cycle of an arm; NaN: unknown."""

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
    def of(cls, cycle: Cycle, state: JointState, wanted: Array) -> SeenCycle:
        """Newest arm of a cycle."""
        b = int(cycle.active.argmax())
        heat = np.full(wanted.shape[1], np.nan) if state.temperature is None else state.temperature[b]
        return cls(b, wanted[b], heat, *(getattr(cycle, name)[b] for name in cls._fields[3:]))


LONGEST = 0.5
"""[s] gap after which the twin restarts (chosen)"""


class Ghost:
    """A twin that receives the arm's commands."""

    def __init__(self, arm: Arm, twin: Twin) -> None:
        self._draw = Draw.of(twin.parameters.repeat(1), twin.stiction, twin.acceleration)
        self._simulation = Simulation(arm, 1)
        self._last: SeenCycle | None = None

    def follow(self, now: SeenCycle) -> Array:
        """Position (n,) [rad] of the twin at a cycle."""
        last, self._last = self._last, now
        passed = np.nan if last is None or last.arm != now.arm else now.time - last.time
        if 0.0 < passed <= LONGEST:
            self._simulation.advance(np.array([passed]))
        elif passed != 0.0:
            self._simulation.place(self._draw, now.position[None], now.command[None])
        self._simulation.send(now.command[None])
        return self._simulation.measured[0]


Colour = tuple[int, int, int]

LINKS: tuple[Colour, Colour] = (214, 219, 225), (168, 179, 192)
"""of the links in turn"""
GHOST: Colour = (47, 111, 237)
TRAIL: Colour = (235, 120, 30)
TARGET: Colour = (30, 160, 90)
TRUE: Colour = (200, 30, 160)
"""of the tool"""
RED, AMBER, GREEN, GREY = "#c92a2a", "#b35c00", "#2b8a3e", "#868e96"
TRAIL_POINTS = 400
"""(chosen: at `APART` that is 0.8 m)"""
APART = 2e-3
"""[m] between points of a trail (chosen)"""
MOVES = 5
"""Points of a moving target (chosen)"""
HOT = 55.0
"""[deg C] of a marked temperature (chosen: 10 below the guard's limit)"""
SLOWER = 6
"""frames per text (chosen)"""
KEPT = 1.5
"""[s] for which a limit is shown (chosen)"""

# What the guard does, the end of a motion first; after a colon the joint is named whose command it changed most
_WORDS = {
    Reason.NOT_FINITE: "a command or a position is not a number; check the controller and the connection",
    Reason.STALE: "no new joint state for too long; check the connection",
    Reason.OUT_OF_RANGE: "a joint reads far outside its limits; check the arm's zero",
    Reason.TEMPERATURE: "a servo is too hot; let it cool down",
    Reason.SERVO_FAULT: "a servo reports a fault; free the arm and clear the fault",
    Reason.NOT_FOLLOWING: "the reading of a joint does not change and is not trusted",
    Reason.POSITION: "joint limit:",
    Reason.STEP: "speed:",
    Reason.LEAD: "distance ahead of the joint:",
    Reason.ACCELERATION: "acceleration:",
    Reason.FLOOR: "floor: the arm was asked to go lower than it may",
    Reason.COLLISION: "contact: a link would touch another one, the ground or a box",
    Reason.GAP: "no answers came for a while, or a joint was led back; the arm held and goes on slowly",
}


def guard_words(recent: Sequence[SeenCycle], joints: Sequence[str]) -> list[str]:
    """Actions of the guard in ``recent`` cycles, trips first."""
    said = []
    for reason, words in _WORDS.items():
        met = next((one for one in reversed(recent) if int(one.reasons) & reason.value), None)
        if met is not None:
            joint = joints[int(np.argmax(np.abs(met.wanted - met.command)))]
            said.append(f"{words} the command of {joint} is limited" if words.endswith(":") else words)
    return said


@dataclass(frozen=True, kw_only=True)
class Doing:
    """A task and its progress."""

    title: str = ""
    """command, or stage of a repair"""
    what: str = ""
    """label"""
    share: float = 0.0
    """0 to 1"""


class Animation:
    """Draws one run."""

    def __init__(self, page: WebPage, shown: Shown) -> None:
        self.shown, self._page, self._count = shown, page, 0
        self._panel = macros("live.html", red=RED, amber=AMBER, green=GREEN, grey=GREY)
        self._ghost = None if shown.twin is None else Ghost(shown.robot.arm, shown.twin)
        self._recent: list[SeenCycle] = []
        self._tool: deque[Array] = deque(maxlen=TRAIL_POINTS)
        self._target: deque[Array] = deque(maxlen=TRAIL_POINTS)
        while len(shown.cycles) > 1:  # what came before anyone looked
            shown.cycles.popleft()
        page.show(shown.robot.arm, within=shown.within, paced=shown.paced)

    def draw(self, doing: Doing, stopped: str) -> None:
        """Draw new cycles."""
        arm, cycles, ghost = self.shown.robot.arm, self.shown.cycles, None
        fresh = [SeenCycle.of(*cycles.popleft()) for _ in range(len(cycles))]
        for one in fresh:
            ghost = one.command if self._ghost is None else self._ghost.follow(one)
            _extend(self._tool, tcp_position(arm, one.position))
            _extend(self._target, one.aim)
            self._recent.append(one)
        now = self._recent[-1] if self._recent else None
        if now is not None:
            self._recent = [one for one in self._recent if one.arm == now.arm and one.time > now.time - KEPT]
        with self._page.atomic():
            if now is not None and ghost is not None:
                known = np.isfinite(now.target).all()
                true = now.aim + now.true_tcp - now.target if known else now.true_tcp
                self._page.pose(now.position, ghost)
                self._page.aim(now.aim, true, "target" if self._moves else f"target {int(now.target_index) + 1}")
            if self._count % SLOWER == 0:
                self._write(now, doing, stopped)
        self._count += 1

    @property
    def _moves(self) -> bool:
        """Whether the target moves."""
        return len(self._target) > MOVES

    def _write(self, now: SeenCycle | None, doing: Doing, stopped: str) -> None:
        shown, write, robot = self.shown, self._panel, self.shown.robot
        error = true = np.nan
        title = robot.address
        if now is not None:
            error = float(np.linalg.norm(now.aim - tcp_position(robot.arm, now.position)))
            true = float(np.linalg.norm(now.target - now.true_tcp))
            title += f", arm {now.arm + 1} of {robot.count} side by side" if robot.count > 1 else ""
        self._page.trail(_points(self._tool), _points(self._target if self._moves else ()))
        self._page.tell(
            doing.share,
            head=write.head(title, shown.controller, doing),
            error=write.error(error, true, shown.within),
            guard=write.guard(guard_words(self._recent, robot.arm.joint_names), stopped),
            joints="" if now is None else write.joints(robot.arm.joint_names, now, HOT),
            legend=write.legend([*self._legend(), (GREY, f"squares of {1e3 * cell_of(reach(robot.arm)):.0f} mm")]),
        )

    def _legend(self) -> list[tuple[str, str]]:
        entries = {
            "the arm": LINKS[1],
            "where it is sent" if self._ghost is None else "its twin's prediction": GHOST,
            "its tool, by its encoders": TRAIL,
            "target, and what is accepted": TARGET,
            "the tool itself, where it is known": TRUE,
        }
        return [(f"rgb{colour}", text) for text, colour in entries.items()]


def cell_of(size: float) -> float:
    """[m] edge of a ground square under an arm of reach ``size`` [m]."""
    return 0.05 if size < 1.0 else 0.1


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
