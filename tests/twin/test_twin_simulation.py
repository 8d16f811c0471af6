"""The one simulation: what is driven step by step is what is replayed from a log."""

import dataclasses

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.control.servoreference import ServoReference
from rejoint.twin.parameters import nominal_parameters
from rejoint.twin.simulation import SUBSTEPS, Draw, Simulation

ARM = mycobot280()
STEP, CYCLES = 0.004, 30
PERIOD = STEP * SUBSTEPS
TWIN = nominal_parameters(ARM)


def commands():
    """Commands (T, n) that wander, jump by half a radian, and are then sent again and again."""
    command = ARM.rest + np.cumsum(np.random.default_rng(0).normal(0.0, 0.04, (CYCLES, 6)), axis=0)
    command[20:] = command[19] + 0.5
    command[0] = ARM.rest
    return command


@pytest.mark.parametrize("acceleration", [np.inf, 25.0])
def test_a_closed_loop_and_the_replay_of_its_commands_are_the_same_motion(acceleration):
    twin = dataclasses.replace(
        TWIN, stiction=np.full(ARM.joints, 1.7), delay=2 * STEP, ramp_speed=1.5
    )  # a command arrives at the start of a step
    draw, start, command = Draw.of(twin.repeat(1), acceleration), ARM.rest[None], commands()
    driven = Simulation(ARM, 1)
    driven.place(draw, start, start)
    asked, passed = [], []
    for row in command:
        driven.send(row[None])
        driven.advance(np.full(1, PERIOD))
        asked.append(driven.reference.position[0].copy())
        passed.append(driven.twins.qpos[0].copy())
    time, grid = PERIOD * np.arange(CYCLES), STEP * np.arange(CYCLES * SUBSTEPS) - 1e-9
    known = (
        ServoReference(time, command, float(twin.ramp_speed))
        if acceleration == np.inf
        else ServoReference(time, command, 1.0, acceleration)
    )
    # In closed loop a step's reference is where it ends, in a replay where it begins: that of the next one.
    reference = known.sample(grid + STEP, twin.delay[None])
    np.testing.assert_allclose(asked, reference[0, SUBSTEPS - 1 :: SUBSTEPS], atol=1e-7)
    replayed = Simulation(ARM, 1)
    replayed.place(draw, start, start)
    replayed.twins.timestep[:] = STEP
    path = replayed.twins.rollout(reference)[0, SUBSTEPS - 1 :: SUBSTEPS]
    np.testing.assert_allclose(passed, path, atol=1e-5)
    assert np.ptp(path, axis=0).max() > 0.3


def test_an_exchanged_arm_begins_anew_and_the_others_go_on():
    start = np.tile(ARM.rest, (3, 1))
    draw = dataclasses.replace(
        Draw.of(dataclasses.replace(TWIN, stiction=np.full(6, 1.5)).repeat(3)), backlash=np.full((3, 6), 0.02)
    )
    exchanged, whole = Simulation(ARM, 3), Simulation(ARM, 3)
    for simulation in (exchanged, whole):
        simulation.place(draw, start, start)
    for cycle, row in enumerate(commands()):
        if cycle == 10:
            one = np.array([False, True, False])
            exchanged.place(draw.rows(np.array([0])), start[:1], start[:1] + 0.1, one)
            assert exchanged.time[1] == 0.0
            np.testing.assert_array_equal(exchanged.reference.position[1], ARM.rest + 0.1)
        for simulation in (exchanged, whole):
            simulation.send(np.tile(row, (3, 1)))
            simulation.advance(np.full(3, PERIOD))
    np.testing.assert_array_equal(exchanged.twins.qpos[[0, 2]], whole.twins.qpos[[0, 2]])
    np.testing.assert_array_equal(exchanged.measured[[0, 2]], whole.measured[[0, 2]])
    assert (exchanged.twins.qpos[1] != whole.twins.qpos[1]).any()
