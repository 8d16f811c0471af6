"""A process of its own that drives a part of a comparison in virtual time, so that a second core has work.

It is given a `Job` over a pipe, then one task after the other, and answers over the same. It writes no file, and ends
when the pipe does: with the process that started it, however that ends. It is not forked:
what runs in threads here, such as the sums of a training before, would not go on there.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Any

from rejoint.arms import Arm, Array
from rejoint.arms.orientation import Orientation
from rejoint.control.comparison.compare import Settings, TrialRunner
from rejoint.control.comparison.counting import Targets
from rejoint.control.comparison.driven import Places
from rejoint.control.comparison.ledger import Ledger
from rejoint.control.comparison.protocols import Kind
from rejoint.control.comparison.sharing import HelperLostError, Result, Task
from rejoint.control.correction import Correction
from rejoint.control.guard import GuardLimits
from rejoint.control.robot import Robot
from rejoint.robots import open_robot
from rejoint.runs.given import Period, as_run, period_of
from rejoint.runs.stages.controllers import make_factories
from rejoint.system.memory import give_back
from rejoint.system.progress import no_progress
from rejoint.twin.twin import Twin

LEAST = 400
"""Targets of all trials from which a helper is worth its start (chosen: it takes two seconds; a repair has 720)"""

_START = "import sys; sys.path[:] = {path!r}; from rejoint.runs.stages.helper import main; main({line})"


def core_to_spare() -> bool:
    """Tell whether this process may use a second core: Ray and others limit what they start to one by this variable.

    On Windows no process is started, which inherits nothing there.
    """
    return os.name == "posix" and (os.cpu_count() or 1) > 1 and os.environ.get("OMP_NUM_THREADS") != "1"


@dataclass(frozen=True, kw_only=True, eq=False)
class Job:
    """What a helper must know of a comparison."""

    robot: str
    arm: Arm
    run: Path | None
    twin: Twin | None
    period: Period | None
    names: tuple[str, ...]
    """of the controllers"""
    targets: Array
    turns: Orientation | None
    settings: Settings
    limits: GuardLimits | None
    correct: Callable[[Arm], Correction] | None

    def runner(self) -> TrialRunner:
        """Put together what drives the trials."""
        run, period = None if self.run is None else as_run(self.run), period_of(self.robot, self.period)
        factories = make_factories(self.names, self.arm, period, run=run, twin=self.twin, posed=self.turns is not None)
        shape = (len(self.targets), self.settings.repetitions, self.targets.shape[1])
        return TrialRunner(
            open_robot=self._open, controllers=factories, targets=self.targets, settings=self.settings, shape=shape,
            tallies={}, ledger=Ledger.nowhere(), limits=self.limits, stance=None, correction=self.correct, model=None,
            progress=Targets(no_progress, 1), on_trial=None, measured=(), source="", turns=self.turns,
        )  # fmt: skip

    def _open(self, count: int, seed: int) -> Robot:
        return open_robot(self.robot, arm=self.arm, seed=seed, count=count, period=self.period, threads=1)


class HelperProcess:
    """A running helper; whoever starts it must `close` it."""

    def __init__(self, job: Job) -> None:
        self._line, other = Pipe()
        self._job: Job | None = job
        self._process: subprocess.Popen[bytes] | None = None
        with other, suppress(OSError):  # no process to be had: it is lost from the beginning
            self._process = subprocess.Popen(  # noqa: S603 - this very interpreter
                [sys.executable, "-c", _START.format(path=sys.path, line=other.fileno())],
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                pass_fds=(other.fileno(),),
                start_new_session=True,  # Ctrl-C is for the process that started it
            )  # fmt: skip

    def drive(self, task: Task, places: Places) -> Result:
        """Drive the trials of a task and wait for what comes out; HelperLostError if that fails."""
        try:
            if self._job is not None:
                self._line.send(self._job)
                self._job = None
            self._line.send((task, places))
            found: Result = self._line.recv()
        except Exception as error:  # whatever it is, the trial is driven elsewhere
            raise HelperLostError from error
        return found

    def rank(self, _task: Task) -> int:
        """Tell that no task is nearer than another."""
        return 0

    def close(self) -> None:
        """End it, whatever it does."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self._line.close()


def main(line: int) -> None:
    """Do what `HelperProcess` asks for at the other end of a ``line``, by its file descriptor."""
    asked, tasks = Connection(line), SimpleQueue[Any]()
    Thread(target=_listen, args=(asked, tasks), daemon=True).start()
    runner = tasks.get().runner()
    while True:
        (name, kind), places = tasks.get()
        asked.send(_drive(runner, name, kind, places))
        give_back()


def _drive(runner: TrialRunner, name: str, kind: Kind, places: Places) -> Result:
    """Drive the trials of a task, and keep what was recorded of the first: its log is kept, those of others are not."""
    driven, recording = runner.drive_batch(runner.open_batch(places), name, kind, places)
    return driven, recording.of(slice(1))


def _listen(asked: Connection, tasks: SimpleQueue[Any]) -> None:
    """Pass on what is asked for, and end this process with the one that asks."""
    try:
        while True:
            tasks.put(asked.recv())
    except (OSError, EOFError):
        os._exit(0)
