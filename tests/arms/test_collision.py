import dataclasses

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rejoint.arms import Box, clearances, collides, frames, mycobot280, so101, solve_position
from rejoint.arms.arm import frozen
from rejoint.arms.collision import clearances_of, collision_shape
from segments import link_ends, segments_apart

ARM = mycobot280()
POINT = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)


def touches(*degrees: float) -> bool:
    return bool(collides(ARM, np.radians(degrees)))


def test_a_healthy_posture_touches_nothing():
    assert not collides(ARM, ARM.rest)
    assert not touches(0, 0, 0, 0, 0, 0)  # upright


def test_an_arm_that_bends_down_touches_the_ground():
    # Stretched out level at shoulder height (131 mm) nothing touches; 45 deg lower the elbow (110 mm out) is still
    # above the 26 mm of its housing, the wrist (206 mm out) is not.
    assert not touches(0, -90, 0, 0, 0, 0)
    elbow = frames(ARM, np.radians([0.0, -135, 0, 0, 0, 0])).position
    assert elbow[2, 2] == pytest.approx(0.13122 - 0.1104 * np.sin(np.pi / 4))
    assert elbow[3, 2] < 0.0
    assert touches(0, -135, 0, 0, 0, 0)


def test_a_folded_arm_touches_itself():
    # Elbow bent by 150 deg: the wrist comes back to the upper arm, 96 mm sin 30 deg = 48 mm from its axis, closer
    # than two radii of 26 mm; at 135 deg (68 mm) it does not touch.
    folded, less = np.radians([0.0, 0, 150, -150, 0, 0]), np.radians([0.0, 0, 135, -135, 0, 0])
    shape = collision_shape(ARM)
    assert shape.radius == pytest.approx(0.0260835)
    for posture, expected in ((folded, True), (less, False)):
        assert frames(ARM, posture).position[..., 2].min() >= 0.0
        assert bool(collides(ARM, posture)) is expected


def test_neighbours_never_count_and_every_other_pair_does():
    pairs = {tuple(pair) for pair in collision_shape(ARM).pairs.tolist()}
    assert not any(j - i < 2 for i, j in pairs)
    assert {(1, 3), (2, 4), (1, 6), (2, 6), (3, 6)} <= pairs


each_arm = pytest.mark.parametrize("arm", [mycobot280(), so101()], ids=lambda arm: arm.name)


@each_arm
def test_an_arm_is_free_at_rest_and_at_its_targets(arm):
    targets = arm.targets.sample(np.random.default_rng(0), (300,))
    solution = solve_position(arm, targets, np.broadcast_to(arm.rest, (300, arm.joints)))
    assert not collides(arm, arm.rest)
    assert collides(arm, solution.q).mean() < 0.01


@each_arm
def test_clearances_are_distances_and_contacts_are_those_below_zero(arm):
    postures = np.random.default_rng(2).uniform(arm.lower, arm.upper, (300, arm.joints))
    shape, ends = collision_shape(arm), link_ends(arm, postures)
    i, j = shape.pairs.T
    apart = segments_apart(ends[:, i], ends[:, i + 1], ends[:, j], ends[:, j + 1]) - 2 * shape.radius
    floors = 0.01 * np.arange(arm.joints)
    floored = shape._replace(floors=frozen(floors))
    found = clearances_of(arm, floored, postures)
    wanted = np.concatenate([ends[:, 2:, 2] - floors, apart, ends[:, shape.places, 2] - shape.radius], axis=-1)
    np.testing.assert_allclose(found, wanted, atol=1e-9)
    np.testing.assert_array_equal((found[:, arm.joints :] < 0.0).any(axis=-1), collides(arm, postures))
    again = clearances_of(arm, floored, postures.reshape(20, 15, arm.joints))
    np.testing.assert_array_equal(again, found.reshape(20, 15, -1))


@given(POINT, POINT, POINT, POINT)
@example(np.array([0.0, 0.0, 1e-10]), np.zeros(3), np.zeros(3), np.zeros(3))
@settings(max_examples=60)
def test_the_reference_distance_is_the_smallest_over_all_points(a, b, c, d):
    share = np.linspace(0.0, 1.0, 81)
    one, other = a + share[:, None] * (b - a), c + share[:, None] * (d - c)
    sampled = np.linalg.norm(one[:, None] - other[None], axis=-1).min()
    exact = float(segments_apart(a, b, c, d))
    tolerance = 1e-6  # segments shorter than 3e-8 m count as points, those turned by less than 3e-7 as parallel
    assert exact <= sampled + tolerance
    assert exact >= sampled - (np.linalg.norm(b - a) + np.linalg.norm(d - c)) / 160 - tolerance


@each_arm
def test_links_keep_out_of_boxes(arm):
    rng = np.random.default_rng(4)
    boxes = tuple(Box(lower=low, upper=low + rng.uniform(0.02, 0.2, 3)) for low in rng.uniform(-0.3, 0.3, (2, 3)))
    boxed = dataclasses.replace(arm, keep_out=boxes)
    postures = rng.uniform(arm.lower, arm.upper, (40, arm.joints))
    shape, ends = collision_shape(boxed), link_ends(arm, postures)
    links = shape.moving
    points = ends[:, links, None] + np.linspace(0, 1, 401)[:, None] * (ends[:, links + 1] - ends[:, links])[:, :, None]
    apart = [np.linalg.norm(np.maximum(points - b.upper, 0) + np.maximum(b.lower - points, 0), axis=-1) for b in boxes]
    sampled = np.concatenate([one.min(axis=-1) for one in apart], axis=1) - shape.radius
    free, found = clearances(arm, postures), clearances(boxed, postures)
    np.testing.assert_array_equal(found[:, : free.shape[1]], free)
    np.testing.assert_allclose(found[:, free.shape[1] :], sampled, atol=5e-4)
    np.testing.assert_array_equal((found < 0.0).any(axis=-1), collides(boxed, postures))
