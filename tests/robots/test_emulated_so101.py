"""The emulated SO-101 in virtual time: the servo law of the one behind its bus, with gains that can be set."""

import numpy as np
import pytest

from rejoint.arms import load_arm
from rejoint.robots import open_robot
from rejoint.robots.feetech import KIND
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.emulator.feetech import HOMING, MIDDLE, StsArm
from rejoint_lab.plant.servo import Channel
from rejoint_lab.plant.sts3215 import SETTING
from rejoint_lab.plant.wear import load_wear

ARM = load_arm("so101")
PROMPT = Channel(latency=(0.0, 0.0), age=(0.0, 0.0), period=(0.02, 0.02))
REGISTERS = {"p": "P_Coefficient", "i": "I_Coefficient", "limit": "Integral_Limit"}
ENDS = {"least", "most"}
"""Settings that LeRobot's calibration leaves in the servos: the ends of the joints, which nothing here comes near"""


def behind_its_bus(wear, gains):
    """An arm whose registers hold ``gains``, at rest."""
    arm = StsArm.build(ARM, wear, seed=5)
    for index, servo in enumerate(arm.servos[: ARM.joints]):
        for name, values in KIND.for_all(gains, ARM.joints).items():
            servo[REGISTERS[name]] = values[index]
        arm.settle(servo)
    arm.plant.reset(ARM.rest[None])
    return arm


@pytest.mark.parametrize("wear", ["so101", "worn?seed=2"])
@pytest.mark.parametrize("gains", [{}, {"p": 48, "i": 4}])
def test_the_arm_behind_its_bus_and_that_in_virtual_time_move_alike(wear, gains):
    """To the bit, from goals in registers on one side and commands to the robot on the other."""
    bus, robot = (
        behind_its_bus(wear, gains),
        EmulatedRobot(ARM, [load_wear(wear, ARM)], seed=5, gains=gains, channel=PROMPT),
    )
    robot.plant.advance(0.01)  # as long as the other took to be compiled
    robot.restart(ARM.rest)
    for name in set(SETTING.names) - ENDS:
        np.testing.assert_array_equal(robot.plant.settings[name], bus.plant.settings[name])
    rest, seen = np.rint(ARM.rest / ARM.encoder_step), []
    for k in range(60):
        goal = rest + np.rint(200 * np.sin(0.15 * k + np.arange(ARM.joints)))
        for index, count in enumerate(goal):
            servo = bus.servos[index]
            servo["Goal_Position"] = int(count) - (servo["Homing_Offset"] - HOMING[index] - MIDDLE)
            bus.go(servo)
        bus.advance(0.02)
        seen.append(robot.step(goal[None] * ARM.encoder_step).position[0])
        np.testing.assert_array_equal(seen[-1], bus.angles)
    assert np.ptp(seen, axis=0).min() > 0.2


def test_its_address_names_the_gains_and_they_decide_how_far_it_sags():
    away = []
    for address in ("emulated:so101?p=16", "emulated:so101", "emulated:so101?p=64&startup=24&dead=0"):
        robot = open_robot(address, seed=1)
        robot.restart(ARM.rest)
        goal = ARM.rest[None] + np.radians([0, -20, 20, 0, 0])
        for _ in range(80):
            state = robot.step(goal)
        away.append(abs(goal - state.position)[0, 1])
    assert away[0] > 1.5 * away[1] > 2.0 * away[2]
    assert robot.servo_gains()["startup"] == (24,) * 5
    assert robot.servo_gains()["dead_cw"] == robot.servo_gains()["dead_ccw"] == (0,) * 5


def test_gains_are_tuned_for_the_whole_batch_and_each_arm_moves_as_it_would_alone():
    wears = [load_wear(f"so101?seed={i}", ARM) for i in range(3)]
    both, alone = EmulatedRobot(ARM, wears, seed=3), EmulatedRobot(ARM, wears[2:], seed=3, first=2)
    tuned = KIND.for_all({"p": 48, "i": 2}, 5)
    for robot in (both, alone):
        robot.tune(tuned)
        assert {name: robot.servo_gains()[name] for name in tuned} == tuned
        for _ in range(20):
            state = robot.step(np.tile(ARM.rest + 0.2, (robot.count, 1)))
        robot.last = state
    np.testing.assert_array_equal(both.last.position[2], alone.last.position[0])
    np.testing.assert_array_equal(both.last.load[2], alone.last.load[0])
