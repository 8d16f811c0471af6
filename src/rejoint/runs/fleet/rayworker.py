"""The tasks and actors that Ray runs."""

from __future__ import annotations

import os
import signal
import threading
from typing import TYPE_CHECKING, Any

from rejoint.system.stopping import install

if TYPE_CHECKING:
    from rejoint.runs.fleet.campaign import Work, WorkOutcome

PULSE = 0.5
"""[s] between questions whether to hold an arm; chosen"""
SILENCE = 10.0
"""[s] without an answer until an arm is held; chosen"""


class Holds:
    """An actor that stores which arms to hold."""

    def __init__(self) -> None:
        self._names: set[str] = set()

    def hold(self, name: str) -> None:
        """Ask for a hold."""
        self._names.add(name)

    def wanted(self, name: str) -> bool:
        """Whether to hold an arm."""
        return name in self._names

    def over(self, name: str) -> None:
        """Forget an arm."""
        self._names.discard(name)


def work_in_task(work: Work) -> WorkOutcome:
    """Do a task that moves no real arm."""
    from rejoint.runs.fleet.campaign import do_work

    return do_work(work)


class ArmHolder:
    """An actor with a real arm's only connection, for one task."""

    def __init__(self) -> None:
        install()  # so that being ended brings the arm to a hold

    def do(self, work: Work, holds: Any) -> WorkOutcome:  # noqa: ANN401 - of Ray
        """Move the arm; hold it on request or without an answer."""
        stop = threading.Event()
        thread = threading.Thread(target=_watch, args=(holds, work.arm.name, stop), daemon=True)
        thread.start()
        try:
            return work_in_task(work)
        finally:
            stop.set()
            thread.join(PULSE)
            holds.over.remote(work.arm.name)


def _watch(holds: Any, name: str, stop: threading.Event) -> None:  # noqa: ANN401
    import ray

    while not stop.wait(PULSE):
        try:
            wanted = ray.get(holds.wanted.remote(name), timeout=SILENCE)
        except Exception:  # noqa: BLE001 - whatever it is, the call has ended
            wanted = True
        if wanted and not stop.is_set():
            os.kill(os.getpid(), signal.SIGTERM)
            return
