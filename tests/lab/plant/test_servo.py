import dataclasses

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint_lab.plant import servo
from rejoint_lab.plant.plant import joint_records
from rejoint_lab.plant.wear import load_wear

ARM = mycobot280()


def wear(**changes):
    """A worn arm without ripple and noise, changed in some parameters for all joints."""
    quiet = {"ripple": 0.0, "torque_noise": 0.0} | changes
    return dataclasses.replace(load_wear("worn", ARM), **{name: np.full(6, value) for name, value in quiet.items()})


def joint(**changes):
    record = joint_records(ARM, wear())[:1].copy()
    for name, value in changes.items():
        record[name] = value
    return record


def fresh():
    return np.zeros(1, servo.STATE)


def commanded(goal, speed_limit):
    """A powered servo at zero whose reference has arrived at its goal."""
    state = fresh()
    state["goal"] = state["reference"] = goal
    state["speed_limit"], state["powered"] = speed_limit, True
    return state


def slide(pushes):
    """Push a mass against friction alone; returns its angles [rad] and speeds [rad/s]."""
    records = joint(coulomb=0.1, stiction=0.2, load_friction=0.0, reflected_inertia=0.02)
    state, angle, speed, track = fresh(), 0.0, 0.0, []
    for push in pushes:
        speed += (push + servo.friction_torque(records[0], state[0], speed, 0.0)) / 0.02 * servo.STEP
        angle += speed * servo.STEP
        track.append((angle, speed))
    return np.transpose(track)


STEPS = np.arange(20_000)
STEADY = np.minimum(STEPS / 200, 1.0)


@pytest.mark.parametrize("torque", [0.05, 0.15, 0.19, -0.19])
def test_below_stiction_nothing_creeps(torque):
    angle, _ = slide(torque * STEADY)
    assert abs(angle[-1]) < ARM.encoder_step
    assert angle[-1] == pytest.approx(angle[1_999], abs=1e-9)


def test_a_stuck_joint_does_not_creep_under_vibration():
    noise = np.random.default_rng(0).standard_normal(len(STEPS))
    angle, _ = slide(0.12 + 0.03 * np.sin(0.3 * STEPS) + 0.01 * noise)
    assert abs(np.mean(angle[-2_000:]) - np.mean(angle[2_000:4_000])) < 1e-5


def test_above_stiction_it_breaks_loose_and_slides_against_coulomb_friction():
    angle, speed = slide(0.21 * STEADY[:1_100])
    assert angle[999] > np.radians(5.0)
    assert (speed[1_099] - speed[999]) / 0.1 == pytest.approx((0.21 - 0.1) / 0.02, rel=1e-6)


def test_friction_grows_with_the_transmitted_torque():
    state = fresh()
    records = joint(coulomb=0.1, stiction=0.1, load_friction=0.1)
    for _ in range(100):
        light = servo.friction_torque(records[0], state[0], 1.0, 0.0)
        loaded = servo.friction_torque(records[0], state[0], 1.0, -0.5)
    assert (light, loaded) == (pytest.approx(-0.1), pytest.approx(-0.15))


def test_teeth_do_not_pull_when_they_part():
    records = joint(play=0.04, link_stiffness=50.0)
    assert servo.gear_torque(records[0], 0.021, -5.0) == pytest.approx(5.0 * 0.02)  # the grease alone


def test_an_error_of_one_count_is_ignored_and_one_of_two_is_not():
    for counts, expected in ((1.0, 0.0), (2.0, 2.0)):
        state = commanded(counts * ARM.encoder_step, 100.0)
        torque = servo.motor_torque(joint()[0], state[0], 0.0, 0.0)
        assert torque == pytest.approx(expected * ARM.encoder_step * joint()["position_gain"][0])


def test_an_offset_moves_where_the_servo_rests():
    """Without load there is no torque where the joint stands off its command by the offset."""
    state = commanded(0.3, 1.0)
    records = joint(offset=10 * ARM.encoder_step, damping_gain=0.0)
    assert servo.motor_torque(records[0], state[0], 0.3 + 10 * ARM.encoder_step, 0.0) == 0.0
    expected = 10 * ARM.encoder_step * records["position_gain"][0]
    assert servo.motor_torque(records[0], state[0], 0.3, 0.0) == pytest.approx(expected)


def test_back_emf_takes_the_torque_at_the_no_load_speed():
    state, records = commanded(10.0, 1.0), joint(damping_gain=0.0)
    assert servo.motor_torque(records[0], state[0], 0.0, 0.0) == pytest.approx(records["torque_limit"][0])
    assert servo.motor_torque(records[0], state[0], 0.0, 5.0) == pytest.approx(0.0)


@pytest.mark.parametrize(("inside", "seen"), [(False, 0.0), (True, 0.02)])
def test_only_an_encoder_behind_the_gear_sees_the_play_and_none_sees_the_flex(inside, seen):
    records = joint(play=0.04, play_in_loop=inside)
    assert servo.read_encoder(records[0], 0.0, 0.5) == pytest.approx(seen, abs=ARM.encoder_step / 2)


def test_a_held_joint_warms_towards_ambient_plus_rise():
    state = fresh()
    records = joint()
    state["temperature"], state["torque"] = servo.AMBIENT, records["torque_limit"][0]
    before = state["temperature"][0]
    for _ in range(1_000):
        servo.warm_up(records[0], state[0])
    warmer = state["temperature"][0] - before
    state["torque"] = 0.5 * records["torque_limit"][0]
    state["temperature"] = before
    for _ in range(1_000):
        servo.warm_up(records[0], state[0])
    assert 0.0 < state["temperature"][0] - before == pytest.approx(warmer / 4)
    assert warmer < 1.0
