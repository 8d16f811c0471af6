import numpy as np
import pytest

from rejoint.arms import load_arm, mycobot280, so101, tcp_position
from rejoint.control.robot import Robot
from rejoint.robots import open_robot, place_of
from rejoint.system.errors import ProfileError
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.servo import Channel
from rejoint_lab.plant.wear import load_wear

ARM = mycobot280()
FAMILY = [load_wear(f"worn?seed={i}", ARM) for i in range(4)]


def drive(robot, numbers, active=None):
    track = []
    for k in range(60):
        state = robot.step(ARM.rest + 0.2 * np.sin(0.2 * k + numbers[:, None] + np.arange(6)), active)
        track.append(np.column_stack([state.time, state.position, robot.true_tcp()]))
    return np.array(track)


def test_an_arm_is_named_before_its_wear_and_tuned_by_its_servos_gains():
    place = place_of("emulated:koch?worn&seed=3&p=800")
    assert (place.default_arm, place.detail.profile, place.detail.gains) == ("koch", "worn?seed=3", {"p": 800})
    assert place_of("emulated:omx").detail.profile == "new"
    robot = open_robot("emulated:wx250s?worn", arm=load_arm("wx250s"))
    robot.tune({"p": (1200,) * 6})
    assert robot.servo_gains()["p"] == (1200,) * 6
    assert (robot.plant.settings["p"][0, 1] == 1200).all()  # both servos of the shoulder
    stall = robot.plant.settings["stall"].sum(axis=-1)[0]
    assert (stall >= 0.5 * load_wear("new", robot.arm).torque_limit).all()


def test_it_is_a_robot():
    robot = EmulatedRobot(ARM, FAMILY, address="emulated:worn")
    assert isinstance(robot, Robot)
    assert (robot.address, robot.count, robot.arm) == ("emulated:worn", 4, ARM)
    state = robot.read()
    assert state.position.shape == state.temperature.shape == (4, 6)
    assert state.time.shape == state.age.shape == (4,)
    assert (state.age == 0).all()


def test_an_arm_does_not_notice_that_others_stopped():
    batch = drive(EmulatedRobot(ARM, FAMILY, seed=5), np.arange(4))
    some = drive(EmulatedRobot(ARM, FAMILY, seed=5), np.arange(4), active=np.array([True, False, True, False]))
    np.testing.assert_array_equal(some[:, [0, 2]], batch[:, [0, 2]])
    assert (some[:, [1, 3]] == some[0, [1, 3]]).all()


def test_periods_are_drawn_from_their_interval_every_cycle():
    track = drive(EmulatedRobot(ARM, FAMILY, seed=5, channel=Channel(period=(0.030, 0.040))), np.arange(4))
    periods = np.diff(track[:, :, 0], axis=0)
    assert periods.min() > 0.0295
    assert periods.max() < 0.0405
    assert (np.ptp(periods, axis=0) > 0.006).all()


def test_reading_takes_no_time_and_repeats_the_last_answer():
    robot = EmulatedRobot(ARM, FAMILY, seed=5)
    state = robot.step(np.tile(ARM.rest, (4, 1)) + 0.3)
    again = robot.read()
    np.testing.assert_array_equal(again.position, state.position)
    np.testing.assert_array_equal(again.time, state.time)


def test_the_true_tcp_is_not_the_one_that_the_encoders_show():
    robot = EmulatedRobot(ARM, [load_wear("worn", ARM)])
    apart = np.linalg.norm(robot.true_tcp() - tcp_position(ARM, robot.read().position))
    assert 0.004 < apart < 0.02


def test_an_address_knows_its_arm():
    assert open_robot("emulated:worn").arm.name == place_of("emulated:worn").default_arm == "mycobot280"
    assert open_robot("emulated:so101").arm.name == place_of("emulated:so101?seed=3").default_arm == "so101"
    assert place_of("tcp://10.0.0.1:9000").default_arm == "mycobot280"
    scaled = open_robot("emulated:worn", arm=so101(), count=2)
    assert (scaled.arm.name, scaled.read().position.shape) == ("so101", (2, 5))
    with pytest.raises(ProfileError):
        open_robot("emulated:so101", arm=ARM)
