"""What holds for all tests."""

import os
import signal
import sys
from collections.abc import Iterator

# As many tests run side by side as there are cores: threads of one would only wait for those of the others. Small
# matrices gain nothing from threads either.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import mujoco
import pytest
from hypothesis import HealthCheck, settings

from commandline import Told
from rejoint.system.stopping import SIGNALS

# The same cases in every run, and no test fails since the machine was slow.
settings.register_profile("rejoint", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("rejoint")

# A shell lets what it starts in the background ignore Ctrl-C; what tests start would inherit that.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def own_signals() -> Iterator[None]:
    """A command leaves its signal handlers to its process, and an interruption with them: not to the next test."""
    before = {signum: signal.getsignal(signum) for signum in SIGNALS}
    yield
    for signum, handler in before.items():
        signal.signal(signum, handler)


@pytest.fixture(autouse=True)
def stable_simulations() -> Iterator[None]:
    """A simulation that diverges fails its test; MuJoCo itself would only write it into a file."""
    warnings: list[str] = []
    mujoco.set_mju_user_warning(warnings.append)
    yield
    mujoco.set_mju_user_warning(None)
    assert not warnings, f"MuJoCo warned {len(warnings)} times: {warnings[0]}"


@pytest.fixture(scope="module")
def few_targets() -> Iterator[None]:
    """A diagnosis drives to three targets instead of ten."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rejoint.diagnosis.excitation.TARGETS", 3)
        yield


@pytest.fixture
def cli(capsys, monkeypatch):
    """`cli(*words)` runs `rejoint WORDS` in this process, which ends with ``code``."""
    from rejoint.cli import main

    def run(*words, code=0):
        monkeypatch.setattr(sys, "argv", ["rejoint", *map(str, words)])
        with pytest.raises(SystemExit) as stopped:
            main()
        told = Told(int(stopped.value.code or 0), *capsys.readouterr())
        assert code is None or told.code == code, told.err
        return told

    return run


@pytest.fixture
def studio(tmp_path):
    """A studio, which leaves its arm at the end."""
    from rejoint.studio.machine import Studio

    machine = Studio(tmp_path / "runs")
    yield machine
    machine.leave()
