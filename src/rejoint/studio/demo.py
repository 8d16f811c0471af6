"""The demonstration: an emulated worn arm that misses its targets, then the same arm with the generic policy."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import numpy as np

import rejoint
from rejoint.arms import load_arm
from rejoint.control.recording import LookedAt, cycle_at_rest
from rejoint.control.robot import JointState, Robot
from rejoint.logs.runlog import read_log
from rejoint.session.inputs import FIRST_ROBOT

if TYPE_CHECKING:
    from rejoint.control.moving.drive import Deployed
    from rejoint.pages.live.view import LiveView

POINTS = ((0.17, -0.06, 0.21), (0.20, 0.06, 0.19), (0.18, 0.0, 0.23))
"""[m] (chosen)"""
DWELL = 3.0
"""[s] at each (chosen)"""
MISS = Path(__file__).with_name("miss.parquet")
"""Run log of `rejoint.deploy` of the worn arm to `POINTS` with the controller ``default``, every second row"""


def play(view: LiveView, over: Callable[[], bool]) -> None:
    """Show the recorded miss, at least once and until ``over``: the simulation may still have to be compiled."""
    log = read_log(MISS)
    arm = load_arm(log.arm)
    told = SimpleNamespace(arm=arm, address="a recording, while the simulation is prepared", count=1)
    seen = view.watch(cast(Robot, told), paced=False)
    look = cast(LookedAt, seen).onlooker("default")
    visits = np.append(0, np.cumsum((np.diff(log.target, axis=0) != 0.0).any(axis=1)))
    while True:
        began = time.monotonic() - log.time[0]
        for k in range(len(log)):
            time.sleep(max(began + log.time[k] - time.monotonic(), 0.0))
            state = JointState(time=log.time[k, None], position=log.position[k, None], age=np.zeros(1))
            cycle = cycle_at_rest(state, log.true_tcp[k, None], log.command[k, None])
            target = log.target[k, None]
            look(replace(cycle, target=target, aim=target, target_index=visits[k, None]), state, cycle.command)
        if over():
            return


def demonstrate(view: LiveView, say: Callable[[str], object], rounds: int) -> None:
    """Show the miss and the repair on a page, ``rounds`` times."""
    words = ("-m", "rejoint", "deploy", FIRST_ROBOT, "--dwell", "0.2")  # compiles what is not compiled yet
    nowhere = subprocess.DEVNULL
    with subprocess.Popen([sys.executable, *words], stdout=nowhere, stderr=nowhere) as preparing:  # noqa: S603
        try:
            os.setpriority(os.PRIO_PROCESS, preparing.pid, 19)  # the page comes first
            view.begin("A worn arm misses its targets")
            play(view, lambda: preparing.poll() is not None)
        finally:
            preparing.kill()
    for _ in range(rounds):
        view.begin("The worn arm, as it is")
        before = _driven(view, "default")
        view.begin("The same arm, with the policy that comes with rejoint")
        after = _driven(view, "shelf")
        say(f"As it is: {1e3 * before.error:.1f} mm off. With the policy: {1e3 * after.error:.2f} mm off.")


def _driven(view: LiveView, controller: str) -> Deployed:
    settings = rejoint.Settings(controller=controller, dwell=DWELL)
    return rejoint.deploy(FIRST_ROBOT, POINTS, settings=settings, observer=view)
