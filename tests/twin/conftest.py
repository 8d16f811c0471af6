"""Logs of an arm whose truth is known, because it is a twin."""

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.control.servoreference import ServoReference
from rejoint.logs.runlog import RunLog
from rejoint.twin.parameters import TwinParameters
from rejoint.twin.simulation import Draw, Simulation


def _commands(arm, rng, seconds):
    """Slow sweeps, then small steps of one joint after the other, then sums of sines: a third of the time each."""
    time = np.cumsum(rng.uniform(0.020, 0.030, int(seconds / 0.025)))
    command = np.tile(arm.rest, (len(time), 1))
    sweep, step, sines = np.array_split(np.arange(len(time)), 3)
    for j in range(arm.joints):
        t = time[sweep] - time[sweep[0]]
        wave = np.sin(2 * np.pi * (1 + j % 3) * np.maximum(t - 1, 0) / (t[-1] - 1))
        command[sweep, j] += 0.25 * (1 - j % 2 * 2) * wave * np.clip(t - 1, 0, 1)  # from rest
        t = time[step] - time[step[0]]
        part = t * arm.joints / t[-1] - j
        command[step, j] += 0.2 * ((part > 0) & (part < 0.5)) - 0.15 * ((part >= 0.5) & (part < 1))
        t = time[sines] - time[sines[0]]
        for frequency in (0.2, 0.5, 1.1):
            phase = rng.uniform(0, 2 * np.pi)
            command[sines, j] += 0.08 * np.sin(2 * np.pi * frequency * (1 + 0.07 * j) * t + phase) * np.minimum(t, 1)
    return time, command


def simulate_log(arm, truth, rng, seconds):
    """A run log of the arm whose twin is ``truth``, with encoder steps and jittering answers."""
    timestep = 0.005
    time, command = _commands(arm, rng, seconds)
    reference = ServoReference(time, command, float(truth.ramp_speed))
    grid = time[0] + np.arange(int((time[-1] - time[0]) / timestep) + 2) * timestep
    control = reference.sample(grid, np.atleast_1d(truth.delay))
    simulation = Simulation(arm, 1)
    simulation.place(Draw.of(truth.repeat(1)), command[:1], command[:1])
    simulation.twins.rollout(np.repeat(control[:, :1], 400, axis=1))
    path = np.vstack([simulation.twins.qpos.copy(), simulation.twins.rollout(control)[0]])
    clock = time[0] + np.arange(len(path)) * timestep
    read = np.clip(time + rng.uniform(-0.002, 0.002, len(time)), clock[0], clock[-1])
    position = np.stack([np.interp(read, clock, column) for column in path.T], axis=1)
    position = np.round(position / arm.encoder_step) * arm.encoder_step
    return RunLog.of(time, command, position, arm=arm, label="excitation")


@pytest.fixture(scope="session")
def arm():
    return mycobot280()


@pytest.fixture(scope="session")
def truth():
    """A worn arm that its motors can just carry."""
    return TwinParameters(
        stiffness=[6.0, 6.8, 5.2, 4.6, 6.1, 5.5],
        damping=[0.3, 0.34, 0.22, 0.15, 0.17, 0.14],
        coulomb=[0.10, 0.12, 0.07, 0.05, 0.06, 0.04],
        stiction=1.25,
        armature=[0.022, 0.018, 0.024, 0.012, 0.014, 0.016],
        torque_limit=[1.0, 1.1, 0.8, 0.5, 0.5, 0.4],
        offset=[0.004, -0.003, 0.005, 0.0, -0.004, 0.002],
        delay=0.022,
        ramp_speed=2.2,
    )


@pytest.fixture(scope="session")
def log(arm, truth):
    return simulate_log(arm, truth, np.random.default_rng(5), 60.0)
