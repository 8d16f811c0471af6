"""A true Ray on this machine, started once: an emulated arm in tasks, whose process is killed, and one behind TCP."""

import os
import re
import signal
import subprocess
import sys
from datetime import datetime, timedelta
from functools import partial
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from msgspec.structs import replace

from rejoint.logs.runlog import RunLog
from rejoint.runs.fleet.campaign import FleetRules, run_fleet
from rejoint.runs.fleet.file import Fleet, FleetArm
from rejoint.runs.fleet.rayexecutor import RayExecutor
from rejoint.runs.stages.check import check
from rejoint.system.errors import InputError

pytestmark = pytest.mark.realtime

VIRTUAL = f"virtual-{os.getpid()}"
"""Name of the emulated arm; of all arms on this machine, its processes alone are killed"""
MONDAY = datetime(2026, 11, 23, 8)
MOVED = 10_000
"""[bytes] that the journal of the real arm has before its hours end: a second of motion or two"""


@pytest.fixture(scope="module")
def address():
    """An arm behind the vendor's protocol, in wall-clock time, as a real one."""
    words = [sys.executable, "-m", "rejoint", "emulate", "--port", "0"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as emulator:
        text = ""
        while (found := re.search(r"tcp://\S+:\d+(?=\s)", text)) is None:
            line = emulator.stdout.readline()
            assert line, text
            text += line
        yield found[0]
        emulator.terminate()


class World:
    """The clock of a call, and what happens meanwhile."""

    def __init__(self, folder):
        self.folder, self.events = folder, list[str]()
        self.late = False
        self.nice = set[int]()

    def now(self):
        """Kill what works on the emulated arm, once; it becomes evening when the real arm has moved."""
        if not any(f"{VIRTUAL}: check failed" in event for event in self.events):
            for process in working_on(VIRTUAL):
                self.nice.add(os.getpriority(os.PRIO_PROCESS, process))
                os.kill(process, signal.SIGKILL)
        journals = (self.folder / "checks" / "real").rglob("*.journal")
        self.late = self.late or any(path.stat().st_size > MOVED for path in journals)
        return MONDAY + timedelta(hours=12) if self.late else MONDAY


def working_on(name):
    """Return the processes that Ray has named after work on an arm."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if entry.read_bytes().startswith(f"ray::{name}:".encode()):
                found.append(int(entry.parent.name))
        except OSError:  # it has ended
            continue
    return found


@pytest.fixture(scope="module")
def called(address, tmp_path_factory):
    allowed = FleetArm(name=VIRTUAL, address="emulated:worn?seed=3", may_move=True, needs_somebody=False)
    real = replace(allowed, name="real", address=address, hours=["Mon-Fri 08:00-18:00"])
    home = tmp_path_factory.mktemp("fleet")
    fleet, world = Fleet(path=home / "FLEET.toml", folder=home / "lab", arms=(real, allowed)), World(home / "lab")
    rules, executor = FleetRules(now=world.now), partial(RayExecutor, cpus=1)
    own = signal.signal(signal.SIGINT, signal.SIG_IGN)  # as in a background job of a script; workers inherit it
    other = signal.getsignal(signal.SIGTERM)
    found = run_fleet(fleet, "check", executor, rules, tell=world.events.append)
    assert signal.getsignal(signal.SIGTERM) == other
    assert signal.signal(signal.SIGINT, own) == signal.SIG_IGN
    again = run_fleet(fleet, "check", executor, rules, only=(VIRTUAL,))
    return found, world, again


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for the process to kill in /proc")
def test_work_whose_process_was_killed_is_done_by_the_next_call_to_the_same_bits(called, tmp_path):
    found, world, again = called
    row = next(row for row in found.rows if row.name == VIRTUAL)
    assert (row.end, row.code) == ("failed", 4)
    (row,) = again.rows
    assert row.end == "done"
    (log,) = row.folder.glob("*/check.parquet")
    alone = check("emulated:worn?seed=3", history=tmp_path, name=VIRTUAL)
    np.testing.assert_array_equal(RunLog.load(log).position, RunLog.load(alone.folder / "check.parquet").position)
    assert row.error_mm == alone.measures.error_mm
    assert world.folder.joinpath("fleet", "check.html").exists()
    assert world.nice == {os.getpriority(os.PRIO_PROCESS, 0)}  # else whatever else runs here delays control loops


def test_a_real_arm_is_held_at_the_end_of_its_hours_and_its_motion_is_kept(called):
    found, world, _ = called
    row = next(row for row in found.rows if row.name == "real")
    assert (row.end, row.code) == ("left", 5), row.found
    assert "held during check; its hours begin Tue 2026-11-24 08:00" in row.found
    (log,) = world.folder.glob("checks/real/*/*.parquet")
    assert 0.5 < np.ptp(RunLog.load(log).time) < 30.0


def test_what_ray_itself_refuses_late_is_refused_at_once(monkeypatch):
    """An import without its token after twenty seconds, a place without a cluster after twenty minutes."""
    imported = ModuleType("ray")
    imported.__spec__, imported.exceptions = ModuleSpec("ray", None), SimpleNamespace(RayError=RuntimeError)
    monkeypatch.setitem(sys.modules, "ray", imported)
    monkeypatch.delenv("RAY_AUTH_MODE", raising=False)
    with pytest.raises(InputError, match="begin a new Python"):
        RayExecutor([])
    with pytest.raises(InputError, match=r"cannot be used at 127.0.0.1:1: .*refused"):
        RayExecutor([], address="127.0.0.1:1")
