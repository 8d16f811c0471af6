"""True processes, started once: those of an emulated arm, of which one is killed, and of one behind TCP."""

import re
import signal
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
import pytest

from rejoint.logs.runlog import RunLog
from rejoint.runs.fleet.campaign import Rules, run_fleet
from rejoint.runs.fleet.file import Fleet, FleetArm, read_hours
from rejoint.runs.fleet.processes import ProcessExecutor
from rejoint.runs.stages.check import check

pytestmark = pytest.mark.realtime

VIRTUAL = "virtual"
"""Name of the emulated arm"""
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
        self.executor = ProcessExecutor()

    def now(self):
        """Kill what works on the emulated arm, once; it becomes evening when the real arm has moved."""
        if not any(f"{VIRTUAL}: check failed" in event for event in self.events):
            for work, process in self.executor.running:
                if work.arm.name == VIRTUAL:
                    process.kill()
        journals = (self.folder / "checks" / "real").rglob("*.journal")
        self.late = self.late or any(path.stat().st_size > MOVED for path in journals)
        return MONDAY + timedelta(hours=12) if self.late else MONDAY


@pytest.fixture(scope="module")
def called(address, tmp_path_factory):
    allowed = FleetArm(
        python=f"env {sys.executable}",
        name=VIRTUAL,
        address="emulated:worn?seed=3",
        may_move=True,
        needs_somebody=False,
    )
    real = replace(allowed, name="real", address=address, hours=read_hours(["Mon-Fri 08:00-18:00"]))
    home = tmp_path_factory.mktemp("fleet")
    fleet, world = Fleet(path=home / "FLEET.toml", folder=home / "lab", arms=(real, allowed)), World(home / "lab")
    rules = Rules(now=world.now)
    before = [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)]
    found = run_fleet(fleet, "check", closing(world.executor), rules, tell=world.events.append)
    assert [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)] == before
    again = run_fleet(fleet, "check", closing(ProcessExecutor()), rules, only=(VIRTUAL,))
    return found, world, again


def test_work_whose_process_was_killed_is_done_by_the_next_call_to_the_same_bits(called, tmp_path):
    found, world, again = called
    row = next(row for row in found.rows if row.name == VIRTUAL)
    assert (row.end, row.code) == ("failed", 4)
    (row,) = again.rows
    assert row.end == "done"
    (log,) = row.folder.glob("*/check.parquet")
    alone = check("emulated:worn?seed=3", history=tmp_path, name=VIRTUAL)
    np.testing.assert_array_equal(RunLog.load(log).position, RunLog.load(alone.folder / "check.parquet").position)
    assert row.error_mm == alone.measures.true_error_mm
    assert world.folder.joinpath("fleet", "check.html").exists()


def test_a_real_arm_is_held_at_the_end_of_its_hours_and_its_motion_is_kept(called):
    found, world, _ = called
    row = next(row for row in found.rows if row.name == "real")
    assert (row.end, row.code) == ("left", 5), row.found
    assert "held during check; its hours begin Tue 2026-11-24 08:00" in row.found
    (log,) = world.folder.glob("checks/real/*/*.parquet")
    assert 0.5 < np.ptp(RunLog.load(log).time) < 30.0
