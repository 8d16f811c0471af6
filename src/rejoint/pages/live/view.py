"""The live view: an observer, and the thread of its page."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Self, cast

import numpy as np

from rejoint.arms import Array
from rejoint.control.comparison.result import Protocol
from rejoint.control.recording import Cycle, Look, Observer
from rejoint.control.robot import JointState, Robot, RobotWrapper, WallClock
from rejoint.pages.words import sentence
from rejoint.robots import is_virtual
from rejoint.system.errors import LOGGER, first_line
from rejoint.system.extras import require
from rejoint.system.records import entity

if TYPE_CHECKING:
    from rejoint.pages.live.page import WebPage
    from rejoint.twin.twin import Twin


HOST, PORT = "127.0.0.1", 8080
RATE = 25.0
"""[Hz] of frames (chosen)"""
ASLEEP = 0.2
"""[s] between looks for a browser (chosen)"""
SEEN = 0.7
"""[s] of the page after the end (chosen)"""
HAND_OVER = 0.2e-3
"""[s] of Python's thread switch while serving (chosen: the control loop waits for it)"""
SLOTS = 512
"""Cycles that wait to be drawn (chosen: ten seconds at the shortest usual period)"""


@entity
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
    """One cycle of one arm."""

    arm: int
    """index"""
    cycle: Cycle
    """its columns, without the leading axis"""
    wanted: Array
    """(n,) [rad] command of the controller, before the guard"""
    temperature: Array
    """(n,) [deg C]; NaN: unknown"""

    @classmethod
    def of(cls, cycle: Cycle, state: JointState, wanted: Array) -> SeenCycle:
        """Newest arm of a cycle."""
        b = int(cycle.active.argmax())
        heat = np.full(wanted.shape[1], np.nan) if state.temperature is None else state.temperature[b]
        return cls(b, cycle.at(b), wanted[b], heat)


@dataclass(kw_only=True)
class Doing:
    """A task and its progress."""

    title: str = ""
    """command, or stage of a repair"""
    what: str = ""
    """label"""
    share: float = 0.0
    """0 to 1"""
    stopped: str = ""
    """why it ended early"""


class LiveView(Observer):
    """Shows driven arms on a page; the control loop never waits for it.

    Pass it as ``observer``. Its button acts as Ctrl-C: the arm holds, and `Interrupted` is raised.

    Examples
    --------
    >>> with rejoint.LiveView() as view:
    ...     print(view.address)
    ...     rejoint.deploy("emulated:worn", observer=view)
    """

    def __init__(self, host: str = HOST, port: int = PORT, page: Callable[[str, int], WebPage] | None = None) -> None:
        """Serve at ``host`` and ``port`` (0: any free one), without a password, perhaps another kind of ``page``."""
        self._host, self._port, self._kind = host, port, page
        self._page: WebPage | None = None
        self._thread = threading.Thread(target=self._run, name="live view", daemon=True)
        self._over = threading.Event()
        self.shown: Shown | None = None
        """the newest run"""
        self._doing = Doing()
        self.failure = ""
        """why the newest missed frame was not drawn, or empty"""

    def __enter__(self) -> Self:
        """Serve the page; MissingExtraError without the extra ``live``, InputError for a taken port."""
        require("a live view", "live")
        from rejoint.pages.live.page import WebPage

        self._page = (self._kind or WebPage)(self._host, self._port)
        self._interval = sys.getswitchinterval()
        sys.setswitchinterval(min(HAND_OVER, self._interval))
        self._thread.start()
        return self

    def __exit__(self, kind: object, error: BaseException | None, *_: object) -> None:
        """Show the last frame, and end."""
        if error is not None:
            self._doing.stopped = " ".join([sentence(first_line(error)), *getattr(error, "__notes__", ())])
        elif self._doing.title:
            self.progress(1.0, "done")
        page = cast("WebPage", self._page)
        if page.watched:
            time.sleep(SEEN)
        self._over.set()
        self._thread.join()
        page.close()
        sys.setswitchinterval(self._interval)

    @property
    def address(self) -> str:
        """Address for a browser; empty before."""
        return "" if self._page is None else self._page.address

    def watch(
        self,
        robot: Robot,
        *,
        twin: Any = None,  # noqa: ANN401 - a `Twin`, which `Observer` does not know
        within: float | None = None,
        paced: bool = True,
    ) -> Robot:
        """Return a shown robot, with its ``twin`` as a ghost.

        ``within`` [m]: accepted error; virtual time runs at the page's pace, if it is ``paced``.
        """
        paced = paced and is_virtual(robot.address)
        accepted = Protocol.threshold if within is None else within
        self.shown = Shown(robot=robot, twin=twin, within=accepted, paced=paced)
        if paced:
            robot = WallClock(robot, lambda: 1.0 if self._page is None else self._page.pace)
        return _LiveRobot(robot, self, self.shown)

    def begin(self, title: str) -> None:
        """Begin a command, or a stage of a repair."""
        self._doing = Doing(title=title)

    def progress(self, share: float, what: str) -> None:
        """Show progress."""
        self._doing.share, self._doing.what = min(max(share, 0.0), 1.0), what

    def _run(self) -> None:
        page = cast("WebPage", self._page)
        while not self._over.is_set():
            began, pause = time.monotonic(), ASLEEP
            try:
                if page.watched:
                    page.draw(self.shown, self._doing)
                    pause = 1.0 / RATE
                else:
                    page.rest()
            except Exception as error:  # noqa: BLE001 - whatever it is, the arm goes on, and the next frame is tried
                failure = f"{type(error).__name__}: {first_line(error)}"
                if failure != self.failure:
                    LOGGER.warning("the page misses a frame (%s); the arm goes on", failure)
                self.failure = failure
            self._over.wait(max(began + pause - time.monotonic(), 0.0))


class _LiveRobot(RobotWrapper):
    def __init__(self, robot: Robot, view: LiveView, shown: Shown) -> None:
        super().__init__(robot)
        self._view, self._shown = view, shown

    def onlooker(self, controller: str) -> Look:
        """See `rejoint.control.recording.LookedAt`."""
        run = replace(self._shown, controller=controller, cycles=deque(maxlen=SLOTS))
        self._view.shown = run
        return lambda *seen: run.cycles.append(seen)
