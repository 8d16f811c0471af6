"""Logs of an SO-101 whose truth is known, because it is a twin: several motions, on a table or in free space."""

from dataclasses import replace

import numpy as np

from rejoint.arms import so101
from rejoint.control.servoreference import ServoReference
from rejoint.logs.runlog import RunLog
from rejoint.twin.fit import Problem
from rejoint.twin.parameters import TwinParameters
from rejoint.twin.replay import Replay
from rejoint.twin.simulation import ChainBatch, Draw
from rejoint.twin.table import TableBatch
from rejoint.twin.twin import TablePlane

ARM = replace(so101(), servos=())  # its truths are drawn for each joint by itself
STEP, PERIOD = 0.010, 0.02  # the first as in the fits, so that nothing but the encoders stands between the two
TABLE = TablePlane(height=-0.02, slope_x=0.0, slope_y=0.0, stiffness=2e4, friction=0.2)
TRUTH = TwinParameters(
    stiffness=[20.0, 17.0, 18.0, 15.0, 18.0],
    damping=[1.4, 1.0, 1.1, 0.9, 1.2],
    coulomb=[0.15, 0.4, 0.5, 0.2, 0.18],
    stiction=1.25,
    armature=[0.02, 0.012, 0.014, 0.010, 0.012],
    torque_limit=[20.0] * 5,
    offset=np.radians([0.1, 0.6, 0.8, 0.2, -0.1]),
    delay=0.008,
    ramp_speed=40.0,
)


def centre_of(k, wrist=0.2):
    """Postures (5,) [rad] about which motion ``k`` wanders: others for each."""
    return 0.3 * (k % 3 - 1), -0.6 + 0.15 * (k % 4), 0.3 - 0.2 * (k % 3), wrist * (k % 2), 0.0


def wandering(seed, seconds, centre=(0.0, -0.4, 0.2, 0.3, 0.0), size=0.25):
    """Commands (T, n) of a motion: sums of sines, then steps to random postures, half of the time each."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, PERIOD)
    command = np.tile(centre, (len(time), 1))
    half = len(time) // 2
    for j in range(ARM.joints):
        for frequency in (0.13, 0.31, 0.74):
            wave = np.sin(2 * np.pi * frequency * (1 + 0.1 * j) * time + rng.uniform(0, 6.3))
            command[:, j] += size * (0.5 if frequency > 0.5 else 0.8) * wave * np.minimum(time, 1.0)
    postures = centre + rng.uniform(-size, size, (int(seconds) + 1, ARM.joints))
    command[half:] = postures[(time[half:] / 1.3).astype(int)]
    # Nobody sends jumps this large: a first-order filter of 150 ms.
    for k in range(half, len(time)):
        command[k] = command[k - 1] + (command[k] - command[k - 1]) * PERIOD / 0.15
    return time, command


def record(label, time, command, truth=TRUTH, table=None, acceleration=np.inf, own=ARM, integral=0.0):
    """Run log of the arm with the links ``own`` whose twin is ``truth``; commands are in force from each row on.

    Its controller has an ``integral`` gain [1/s] over the stiffness.
    """
    twin = truth.repeat(1)
    arm = ChainBatch(own, 1, STEP) if table is None else TableBatch(own, twin, [table], STEP)
    if table is None:
        arm.write(Draw.of(twin))
    arm.restart(command[:1])
    reference = ServoReference(time, command, float(truth.ramp_speed))
    if acceleration < np.inf:
        reference = ServoReference(time, command, 1.0, acceleration)
    grid = np.arange(int((time[-1] - time[0]) / STEP) + 2) * STEP + time[0]
    control = reference.sample(grid, np.atleast_1d(truth.delay))[0]
    arm.rollout(np.tile(control[:1], (1, 400, 1)))
    path, taken = [arm.qpos[0].copy()], np.zeros(ARM.joints)
    for aim in control:
        taken = taken + STEP * integral * (aim - path[-1])
        path.append(arm.rollout((aim + taken)[None, None])[0, -1])
    path = np.array(path)
    clock = time[0] + np.arange(len(path)) * STEP
    position = np.stack([np.interp(time, clock, column) for column in path.T], axis=1)
    position = np.round(position / ARM.encoder_step) * ARM.encoder_step
    return as_log(label, time, position, command)


def problem_of(structure, windows, arm=ARM, **options):
    """What a ``structure`` is fitted to."""
    replay = Replay(arm, windows, STEP, acceleration=structure.acceleration)
    return Problem(replay, structure.prior, structure.frozen, **options)


def surface(table, points):
    """Height (...) [m] of a table under points (..., 3) [m]."""
    return table.height + table.slope_x * points[..., 0] + table.slope_y * points[..., 1]


def as_log(label, time, position, command):
    return RunLog.of(time, command, position, arm=ARM, label=label)


def pressing(seconds=24.0, depth=0.5):
    """Commands that push the tip down on whatever is below and lift it again, twice; 6 s of rest at the end."""
    time = np.arange(0.0, seconds + 6.0, PERIOD)
    command = np.tile([0.0, 0.05, 0.35, 0.9, 0.0], (len(time), 1))
    phase = (time / (seconds / 2)) % 1.0
    command[:, 1] += depth * np.clip(4 * np.minimum(phase, 1 - phase) - 0.3, 0.0, 1.0) * (time < seconds)
    command[:, 0] += 0.1 * np.sin(2 * np.pi * time / 20.0)
    return time, command
