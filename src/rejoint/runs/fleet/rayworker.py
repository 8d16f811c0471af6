"""What Ray runs: work on an arm in a process of its own, and the actor in which all of them report.

The actor is a process as well, and imports this module: what only work needs comes when there is some.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rejoint.system.progress import Progress
from rejoint.system.stopping import install

if TYPE_CHECKING:
    from rejoint.runs.fleet.work import Work, WorkOutcome

PULSE = 0.5
"""[s] between two reports of what is at work (chosen: nobody reads faster)"""
SILENCE = 10.0
"""[s] without an answer after which an arm is brought to a hold (chosen: longer than a busy network is
silent, and no cycle of control waits for it)"""


class Reports:
    """An actor that holds what everybody reports, and whom to hold."""

    def __init__(self) -> None:
        self._shares: dict[str, tuple[float, str]] = {}
        self._hold: set[str] = set()

    def pulse(self, name: str, share: float, what: str) -> bool:
        """Take a report; returns whether the arm is to be held."""
        self._shares[name] = share, what
        return name in self._hold

    def over(self, name: str) -> None:
        """Forget an arm whose work has ended."""
        self._shares.pop(name, None)
        self._hold.discard(name)

    def hold(self, name: str) -> None:
        """Have an arm brought to a hold."""
        self._hold.add(name)

    def shares(self) -> dict[str, tuple[float, str]]:
        """Return all reports."""
        return self._shares


def work_in_task(work: Work, reports: Any) -> WorkOutcome:  # noqa: ANN401 - of Ray
    """Do work in which nothing real moves; reports go out and are not waited for."""
    return _done_beside(_report, work, reports)


class ArmHolder:
    """An actor that has the only connection to a real arm, for one piece of work."""

    def __init__(self) -> None:
        install()  # so that being ended brings the arm to a hold

    def do(self, work: Work, reports: Any) -> WorkOutcome:  # noqa: ANN401 - of Ray
        """Do work in which the arm moves; it is held where that is asked for, or nobody answers."""
        return _done_beside(_watch, work, reports)


def _done_beside(tell: Callable[..., None], work: Work, reports: Any) -> WorkOutcome:  # noqa: ANN401
    """Do work while a thread tells ``reports`` how far it is."""
    from rejoint.runs.fleet.work import do_work

    stop = threading.Event()
    state = [0.0, ""]
    thread = threading.Thread(target=tell, args=(reports, work.arm.name, state, stop), daemon=True)
    thread.start()
    try:
        return do_work(work, _into(state))
    finally:
        stop.set()
        thread.join(PULSE)
        reports.over.remote(work.arm.name)


def _into(state: list[Any]) -> Progress:
    def update(share: float, what: str) -> None:
        state[:] = share, what

    return update


def _report(reports: Any, name: str, state: list[Any], stop: threading.Event) -> None:  # noqa: ANN401
    while not stop.wait(PULSE):
        reports.pulse.remote(name, *state)


def _watch(reports: Any, name: str, state: list[Any], stop: threading.Event) -> None:  # noqa: ANN401
    """Report, and have the arm held where that is asked for or nobody is there who could ask."""
    import ray

    while not stop.wait(PULSE):
        try:
            wanted = ray.get(reports.pulse.remote(name, *state), timeout=SILENCE)
        except Exception:  # noqa: BLE001 - whatever it is, nobody leads any more
            wanted = True
        if wanted and not stop.is_set():
            os.kill(os.getpid(), signal.SIGTERM)
            return
