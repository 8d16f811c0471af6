"""Trials of a comparison that need no policy, driven by a second process while the policy is still being trained."""

from __future__ import annotations

from collections import deque
from threading import Thread

from rejoint.control.comparison.driven import Places
from rejoint.control.comparison.protocols import KINDS
from rejoint.control.comparison.sharing import HelperLostError, Result, Task
from rejoint.runs.stages.helper import HelperProcess, Job


class EarlyTrials:
    """A helper that has begun before the comparison it works for; whoever starts it must `close` it.

    What a trial brings does not depend on when it is driven, so the comparison is the same to the bit.
    """

    def __init__(self, job: Job) -> None:
        sets = len(job.targets)
        self._places: Places = tuple((s, r) for s in range(sets) for r in range(job.settings.repetitions))
        self._names = frozenset(job.names)
        names = (*job.names[:1], *job.names[:0:-1])  # longest first: `default` waits for every target, a plan thinks
        self._left = deque((name, kind) for name in names for kind in KINDS)
        self._begun: set[Task] = set()
        self._done: dict[Task, Result] = {}
        self._helper = HelperProcess(job)
        self._worker = Thread(target=self._work, daemon=True)
        self._worker.start()

    def settle(self) -> None:
        """Begin nothing more: from now on the comparison says what is to be driven."""
        self._left.clear()

    def rank(self, task: Task) -> int:
        """Tell how near a task is: 2 for one that is begun or done, 1 for one that could be, 0 for a stranger's."""
        return 2 if task in self._begun else int(task[0] in self._names)

    def drive(self, task: Task, places: Places) -> Result:
        """Hand over what a task brought, or drive its trials now; HelperLostError if that fails."""
        if places != self._places or not self.rank(task):
            raise HelperLostError
        if task not in self._done:
            self._worker.join()  # it speaks with the helper until then
        return self._done.pop(task) if task in self._done else self._helper.drive(task, places)

    def close(self) -> None:
        """End it, whatever it does."""
        self.settle()
        self._helper.close()

    def _work(self) -> None:
        while True:
            try:
                task = self._left.popleft()
            except IndexError:
                return
            self._begun.add(task)
            try:
                self._done[task] = self._helper.drive(task, self._places)
            except HelperLostError:
                return
