"""Dry runs: a simulation takes the arm's place, and nothing moves."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from rejoint.arms import Array, tcp_position
from rejoint.control.guard import GuardLimits, clear_by
from rejoint.control.robot import JointState, Mask, Robot, part_of
from rejoint.control.servogains import Rung, ServoGains, Tunable
from rejoint.control.start import check_ready
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.robots.wrapper import RobotWrapper
from rejoint.runs.run import Run

if TYPE_CHECKING:
    from rejoint.session.inputs import Period
    from rejoint.twin.twin import Twin

PERIOD = (0.02, 0.03)
"""[s] default control periods (chosen)"""


@contextmanager
def copied(run: Run) -> Iterator[Run]:
    """Return a temporary copy of a run."""
    with TemporaryDirectory(prefix="rejoint-dry-run-") as folder:
        path = Path(folder) / "run"
        if run.path.is_dir():
            shutil.copytree(run.path, path, ignore=shutil.ignore_patterns(".lock", "pictures", "training", "figures"))
        yield replace(run, folder=RunFolder(path))


class RehearsedRobot(RobotWrapper):
    """Simulates a robot at its present posture; with nominal servos without a twin."""

    def __init__(self, robot: Robot, twin: Twin | None, period: Period | None) -> None:
        """NotReadyError where the arm would not be moved either."""
        from rejoint.twin.parameters import nominal_parameters
        from rejoint.twin.simulation import Draw, TwinRobot

        check_ready(robot)
        arm, start = robot.arm, robot.read().position[0]
        own = (nominal_parameters(arm) if twin is None else twin.parameters).repeat(1)
        low, high = period or PERIOD
        draw = replace(Draw.of(own), period=np.array([(low + high) / 2]))
        jitter = (high - low) / (high + low)
        super().__init__(TwinRobot(arm, draw, seed=0, jitter=jitter, posture=start, address=robot.address))
        self._positions: list[Array] = [start.copy()]
        servos = part_of(robot, Tunable)
        self._gains, self._rungs = (None, ()) if servos is None else (servos.servo_gains(), servos.rungs())

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """See `rejoint.control.robot.Robot`."""
        state = super().step(command, active)
        self._positions.append(state.position[0].copy())
        return state

    def servo_gains(self) -> ServoGains | None:
        """Gains that the arm has, or would have; the simulation ignores them."""
        return self._gains

    def tune(self, gains: ServoGains) -> None:
        """Take ``gains``; the arm keeps its own."""
        self._gains = dict(gains)

    def keep(self, gains: ServoGains) -> None:
        """Do as `tune`."""
        self.tune(gains)

    def rungs(self) -> tuple[Rung, ...]:
        """Return the arm's search order."""
        return self._rungs

    def summary(self) -> str:
        """Say how far, how long and how close to limits it moved."""
        arm, seconds = self.arm, float(self.read().time[0])
        way = np.array(self._positions)
        tool = float(np.linalg.norm(np.diff(tcp_position(arm, way), axis=0), axis=-1).sum())
        turned = np.abs(np.diff(way, axis=0)).sum(axis=0)
        most = int(turned.argmax())
        spare = np.minimum(way - arm.lower, arm.upper - way).min(axis=0)
        near = int(spare.argmin())
        clear = float(clear_by(GuardLimits.of(arm), way).min())
        return (
            f"Dry run, nothing moved. The arm would move for {seconds:.0f} s: the tool by {1e3 * tool:.0f} mm, joints "
            f"by up to {np.degrees(turned[most]):.0f} deg ({arm.joint_names[most]}). Closest to a limit: "
            f"{arm.joint_names[near]}, {np.degrees(spare[near]):.0f} deg; to the floor or itself: {1e3 * clear:.0f} mm."
        )
