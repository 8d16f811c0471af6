"""An executor on Ray: tasks on a cluster, those that move a real arm at its computer. Ray retries nothing."""

import logging
import os
import secrets
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from socket import create_connection
from typing import Any

from rejoint.runs.failure import kept
from rejoint.runs.fleet.campaign import HELD, ROBOT, Work, WorkOutcome, do_work
from rejoint.runs.fleet.file import FleetArm
from rejoint.system.errors import InputError, first_line
from rejoint.system.shell import host_and_port
from rejoint.system.stopping import check, install, noted

STORE = 80 * 2**20
"""[bytes] of Ray's object store; chosen: Ray's minimum"""


PULSE, SILENCE = 0.5, 10.0
"""[s] between questions to the cluster, and without an answer until an arm is held; chosen"""


def _drive(work: Work) -> WorkOutcome:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # by which Ray interrupts; a background job ignores it
    install()
    over = threading.Event()
    if work.held:
        threading.Thread(target=_watch, args=(over,), daemon=True).start()
    try:
        return do_work(work)
    finally:
        over.set()


def _watch(over: threading.Event) -> None:
    """End this process as by SIGTERM where the cluster does not answer before work is ``over``."""
    import ray

    while not over.wait(PULSE):
        alarm = threading.Timer(SILENCE, os.kill, (os.getpid(), signal.SIGTERM))
        alarm.daemon = True
        alarm.start()
        ray.nodes()
        alarm.cancel()


class RayExecutor:
    """Ray on this machine, or the cluster at ``address``."""

    def __init__(self, arms: Sequence[FleetArm], *, address: str | None = None, cpus: int | None = None) -> None:
        """Start Ray or connect; InputError without the cluster, or if it does not reach an arm."""
        real = {arm.resource for arm in arms if not arm.virtual}
        self._running = dict[Any, Work]()
        with noted():
            with _own_signals():
                self._ray = _started(address, cpus, dict.fromkeys(real, 1.0))
            try:
                check()
            except BaseException:
                self._ray.shutdown()
                raise
        missing = sorted(real - self._ray.cluster_resources().keys())
        if missing:
            self.close()
            raise InputError(
                f"no computer of the cluster {address} has the resource {' and '.join(missing)}; on the one "
                f"that reaches that arm, run: ray start --address={address} --num-cpus=0 "
                f"--resources='{{\"{missing[0]}\": 1}}'"
            )
        self._task = self._ray.remote(max_retries=0)(_drive)

    def begin(self, work: Work) -> None:
        """Start a task, at the arm's computer if a real arm moves."""
        resources = {work.arm.resource: 1.0} if work.held else {}
        name = f"{work.arm.name}:{work.step}"
        task = self._task.options(num_cpus=0.0 if work.held else 1.0, resources=resources, name=name)
        self._running[task.remote(work)] = work

    def wait(self, timeout: float) -> list[tuple[Work, WorkOutcome]]:
        """Return ended tasks within ``timeout`` [s]."""
        if not self._running:
            return []
        ready, _ = self._ray.wait(list(self._running), num_returns=1, timeout=timeout)
        return [self._ended(reference) for reference in ready]

    def hold(self, work: Work) -> None:
        """Interrupt a task, so that its arm holds."""
        for reference, running in self._running.items():
            if running is work:
                self._ray.cancel(reference)

    def close(self) -> None:
        """Release all processes; a cluster stays."""
        with noted():  # for a second Ctrl-C as for the first, see `__init__`
            self._ray.shutdown()

    def _ended(self, reference: Any) -> tuple[Work, WorkOutcome]:  # noqa: ANN401 - of Ray
        work, ray = self._running.pop(reference), self._ray.exceptions
        try:
            return work, self._ray.get(reference)
        except ray.TaskCancelledError:  # before it had begun
            return work, WorkOutcome(problem=HELD)
        except ray.RayTaskError as error:  # before the work had begun: another version there, say
            line = (str(error).strip().splitlines() or [type(error).__name__])[-1]
            return work, WorkOutcome(problem=f"a bug: {line}; where it is: {kept([str(error)])}", code=1)
        except ray.RayError as error:
            look = ": look at the arm, then go on" if work.held else ""
            return work, WorkOutcome(problem=f"its process was lost ({type(error).__name__}){look}", code=ROBOT)


def has_token() -> bool:
    """Whether this computer has a cluster token."""
    named = any(name in os.environ for name in ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"))
    return os.environ.get("RAY_AUTH_MODE") != "disabled" and (named or Path("~/.ray/auth_token").expanduser().exists())


def _started(address: str | None, cpus: int | None, resources: dict[str, float]) -> Any:  # noqa: ANN401
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray reports nothing
    # Its handler of faults takes SIGTERM for one while Ray starts, and aborts the process three seconds later.
    os.environ.setdefault("RAY_DISABLE_FAILURE_SIGNAL_HANDLER", "1")
    os.environ.setdefault("RAY_worker_niceness", "0")  # else 15: whatever else runs here would delay control loops
    how: dict[str, Any] = {"address": address}
    if address is None:  # no other process may send it work, from outside or on this machine
        if "ray" not in sys.modules:  # it looks at these when it is imported
            os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")  # its way to listen on loopback alone
        elif os.environ.get("RAY_AUTH_MODE") != "token":
            raise InputError(
                "Ray was imported before rejoint could turn on its token; begin a new Python and leave that import to "
                "rejoint, or set RAY_AUTH_MODE=token before it"
            )
        os.environ["RAY_AUTH_MODE"] = "token"
        os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
        how = {"address": "local", "num_cpus": cpus, "resources": resources, "include_dashboard": False}
        how["object_store_memory"] = STORE
    with warnings.catch_warnings(action="ignore"):  # Ray's own, about itself
        import ray

        try:
            if address is not None:  # where nothing listens, Ray itself would try for twenty minutes
                create_connection(host_and_port("--address", address), SILENCE).close()
            ray.init(**how, log_to_driver=False, logging_level=logging.ERROR)
        except (OSError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
            where = "on this machine" if address is None else f"at {address}"
            raise InputError(f"Ray cannot be used {where}: {first_line(error)}") from error
    return ray


@contextmanager
def _own_signals() -> Iterator[None]:
    set_handler = signal.signal
    main = threading.current_thread() is threading.main_thread()  # no other thread sets any
    try:
        if main:
            signal.signal = lambda signum, _: signal.getsignal(signum)  # type: ignore[assignment]
        yield
    finally:
        if main:
            signal.signal = set_handler
