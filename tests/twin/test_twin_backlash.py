"""Motors and joints on either side of the backlash of their gears, against numbers worked by hand."""

import dataclasses

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.training.ranges import BroadRanges
from rejoint.twin.simulation import ChainBatch, Draw
from rejoint.twin.step import RESTITUTION, cross

ARM = mycobot280()
MS = 0.001
FREE = (0.0, 0.0, 0.0)
"""Place, speed and flank of a motor at rest in the middle"""


def motor(damping, armature, friction):
    """Rows of `rejoint.twin.step`: 10 N m/rad, at most 5 N m."""
    return np.array([10.0, 0.0, 5.0, damping, armature, 0.0, 0.0, friction, 0.0, 1.0])


def push(lead, steps, state=FREE, half=0.01, armature=1e-6):
    """Ask a clamped joint to be ``lead`` [rad] further: 10 N m/rad, 2 N m s/rad, 0.2 N m of friction."""
    states, speeds, free, gear = [state], [], [], np.array([half, *state])
    for _ in range(steps):
        loose, speed = cross(gear, 0.01, motor(2.0, armature, 0.2), lead, 0.0, MS)
        states.append(tuple(gear[1:]))
        speeds.append(speed)
        free.append(loose)
    return states, np.array(speeds), np.array(free)


def test_a_motor_crosses_the_play_at_the_speed_of_its_spare_torque():
    # 10 N m/rad * 0.1 rad - 0.2 N m = 0.8 N m; over 2 N m s/rad 0.4 rad/s; half of the backlash, 0.01 rad, in 25 ms
    states, speeds, free = push(0.1, 24)
    assert free.all()  # no torque reaches the joint
    assert not speeds.any()
    assert states[-1][1] == pytest.approx(0.4)
    assert push(0.1, 27)[1][24:].any()


def test_where_they_meet_momentum_is_kept_and_half_of_the_closing_speed():
    rotor = 0.01  # as heavy as what it turns; no torque, no friction
    gear = np.array([0.01, 0.0099999, 0.4, 0.0])
    free, joint = cross(gear, rotor, motor(0.0, rotor, 0.0), 0.0, 0.1, MS)
    assert free
    assert gear[2] + joint == pytest.approx(0.5)
    assert joint - gear[2] == pytest.approx(RESTITUTION * 0.3)
    assert gear[1] == pytest.approx(0.01)


def test_once_in_touch_a_motor_that_pushes_is_the_twin_s_and_one_that_brakes_lets_go():
    touching = (0.01, 0.0, 1.0)
    states, _, free = push(0.1, 5, touching)
    assert not free.any()
    assert states[-1] == touching
    assert push(0.01, 5, touching)[0][-1] == touching  # less than its friction: both stand still
    assert push(-0.1, 1, touching)[0][-1][2] == 0.0


def test_friction_stops_a_motor_and_does_not_turn_it_back():
    driven = push(0.1, 100, half=0.5, armature=0.02)[0][-1]
    start, speed, _ = driven
    assert speed > 0.0
    place, still, _ = push(0.0, 500, driven, half=0.5, armature=0.02)[0][-1]
    assert still == 0.0
    # v' = -(f + d v) / m stops after m/d (v - f/d ln(1 + d v / f))
    assert place - start == pytest.approx(0.02 / 2.0 * (speed - 0.1 * np.log1p(speed / 0.1)), rel=0.1)


def test_only_joints_that_carry_no_weight_have_play():
    draw, count = BroadRanges(arm=ARM).draw(np.random.default_rng(0), 2), 30
    values = {"stiffness": 10.0, "damping": 2.0, "coulomb": 0.02, "armature": 1e-3, "torque_limit": 5.0, "offset": 0.0}
    twin = dataclasses.replace(draw.twin, **{name: np.full((2, 6), value) for name, value in values.items()})
    twins, start = ChainBatch(ARM, 2, MS), np.tile(ARM.rest, (2, 1))
    play = np.repeat([[0.0], [0.04]], 6, axis=1)
    floating = {"backlash": play, "grease": np.full(2, 0.1), "gravity_scale": np.zeros(2)}
    twins.write(dataclasses.replace(Draw.of(twin), **floating))
    twins.restart(start)
    stiff, loose = np.abs(twins.rollout(np.repeat(start[:, None] + 0.1, count, axis=1))[:, -1] - start)
    assert (stiff > 1e-3).all()
    assert (loose[1:4] > 0.5 * stiff[1:4]).all()  # shoulder, elbow and wrist bend carry links
    assert (loose[[0, 4, 5]] < 0.2 * stiff[[0, 4, 5]]).all()
