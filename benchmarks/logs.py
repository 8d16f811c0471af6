"""Logs to identify an SO-101 from: a real one's, or, where there are none, those of an emulated one."""

import os
import sys
import tempfile
from pathlib import Path

import numpy as np

from rejoint.arms import Arm
from rejoint.control.playback import move, play
from rejoint.logs import import_logs
from rejoint.logs.runlog import RunLog
from rejoint.robots.emulated import EmulatedRobot
from rejoint.robots.lab.plant.wear import load_wear

VARIABLE = "REJOINT_SO101"
"""Environment variable that names the folder of a real SO-101's SAGE motions"""

MOTIONS, SECONDS = 12, 20.0
"""How many motions the emulated arm makes, and how long [s] each of them is"""


def find(given: Path | None, arm: Arm) -> tuple[str, list[RunLog]]:
    """Return what the logs are, in words, and the logs: of the folder, of `VARIABLE`'s folder, or emulated ones."""
    folder = given or (Path(os.environ[VARIABLE]) if VARIABLE in os.environ else None)
    if folder is not None:
        if not folder.is_dir():
            sys.exit(f"{folder}: no folder of SAGE motions; give another one, or none for an emulated arm")
        return f"real logs in {folder}", read(folder, arm)
    said = f"an emulated SO-101 (for a real one: make bench LOGS=FOLDER, or {VARIABLE}=FOLDER)"
    return said, emulated(arm)


def read(folder: Path, arm: Arm) -> list[RunLog]:
    """Import a folder of SAGE motions."""
    with tempfile.TemporaryDirectory() as place:
        return sorted(import_logs(folder, arm, out=Path(place) / "logs").logs, key=lambda log: log.label)


def emulated(arm: Arm, seed: int = 0) -> list[RunLog]:
    """Record motions of the emulated SO-101: slow sums of sines, then steps."""
    robot = EmulatedRobot(arm, [load_wear("so101", arm)], seed=seed, address="emulated:so101")
    logs = []
    for motion in range(MOTIONS):
        rng = np.random.default_rng([seed, motion])
        centre = np.array([0.0, -0.4, 0.2, 0.3, 0.0]) + rng.uniform(-0.25, 0.25, arm.joints)
        frequency = np.array([0.07, 0.19, 0.41]) * rng.uniform(0.8, 1.2, (arm.joints, 3))
        phase, height = rng.uniform(0, 2 * np.pi, (arm.joints, 3)), 0.3 * np.array([1.0, 0.6, 0.3])
        postures = centre + rng.uniform(-0.3, 0.3, (int(SECONDS), arm.joints))

        def command(time, centre=centre, frequency=frequency, phase=phase, height=height, postures=postures):
            t = np.asarray(time)[:, None]
            waves = (height * np.sin(2 * np.pi * frequency * t[..., None] + phase)).sum(-1) * np.minimum(t, 1.0)
            return np.where(t < 0.7 * SECONDS, centre + waves, postures[(t[:, 0] / 1.5).astype(int)])

        move(robot, centre)
        logs.append(play(robot, command, SECONDS).log(0, f"motion{motion:02}"))
    return logs
