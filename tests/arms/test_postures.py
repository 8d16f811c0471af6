"""The choice of a posture: every branch is searched, and what is chosen keeps limits, torque and clearances."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from modelfiles import ur5e
from orientations import angles
from rejoint.arms import (
    Arm,
    Array,
    Box,
    Motors,
    frames,
    gravity_torque,
    mycobot280,
    so101,
    solve_position,
    tcp_position,
)
from rejoint.arms.collision import clearances_of
from rejoint.arms.postures import body_of, choose_postures
from rejoint.arms.rotations import Orientation, tool_axis

MARGIN = np.radians(0.5)
ARMS = {"mycobot280": mycobot280, "so101": so101, "ur5e": ur5e}


@cache
def arm_called(name: str) -> Arm:
    return ARMS[name]()


def free_postures(arm: Arm, count: int, seed: int) -> Array:
    """Random postures inside the limits with the room around them that chosen ones keep."""
    rng = np.random.default_rng(seed)
    drawn = rng.uniform(arm.lower + MARGIN, arm.upper - MARGIN, (20 * count, arm.joints))
    least = np.append(np.full(arm.joints, 0.002), 1.1 * body_of(arm).least)
    return drawn[(clearances_of(arm, body_of(arm).shape, drawn) > least).all(axis=-1)][:count]


def works(arm: Arm, q: Array) -> None:
    assert (q >= arm.lower).all()
    assert (q <= arm.upper).all()
    assert (clearances_of(arm, body_of(arm).shape, q) > -3e-5).all()


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("kind", ["place", "direction", "pose"])
def test_what_can_be_reached_is_found(name, kind):
    arm, count = arm_called(name), 300
    f = frames(arm, free_postures(arm, count, 1))
    whole, weight = np.full(count, kind == "pose"), np.full(count, 0.05)
    turn = Orientation(rotation=f.tcp_rotation, whole=whole, weight=weight, axis=tool_axis(arm))
    goals = choose_postures(arm, f.tcp_position, arm.rest, turn=None if kind == "place" else turn)
    found = np.array([not why for why in goals.refusals])
    assert found.mean() >= 0.99
    np.testing.assert_allclose(tcp_position(arm, goals.q[found]), f.tcp_position[found], atol=1e-5)
    assert kind == "place" or angles(turn, frames(arm, goals.q).tcp_rotation)[found].max() < 1e-3
    works(arm, goals.q)


def test_a_weak_joint_is_spared():
    arm = mycobot280()
    places = tcp_position(arm, free_postures(arm, 60, 4))
    limit = np.array([1.0, 1.0, 1.0, 0.05, 1.0, 1.0])
    local = solve_position(arm, places, arm.rest)
    heavy = local.converged & (np.abs(gravity_torque(arm, local.q))[:, 3] > limit[3])
    goals = choose_postures(arm, places[heavy], arm.rest, motors=Motors(limit, limit))
    assert heavy.sum() > 10
    assert sum(not why for why in goals.refusals) > 0.8 * heavy.sum()
    assert (np.abs(gravity_torque(arm, goals.q))[:, 3] <= limit[3]).all()


def test_what_is_too_heavy_is_so_in_every_posture():
    arm = mycobot280()
    places = tcp_position(arm, free_postures(arm, 60, 5))
    limit = np.array([0.5, 0.4, 0.2, 0.05, 0.05, 0.05])
    goals = choose_postures(arm, places, arm.rest, motors=Motors(limit, limit))
    heavy = [k for k, why in enumerate(goals.refusals) if why.startswith("too heavy")]
    assert 3 < len(heavy) < 50
    assert all(any(f"{name} needs" in goals.refusals[k] for name in arm.joint_names) for k in heavy)
    starts = np.random.default_rng(6).uniform(arm.lower, arm.upper, (1000, arm.joints))
    for k in heavy[:3]:
        any_way = solve_position(arm, places[k], starts, rest_gain=0.0)
        free = any_way.converged & (clearances_of(arm, body_of(arm).shape, any_way.q) > 0.0).all(axis=-1)
        assert free.any()
        assert (np.abs(gravity_torque(arm, any_way.q[free])) / limit).max(axis=-1).min() > 1.0
    assert (np.abs(gravity_torque(arm, goals.q)) <= limit + 1e-9).all()


def test_neighbouring_targets_stay_on_one_branch():
    arm = mycobot280()
    share = np.linspace(0.0, 1.0, 80)[:, None]
    for first, last in (((0.18, -0.18, 0.1), (0.18, 0.15, 0.25)), ((0.05, 0.2, 0.3), (0.25, 0.0, 0.08))):
        line = np.array(first) + share * (np.array(last) - np.array(first))
        goals = choose_postures(arm, line, arm.rest, chained=True, motors=Motors(*np.full((2, 6), 0.8)))
        assert goals.refusals == ("",) * len(line)
        assert np.abs(np.diff(goals.q, axis=0)).max() < 0.35


def test_every_refusal_has_its_reason_and_a_near_place_that_works():
    arm = replace(mycobot280(), keep_out=(Box(lower=np.array([0.1, -0.3, 0.0]), upper=np.array([0.4, -0.05, 0.3])),))
    far, low, inside, level = [0.6, 0.0, 0.2], [0.2, 0.1, 0.01], [0.2, -0.15, 0.1], [0.2, 0.1, 0.022]
    places = np.array([far, low, inside, level])
    goals = choose_postures(arm, places, arm.rest)
    for why, words in zip(goals.refusals, ("out of reach by", "below the floor", "box 1", "the ground"), strict=True):
        assert words in why
    works(arm, goals.q)
    nearest = np.round(tcp_position(arm, goals.q), 3)
    np.testing.assert_allclose(tcp_position(arm, goals.q), nearest, atol=2e-5)
    away = np.linalg.norm(nearest - places, axis=-1)
    assert f"out of reach by {1e3 * away[0]:.1f} mm" in goals.refusals[0]
    assert choose_postures(arm, nearest, arm.rest).refusals == ("",) * len(places)
    assert (away < [0.35, 0.03, 0.14, 0.02]).all()


def test_a_box_changes_the_posture_and_not_the_place():
    free, rng = mycobot280(), np.random.default_rng(7)
    place = np.array([[0.2, 0.0, 0.12]])
    q = choose_postures(free, place, free.rest).q
    elbow = frames(free, q[0]).position[2]
    arm = replace(free, keep_out=(Box(lower=elbow - 0.01, upper=elbow + rng.uniform(0.01, 0.02, 3)),))
    goals = choose_postures(arm, place, arm.rest)
    assert goals.refusals == ("",)
    assert (clearances_of(free, body_of(free).shape, q) > 0.0).all()
    assert (clearances_of(arm, body_of(arm).shape, q) < 0.0).any()
    works(arm, goals.q)
    np.testing.assert_allclose(tcp_position(arm, goals.q), place, atol=1e-5)
