"""A process that runs part of a comparison on a second core.

It receives a `Job` and tasks over a pipe. It is not forked: threads would not survive.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Any

from rejoint.arms import Arm, Array
from rejoint.arms.rotations import Orientation
from rejoint.control.comparison.compare import Result, Settings, Task, TrialRunner
from rejoint.control.comparison.protocols import Kind, Places
from rejoint.control.correction import Modelled
from rejoint.control.guard import GuardLimits
from rejoint.control.robot import Robot
from rejoint.robots import open_robot
from rejoint.session.controllers import make_factories
from rejoint.session.inputs import Period, as_run, period_of
from rejoint.system.shell import give_back
from rejoint.twin.twin import Twin

LEAST = 400
"""Targets of all trials that are worth a helper; chosen"""

_START = "import sys; sys.path[:] = {path!r}; from rejoint.runs.stages.helper import main; main({line})"


def core_to_spare() -> bool:
    """Whether a second core is free, by OMP_NUM_THREADS."""
    return os.name == "posix" and (os.cpu_count() or 1) > 1 and os.environ.get("OMP_NUM_THREADS") != "1"


@dataclass(frozen=True, kw_only=True, eq=False)
class Job:
    """A helper's part of a comparison."""

    robot: str
    arm: Arm
    run: Path | None
    twin: Twin | None
    period: Period | None
    targets: Array
    turns: Orientation | None
    settings: Settings
    limits: GuardLimits | None
    correct: Callable[[Arm], Modelled] | None

    @property
    def places(self) -> Places:
        """Target sets and repetitions."""
        return tuple((s, r) for s in range(len(self.targets)) for r in range(self.settings.repetitions))

    def runner(self, name: str) -> TrialRunner:
        """Runner of a controller's trials."""
        run, period = None if self.run is None else as_run(self.run), period_of(self.robot, self.period)
        factories = make_factories([name], self.arm, period, run=run, twin=self.twin, posed=self.turns is not None)
        return TrialRunner(
            self._open,
            factories,
            self.targets,
            self.settings,
            turns=self.turns,
            limits=self.limits,
            correction=self.correct,
        )

    def _open(self, count: int, seed: int) -> Robot:
        return open_robot(self.robot, arm=self.arm, seed=seed, count=count, period=self.period, threads=1)


class HelperProcess:
    """A running helper; close it."""

    def __init__(self, job: Job) -> None:
        self._line, other = Pipe()
        self._job: Job | None = job
        self._process: subprocess.Popen[bytes] | None = None
        with other, suppress(OSError):  # no process to be had: its tasks fail
            self._process = subprocess.Popen(  # noqa: S603 - this very interpreter
                [sys.executable, "-c", _START.format(path=sys.path, line=other.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=(other.fileno(),),
                start_new_session=True,  # Ctrl-C is for the process that started it
            )
        self._asking = ThreadPoolExecutor(1)
        self._futures: dict[tuple[Task, Places], Future[Result]] = {}

    def __call__(self, task: Task, places: Places) -> Future[Result]:
        """Have the trials of a task driven, once."""
        if (task, places) not in self._futures:
            self._futures[task, places] = self._asking.submit(self._ask, task, places)
        return self._futures[task, places]

    def _ask(self, task: Task, places: Places) -> Result:
        if self._job is not None:
            self._line.send(self._job)
            self._job = None
        self._line.send((task, places))
        found: Result = self._line.recv()
        return found

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self._asking.shutdown(cancel_futures=True)
        self._line.close()


def main(line: int) -> None:
    """Serve `HelperProcess` at file descriptor ``line``."""
    asked, tasks = Connection(line), SimpleQueue[Any]()
    Thread(target=_listen, args=(asked, tasks), daemon=True).start()
    job: Job = tasks.get()
    while True:
        (name, kind), places = tasks.get()
        asked.send(_drive(job.runner(name), name, kind, places))
        give_back()


def _drive(runner: TrialRunner, name: str, kind: Kind, places: Places) -> Result:
    driven, recording = runner.drive_batch(runner.open_batch(places), name, kind, places)
    return driven, recording.of(slice(1))


def _listen(asked: Connection, tasks: SimpleQueue[Any]) -> None:
    try:
        while True:
            tasks.put(asked.recv())
    except (OSError, EOFError):
        os._exit(0)
