"""A process that runs part of a comparison on a second core.

It receives a `Job` and tasks over a pipe. It is not forked: threads would not survive.
"""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from multiprocessing.connection import Connection, Pipe
from queue import SimpleQueue
from threading import Thread
from typing import Any, Protocol

from rejoint.control.comparison.compare import Result, Task, TrialRunner
from rejoint.control.comparison.protocols import Places
from rejoint.system.shell import give_back

LEAST = 400
"""Targets of all trials that are worth a helper; chosen"""

_START = "import sys; sys.path[:] = {path!r}; from rejoint.runs.stages.helper import main; main({line})"


def core_to_spare() -> bool:
    """Whether a second core is free, by OMP_NUM_THREADS."""
    return os.name == "posix" and (os.cpu_count() or 1) > 1 and os.environ.get("OMP_NUM_THREADS") != "1"


class Job(Protocol):
    """A comparison of which a helper drives a part."""

    def runner(self, name: str) -> TrialRunner:
        """Runner of a controller's trials."""


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
        runner = job.runner(name)
        driven, recording = runner.drive_batch(runner.open_batch(places), name, kind, places)
        asked.send((driven, recording.of(slice(1))))
        give_back()


def _listen(asked: Connection, tasks: SimpleQueue[Any]) -> None:
    try:
        while True:
            tasks.put(asked.recv())
    except (OSError, EOFError):
        os._exit(0)
