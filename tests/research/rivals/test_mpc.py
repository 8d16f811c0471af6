from dataclasses import replace

import numpy as np
import pytest

from rejoint.arms import mycobot280, tcp_position
from rejoint.control.loop import Schedule, run
from rejoint.research.rivals.mpc import MpcController, MpcSettings
from rejoint.research.rivals.twinrobot import TwinRobot
from rejoint.training.ranges import BroadRanges
from rejoint.twin.parameters import TwinParameters
from rejoint.twin.simulation import Draw

ARM = mycobot280()
RANGES = BroadRanges(arm=ARM, weak_joints=0.0, torque_limit=(2.0, 3.0), coulomb=(0.0, 0.4), period=(0.024, 0.026))
TARGETS = ARM.targets.sample(np.random.default_rng(3), (2, 1))
FEW = MpcSettings(samples=12)


def drawn() -> tuple[Draw, TwinParameters]:
    draw = RANGES.draw(np.random.default_rng(11), 2)
    return draw, replace(draw.twin, delay=draw.command_delay + draw.readback_delay)


def final_error(draw: Draw, twin: TwinParameters, settings: MpcSettings = FEW) -> np.ndarray:
    robot = TwinRobot(ARM, draw, seed=0)
    recording = run(robot, MpcController(ARM, twin, settings), TARGETS, Schedule(dwell=2.5, keep_going=True))
    tail = tcp_position(ARM, recording.position[-20:])
    return np.linalg.norm(tail - TARGETS[:, 0], axis=-1).mean(axis=0)


def test_with_the_right_model_it_settles_at_the_target():
    assert final_error(*drawn()).max() < 1.0e-3


def test_a_wrong_model_leaves_no_lasting_error():
    draw, twin = drawn()
    wrong = replace(twin, stiffness=1.25 * twin.stiffness, offset=twin.offset + np.radians(1.0))
    assert final_error(draw, wrong).max() < 1.5e-3
    forgetful = replace(FEW, offset_rate=0.0)
    assert final_error(draw, wrong, forgetful).max() > 3.0e-3


def test_the_shadow_of_the_right_model_is_the_arm():
    draw, twin = drawn()
    still = replace(draw.twin, coulomb=0.0 * twin.coulomb)
    draw = replace(draw, twin=still, stiction=np.ones((2, 6)), gravity_scale=np.ones(2))
    twin = replace(twin, coulomb=0.0 * twin.coulomb)
    robot = TwinRobot(ARM, draw, seed=0)
    controller = MpcController(ARM, twin, replace(FEW, correction=0.0, offset_rate=0.0))
    missed = []

    def watch(cycle):
        if len(missed) > 0 or cycle.since_target[0] > 0.0:
            missed.append(np.abs(controller.shadow.twins.qpos - cycle.position).max())

    schedule = Schedule(dwell=1.0, keep_going=True, sent=robot.simulation.reference.position.copy())
    run(robot, controller, TARGETS, schedule, on_cycle=watch)
    # Encoder counts, and another number of physics steps per cycle.
    assert np.max(missed) < np.radians(1.0)
    assert np.mean(missed) < np.radians(0.25)


def test_the_plan_is_a_function_of_the_seed():
    draw, twin = drawn()
    commands = []
    for seed in (0, 0, 1):
        controller = MpcController(ARM, twin, replace(FEW, seed=seed))
        recording = run(TwinRobot(ARM, draw, seed=0), controller, TARGETS, Schedule(dwell=0.2, keep_going=True))
        commands.append(recording.command)
    np.testing.assert_array_equal(commands[0], commands[1])
    assert np.abs(commands[0] - commands[2]).max() > 1e-6


@pytest.mark.parametrize("count", [1, 2])
def test_one_twin_serves_a_batch(count):
    _, twin = drawn()
    robot = TwinRobot(ARM, RANGES.draw(np.random.default_rng(11), count), seed=0)
    controller = MpcController(ARM, twin[0], FEW)
    recording = run(robot, controller, TARGETS[:count], Schedule(dwell=0.2, keep_going=True))
    assert np.isfinite(recording.command).all()
