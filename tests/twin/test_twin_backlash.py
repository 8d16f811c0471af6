"""Motors and joints on either side of the backlash of their gears, against numbers worked by hand."""

import dataclasses

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.training.ranges import BroadRanges
from rejoint.twin.backlash import RESTITUTION, Backlash
from rejoint.twin.friction import dry_friction, friction_terms

ARM = mycobot280()
MS = 0.001


class Bench:
    """Joints clamped at 0.5 rad instead of a simulation, in steps of a millisecond; speeds are forgotten."""

    timestep = np.full(1, MS)

    def __init__(self):
        self.ctrl, self.qpos, self.qvel = np.zeros((1, 6)), np.full((1, 6), 0.5), np.zeros((1, 6))
        self.armature = self.damping = self.friction = np.zeros((1, 6))

    def set_motors(self, *, armature, damping):
        self.armature, self.damping = armature, damping

    def set_friction(self, friction):
        self.friction = friction


class Geared(Backlash):
    """Backlash with the friction of its arm."""

    terms: np.ndarray

    def drive(self, bench):
        friction = dry_friction(self.terms, bench.qvel)
        self.part(bench, self.terms, friction)
        bench.set_friction(friction)


def make(backlash=0.02, stiction=1.0, armature=1e-6):
    """An arm of 10 N m/rad, 2 N m s/rad and 0.2 N m of friction, whose gears have backlash."""
    draw = BroadRanges(arm=ARM).draw(np.random.default_rng(0), 1)
    values = {"stiffness": 10.0, "damping": 2.0, "coulomb": 0.2, "armature": armature, "torque_limit": 5.0}
    twin = dataclasses.replace(draw.twin, **{name: np.full((1, 6), value) for name, value in values.items()})
    twin = dataclasses.replace(twin, offset=np.full((1, 6), 0.03))
    result = Geared(ARM, 1)
    result.terms = friction_terms(twin, stiction)
    result.renew(twin, np.full((1, 6), backlash), np.full(1, 0.1), np.ones(1, dtype=bool))
    return result


def push(backlash, lead, steps):
    """Ask the joints to be ``lead`` [rad] further; the lead that they feel and the speed they get, (steps, 6) each."""
    bench, leads, speeds = Bench(), [], []
    for _ in range(steps):
        bench.ctrl[:], bench.qvel[:] = bench.qpos + lead - 0.03, 0.0  # the offset of 0.03 rad counts as lead
        backlash.drive(bench)
        leads.append((bench.ctrl + 0.03 - bench.qpos)[0])
        speeds.append(bench.qvel[0].copy())
    return np.array(leads), np.array(speeds), bench


def test_a_motor_crosses_the_play_at_the_speed_of_its_spare_torque():
    # 10 N m/rad * 0.1 rad - 0.2 N m = 0.8 N m; over 2 N m s/rad 0.4 rad/s; half of the backlash, 0.01 rad, in 25 ms
    leads, speeds, bench = push(make(), 0.1, 24)
    np.testing.assert_allclose(leads[:, 0], 0.0, atol=1e-12)  # no torque reaches the joint
    assert not speeds[:, 0].any()
    assert (bench.friction[0, 0], bench.armature[0, 0]) == (0.0, 0.0)
    assert bench.damping[0, 0] == pytest.approx(0.1 * 2.0)
    speeds = push(make(), 0.1, 27)[1]
    assert speeds[24:, 0].any()


def test_where_they_meet_momentum_is_kept_and_half_of_the_closing_speed():
    backlash = make()
    backlash._motor[..., 2] = backlash._link[0]  # a rotor as heavy as what it turns
    backlash._speed[0, 0], backlash._ahead[0, 0] = 0.4, 0.0099999
    bench = Bench()
    bench.ctrl[:] = bench.qpos - 0.03  # no torque
    backlash._motor[..., 1] = backlash.terms[0] = 0.0  # no friction
    bench.qvel[:] = 0.1
    backlash.drive(bench)
    motor, joint = backlash._speed[0, 0], bench.qvel[0, 0]
    assert motor + joint == pytest.approx(0.5)
    assert joint - motor == pytest.approx(RESTITUTION * 0.3)
    assert backlash._ahead[0, 0] == pytest.approx(0.01)


def test_once_in_touch_a_motor_that_pushes_is_the_twin_s_and_one_that_brakes_lets_go():
    backlash = make()
    backlash._touch[:], backlash._ahead[:] = 1, 0.01
    leads, _, bench = push(backlash, 0.1, 5)
    np.testing.assert_allclose(leads[:, 0], 0.1)
    assert (bench.friction[0, 0], bench.armature[0, 0], bench.damping[0, 0]) == (0.2, 1e-6, 2.0)
    push(backlash, 0.01, 5)  # less than its friction: both stand still
    assert backlash._touch[0, 0] == 1
    push(backlash, -0.1, 1)
    assert backlash._touch[0, 0] == 0


def test_joints_that_carry_weight_and_arms_without_play_are_left_alone():
    leads, _, bench = push(make(), 0.1, 10)
    np.testing.assert_allclose(leads[:, 1:4], 0.1)  # shoulder, elbow and wrist bend carry links
    np.testing.assert_allclose(bench.friction[:, 1:4], 0.2)
    np.testing.assert_allclose(leads[:, [0, 4, 5]], 0.0, atol=1e-12)
    leads, speeds, bench = push(make(backlash=0.0), 0.1, 10)
    np.testing.assert_allclose(leads, 0.1)
    np.testing.assert_allclose(bench.friction, 0.2)
    assert not speeds.any()


def test_friction_stops_a_motor_and_does_not_turn_it_back():
    backlash = make(backlash=1.0, armature=0.02)
    push(backlash, 0.1, 100)
    start, speed = backlash._ahead[0, 0], backlash._speed[0, 0]
    assert speed > 0.0
    push(backlash, 0.0, 500)
    assert backlash._speed[0, 0] == 0.0
    # v' = -(f + d v) / m stops after m/d (v - f/d ln(1 + d v / f))
    way = 0.02 / 2.0 * (speed - 0.1 * np.log1p(speed / 0.1))
    assert backlash._ahead[0, 0] - start == pytest.approx(way, rel=0.1)
