"""What the studio is doing: one job at a time, in one thread. Every page shows the same `Status`."""

import logging
import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import field, replace
from pathlib import Path
from typing import Any, TypeVar

import rejoint
from rejoint.arms import Arm, Array
from rejoint.control.recording import Observer
from rejoint.control.robot import JointState, Robot, WatchedRobot
from rejoint.logs.history import plain_name
from rejoint.logs.runfolder import RunFolder
from rejoint.runs.failure import failure_of
from rejoint.runs.run import Run, newest_or_new
from rejoint.system.errors import LOGGER, InputError, NotReadyError, RejointError
from rejoint.system.files import unused
from rejoint.system.records import entity
from rejoint.system.stopping import Interrupted, ending, interrupt

LINES = 6
"""Newest messages that are shown (chosen)"""
Job = Callable[["Studio"], object]
T = TypeVar("T")


@entity
class Status:
    """What all pages show."""

    step: str = "find"
    """of `rejoint.studio.page.TITLES`"""
    name: str = ""
    address: str = ""
    """of the chosen arm, or empty"""
    arm: Arm | None = None
    run: Path | None = None
    """folder of its repair"""
    job: str = ""
    """what is being done, or empty"""
    stage: rejoint.Stage | None = None
    """of a repair"""
    share: float = 0.0
    what: str = ""
    began: float = 0.0
    """[s] of `time.monotonic`: start of the stage, else of the job"""
    stopping: bool = False
    question: str = ""
    """what the job asks the owner, or empty"""
    choices: tuple[str, ...] = ()
    """answers to it; none: any text"""
    picture: Array | None = None
    """(height, width, 3) of a camera"""
    served: str = ""
    """address for other programs while the arm is served"""
    error: str = ""
    """why the last job ended early, and what to do"""
    done: str = ""
    """result of the last job"""
    lines: tuple[str, ...] = ()
    """newest messages"""
    found: dict[str, Any] = field(default_factory=dict)
    """results by name"""

    @property
    def busy(self) -> bool:
        """Whether a job is under way."""
        return bool(self.job)


class Studio(Observer):
    """Holds the status, and does one job at a time; any thread may ask.

    A job calls the public functions, or the session of `arm`, with `observer`.
    """

    def __init__(self, home: Path) -> None:
        """Begin without an arm; runs are below ``home``."""
        self.home = home
        self.observer: Observer = self
        """given to what drives the arm"""
        self.settings = rejoint.Settings()
        self.left = threading.Event()
        """the program is to end"""
        self._lock, self.status = threading.RLock(), Status()
        self._answers = queue.SimpleQueue[str | None]()
        self._stopped_by = ""
        self._session: rejoint.Session | None = None
        self.seen: JointState | None = None
        """newest reading of the arm"""
        warnings = logging.Handler(logging.WARNING)
        warnings.emit = lambda record: self.message(record.getMessage())  # type: ignore[method-assign]
        LOGGER.addHandler(warnings)
        self._thread = threading.Thread()

    def change(self, **fields: Any) -> None:  # noqa: ANN401 - of `Status`
        """Change fields of the status."""
        with self._lock:
            self.status = replace(self.status, **fields)

    def keep(self, **results: object) -> None:
        """Add results of a job; None removes one."""
        with self._lock:
            self.change(found={k: v for k, v in (self.status.found | results).items() if v is not None})

    @property
    def run(self) -> Run | None:
        """Run of the chosen arm, if it has begun."""
        path = self.status.run
        return None if path is None or not RunFolder(path).info.exists() else Run.open(path)

    # --- jobs ---------------------------------------------------------------------------------------

    def do(self, title: str, job: Job) -> bool:
        """Begin a job, unless one is under way; return whether it began."""
        with self._lock:
            if self.status.busy or self.left.is_set():
                return False
            self._stopped_by = ""
            self._answers = queue.SimpleQueue()
            self.change(job=title, share=0.0, what="", began=time.monotonic(), stage=None)
            self.change(error="", done="", lines=())
            self._thread = threading.Thread(target=self._work, args=(title, job), name="studio", daemon=True)
            self._thread.start()
            return True

    def stop(self, by: str = "the stop button") -> None:
        """End the job from any thread; a moving arm stops within a control period and holds."""
        with self._lock:
            if not self.status.busy:
                self.change(done="Nothing moves. The arm holds its position.")
                return
            self._stopped_by = by
            self.change(stopping=True, question="")
            self._answers.put(None)
            interrupt(by)  # still within the lock: else it could reach the next job

    def leave(self) -> None:
        """End the job, let the arm hold, and end the program."""
        self.left.set()
        self.stop("the end of the studio")
        if self._thread.is_alive():
            self._thread.join(10.0)
        self.release()

    def _work(self, title: str, job: Job) -> None:
        error = ""
        try:
            job(self)
        except BaseException as why:  # noqa: BLE001 - whatever it is, the page says it
            if isinstance(why, Interrupted):
                error = f"{title}: stopped by {why.by or 'a signal'}. The arm holds its position."
                if not why.by:  # a signal, which ends the program
                    self.left.set()
            else:
                error = "; ".join((failure_of(why).text, *getattr(why, "__notes__", ())))
                self.release()
        with self._lock:
            self.change(job="", stopping=False, question="", picture=None, served="", error=error)

    # --- the arm ------------------------------------------------------------------------------------

    def session(self) -> rejoint.Session:
        """Return the session of the chosen arm, which stays open for the next job."""
        if self._session is None:
            if not self.status.address:
                raise InputError("no arm is chosen yet; find it first")
            self._session = self.call(rejoint.connect, run=self.run)
        return self._session

    def call(self, work: Callable[..., T], *given: object, **options: object) -> T:
        """Call the public function ``work`` with the chosen arm, after closing the session."""
        self.release()
        about = {"arm": self.status.arm, "settings": self.settings, "observer": self.observer}
        return work(self.status.address, *given, **about | options)

    def release(self) -> None:
        """Close the session; the arm holds."""
        session, self._session, self.seen = self._session, None, None
        if session is not None:
            with suppress(RejointError, KeyboardInterrupt):
                session.close()

    def begin_run(self, *, quick: bool | None = None) -> Run:
        """Return the arm's repair, an interrupted or a new one; the session is closed for it.

        A run of a quick try goes on with ``quick`` ones alone.
        """
        self.release()
        status, path = self.status, self.status.run
        if status.arm is None:
            raise InputError("no arm is chosen yet; find it first")
        if path is None:
            home = self.home / plain_name(f"{status.name or status.arm.name}-{status.address}")
            path = newest_or_new(status.address, status.arm, home)
        if quick is False and RunFolder(path).quick.exists():
            path = unused(path)
        self.change(run=path)
        return Run.plan(path, status.address, status.arm, None, name=status.name)

    # --- what the job asks and tells ---------------------------------------------------------------

    def ask(self, question: str, *choices: str) -> str:
        """Ask the owner, and wait for the answer, one of the ``choices`` if any; Interrupted by `stop`."""
        self.change(question=question, choices=choices)
        answer = self._answers.get()
        if answer is None:
            self.heed()
            raise NotReadyError("the question was not answered")
        return answer

    def answer(self, question: str, text: str) -> None:
        """Answer this ``question``, once."""
        with self._lock:
            if question == self.status.question:
                self.change(question="")
                self._answers.put(text)

    def heed(self) -> None:
        """Raise Interrupted in the job if it is to end, unless the arm is being brought to rest."""
        if self._stopped_by and not ending() and threading.current_thread() is self._thread:
            raise Interrupted(2, self._stopped_by)

    def message(self, line: str) -> None:
        """See `Observer`."""
        self.change(lines=(*self.status.lines, line)[-LINES:])
        self.heed()

    def progress(self, share: float, what: str) -> None:
        """See `Observer`."""
        self.change(share=min(max(share, 0.0), 1.0), what=what)
        self.heed()

    def stage(self, stage: object) -> None:
        """See `Observer`."""
        self.change(stage=stage, share=0.0, began=time.monotonic())
        self.heed()

    def served(self, address: str) -> None:
        """See `Observer`."""
        self.change(served=address)

    def watch(self, robot: Robot, **facts: object) -> Robot:  # noqa: ARG002 - as `Observer` has it
        """See `Observer`."""
        return WatchedRobot(robot, self._see)

    def _see(self, state: JointState, _: Array | None) -> None:
        """Keep a reading, unless the job is to end: a stop between two motions counts in the next one."""
        self.heed()
        self.seen = state
