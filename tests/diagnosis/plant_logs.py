"""Logs of ordinary motion, recorded on emulated SO-101 arms whose wear is known."""

import dataclasses
from functools import cache

import numpy as np

from rejoint.arms import so101
from rejoint.diagnosis.excitation import record
from rejoint.diagnosis.healthy import SEED, reference_from
from rejoint.logs.runlog import RunLog
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear

ARM = so101()
PLAIN = dataclasses.replace(ARM, servos=())
"""With servos whose stiffness is that of the wear, and not of what stands in their registers"""
HEALTHY = load_wear("healthy", ARM)
PERIOD, STEP = 0.025, 0.05
"""[s], and most [rad] by which commands change in it"""


def with_joint(joint, healthy=HEALTHY, **values):
    """A healthy arm with one joint changed."""
    changed = {name: np.array(getattr(healthy, name)) for name in values}
    for name, value in values.items():
        changed[name][joint] = value
    return dataclasses.replace(healthy, **changed)


def kinds(diagnosis):
    return {(finding.joint, finding.kind) for finding in diagnosis.findings}


@cache
def plain_reference():
    """What healthy arms with such servos measure."""
    robot = EmulatedRobot(PLAIN, [HEALTHY] * 3, seed=SEED)
    return reference_from(PLAIN, record(robot, seed=SEED), source="three arms")


def wandering(seed, seconds, size=0.3):
    """A posture to start from, and a motion: sums of slow sines for 60 % of the time, then steps to rest at."""
    rng = np.random.default_rng(seed)
    centre = np.array([0.0, -0.4, 0.2, 0.3, 0.0]) + rng.uniform(-0.25, 0.25, 5)
    frequency = np.array([0.07, 0.19, 0.41]) * rng.uniform(0.8, 1.2, (5, 3))
    phase, height = rng.uniform(0, 2 * np.pi, (5, 3)), size * np.array([1.0, 0.6, 0.3])
    steps = centre + rng.uniform(-size, size, (40, 5))

    def command(time):
        t = np.asarray(time)[:, None]
        waves = (height * np.sin(2 * np.pi * frequency * t[..., None] + phase)).sum(axis=-1) * np.minimum(t, 1.0)
        return np.where(t < 0.6 * seconds, centre + waves, steps[(t[:, 0] / 2.5).astype(int) % 40])

    return centre, command


def record_motions(wears, count, seconds, seed=0):
    """Lists of ``count`` run logs, one list for each wear; as strangers do, without a guard."""
    robot, logs = EmulatedRobot(PLAIN, wears, seed=seed), [[] for _ in wears]
    for motion in range(count):
        centre, command = wandering(100 * seed + motion, seconds)
        sent, rows = robot.read().position, []
        for now in np.arange(-4.0, seconds, PERIOD):
            before = robot.read()
            way = (centre if now < 0.0 else command([now])) - sent
            sent = sent + np.clip(way, -STEP, STEP)
            rows.append((before.time, before.position, sent))
            robot.step(sent)
        time, position, sent = (np.array(each[int(4.0 / PERIOD) :]) for each in zip(*rows, strict=True))
        for arm, found in enumerate(logs):
            columns = {"time": time[:, arm], "position": position[:, arm], "command": sent[:, arm]}
            found.append(RunLog.of(**columns, arm=PLAIN, label=f"motion{motion}"))
    return logs
