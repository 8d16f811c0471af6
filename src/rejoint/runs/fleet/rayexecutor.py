"""An executor on Ray: tasks on a cluster, and an actor for each moving real arm. Ray retries nothing."""

from __future__ import annotations

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
from typing import Any

from rejoint.runs.fleet.campaign import Work, WorkOutcome, do_work
from rejoint.runs.fleet.file import FleetArm
from rejoint.system.errors import InputError, first_line
from rejoint.system.extras import require
from rejoint.system.stopping import check, install, noted

STORE = 80 * 2**20
"""[bytes] of Ray's object store; chosen: Ray's minimum"""

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
            return do_work(work)
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


class RayExecutor:
    """Ray on this machine, or the cluster at ``address``."""

    def __init__(
        self,
        arms: Sequence[FleetArm],
        *,
        address: str | None = None,
        cpus: int | None = None,
        training_cpus: float = 1.0,
    ) -> None:
        """Start Ray or connect; InputError without the cluster, or if it does not reach an arm."""
        require("rejoint fleet", "fleet")
        real = [arm for arm in arms if not arm.virtual]
        self._training_cpus, self._running = training_cpus, {}  # type: float, dict[Any, tuple[Work, Any]]
        self._ray = _begun(address, cpus, {arm.resource: 1.0 for arm in real})
        try:
            self.cpus = int(self._ray.cluster_resources().get("CPU", 0))
            self._require_reached(real, address)
            self._holds = self._ray.remote(num_cpus=0)(Holds).remote()
            self._work = self._ray.remote(max_retries=0)(do_work)
            self._arm = self._ray.remote(num_cpus=0, max_restarts=0, max_task_retries=0)(ArmHolder)
        except BaseException:
            self.close()
            raise

    def begin(self, work: Work) -> None:
        """Start a task, in an actor at the arm's computer if a real arm moves."""
        self._holds.over.remote(work.arm.name)  # a wish to hold that came after the last work had ended
        if not work.held:
            cpus = self._training_cpus if work.step == "train" else 1.0
            task = self._work.options(num_cpus=cpus, name=f"{work.arm.name}:{work.step}")
            self._running[task.remote(work)] = work, None
            return
        holder = self._arm.options(resources={work.arm.resource: 1.0}).remote()
        self._running[holder.do.remote(work, self._holds)] = work, holder

    def wait(self, timeout: float) -> list[tuple[Work, WorkOutcome]]:
        """Return ended tasks within ``timeout`` [s]."""
        references = list(self._running)
        if not references:
            return []
        ready, _ = self._ray.wait(references, num_returns=1, timeout=timeout)
        if ready:
            ready, _ = self._ray.wait(references, num_returns=len(references), timeout=0.0)
        return [self._ended(reference) for reference in ready]

    def hold(self, work: Work) -> None:
        """Ask for a hold of the arm."""
        self._holds.hold.remote(work.arm.name)

    def close(self) -> None:
        """Release all processes; a cluster stays."""
        with noted():  # for a second Ctrl-C as for the first, see `_begun`
            self._ray.shutdown()

    def _ended(self, reference: Any) -> tuple[Work, WorkOutcome]:  # noqa: ANN401 - of Ray
        work, holder = self._running.pop(reference)
        try:
            found: WorkOutcome = self._ray.get(reference)
        except self._ray.exceptions.RayTaskError as error:  # before the work had begun: another version there, say
            found = WorkOutcome(problem=f"a bug: {_last_line(error)}", code=1, trace=str(error))
        except self._ray.exceptions.RayError as error:
            found = WorkOutcome(problem=type(error).__name__, lost=True)
        if holder is not None:
            self._ray.kill(holder)
        return work, found

    def _require_reached(self, arms: Sequence[FleetArm], address: str | None) -> None:
        known = self._ray.cluster_resources()
        missing = [arm for arm in arms if arm.resource not in known]
        if missing:
            names = ", ".join(arm.name for arm in missing)
            one = missing[0].resource
            raise InputError(
                f"no computer of the cluster {address} says that it reaches {names}; on the one that does, run: "
                f"ray start --address={address} --num-cpus=0 --resources='{{\"{one}\": 1}}'"
            )


def has_token() -> bool:
    """Whether this computer has a cluster token."""
    named = any(name in os.environ for name in ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"))
    return os.environ.get("RAY_AUTH_MODE") != "disabled" and (named or Path("~/.ray/auth_token").expanduser().exists())


def _begun(address: str | None, cpus: int | None, resources: dict[str, float]) -> Any:  # noqa: ANN401
    with noted():
        with _own_signals():
            ray = _started(address, cpus, resources)
        try:
            check()
        except BaseException:
            ray.shutdown()
            raise
    return ray


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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Ray's own, about itself
        import ray

        try:
            ray.init(**how, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
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


def _last_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[-1]
