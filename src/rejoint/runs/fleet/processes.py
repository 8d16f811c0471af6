"""An executor of processes: each task in a Python of its own, here or where the file with the arms says."""

from __future__ import annotations

import os
import pickle
import select
import shlex
import signal
import subprocess
import sys
import threading
from contextlib import suppress

import msgspec

from rejoint.runs.fleet.campaign import Work, WorkOutcome, do_work
from rejoint.system.stopping import close, install

SILENCE = 10.0
"""[s] without a pulse until an arm is held; chosen"""
_OWN = {"OMP_NUM_THREADS": "1"}
"""Environment of a task: many run side by side"""


class ProcessExecutor:
    """Sends a task to the standard input of its process, then a pulse while it may go on; reads how it ended."""

    def __init__(self) -> None:
        self.running: list[tuple[Work, subprocess.Popen[bytes]]] = []

    def begin(self, work: Work) -> None:
        """Start a task and return at once; OSError if its Python is not there."""
        words = [*(shlex.split(work.arm.python) or [sys.executable]), "-m", __name__]
        process = subprocess.Popen(  # noqa: S603 - the user names the arm's Python
            words,
            bufsize=0,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | _OWN,
            start_new_session=True,  # Ctrl-C is for the call that leads
        )
        self.running.append((work, process))
        _send(process, pickle.dumps(work))

    def wait(self, timeout: float) -> list[tuple[Work, WorkOutcome]]:
        """Return ended tasks within ``timeout`` [s]."""
        for _, process in self.running:
            _send(process, b".")
        ready, _, _ = select.select([pipe for _, one in self.running if (pipe := one.stdout)], [], [], timeout)
        ended = [one for one in self.running if one[1].stdout in ready]
        self.running = [one for one in self.running if one not in ended]
        return [(work, _outcome(process)) for work, process in ended]

    def hold(self, work: Work) -> None:
        """Ask for a hold of the arm: its process sees the end of its input."""
        for other, process in self.running:
            if other is work and process.stdin is not None:
                process.stdin.close()

    def close(self) -> None:
        """End all processes."""
        for _, process in self.running:
            with process:
                process.kill()


def _send(process: subprocess.Popen[bytes], content: bytes) -> None:
    if process.stdin is not None and not process.stdin.closed:
        with suppress(BrokenPipeError):  # it has ended, as `wait` sees
            process.stdin.write(content)


def _outcome(process: subprocess.Popen[bytes]) -> WorkOutcome:
    with process:
        told = b"" if process.stdout is None else process.stdout.read()
    try:
        return msgspec.json.decode(told, type=WorkOutcome)
    except msgspec.MsgspecError:
        return WorkOutcome(problem=f"its process ended with {process.returncode}", lost=True)


def main() -> None:
    """Do the task from standard input, and answer with its outcome."""
    install()  # so that a wish to end brings the arm to a hold
    answer = os.dup(1)
    os.dup2(2, 1)  # what else is printed is no answer
    work: Work = pickle.load(sys.stdin.buffer)  # noqa: S301 - from the process that started this one
    threading.Thread(target=_watch, daemon=True).start()
    outcome = do_work(work)
    close()
    os.write(answer, msgspec.json.encode(outcome))


def _watch() -> None:
    """Bring the arm to a hold when the pulse ends."""
    while select.select([0], [], [], SILENCE)[0] and os.read(0, 1024):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    main()
