"""An arm follows a path near rest where it can; where it cannot, or its motors hardly lift it, near another posture."""

import numpy as np
import pytest

from rejoint.arms import Motors, clearances, collides, gravity_torque, load_arm, tcp_position
from rejoint.arms.postures import choose_postures, pool_of
from rejoint.control.moving.reference import Path, standard_path
from rejoint.control.moving.tracker import PathPostures
from rejoint.system.errors import InputError

AROUND = np.linspace(0.0, 2.0 * np.pi, 61)


def along(arm, path, home):
    """Postures (T, n) [rad] near a home."""
    return PathPostures(arm, path.place[:1], home=home).along(path.place[:, None])[:, 0]


def loads(arm, path, home):
    """Largest gravity torques (n,) [N m] on a path."""
    return np.abs(gravity_torque(arm, along(arm, path, home))).max(axis=0)


def circle(middle, radius):
    place = middle + radius * np.column_stack([np.cos(AROUND), np.sin(AROUND), np.zeros(61)])
    return Path(time=np.linspace(0.0, 6.0, 61), place=place)


@pytest.mark.parametrize("name", ["mycobot280", "so101"])
def test_paths_all_around_the_arm_are_followed_without_a_contact(name):
    arm = load_arm(name)
    rng, places = np.random.default_rng(2), pool_of(arm).place
    possible, followed, beyond_rest = 0, 0, 0
    for middle in places[rng.integers(len(places), size=10)]:
        path = circle(middle, 0.02)
        if any(choose_postures(arm, path.place[::6], arm.rest).refusals):
            continue
        possible += 1
        try:
            home = path.home(arm)
        except InputError:
            continue
        way = along(arm, path, home)
        np.testing.assert_allclose(tcp_position(arm, way), path.place, atol=1e-3)
        assert not collides(arm, way).any()
        followed += 1
        beyond_rest += bool((home != arm.rest).any())
    assert possible > 3
    assert followed >= 0.8 * possible
    assert beyond_rest > 0


@pytest.mark.parametrize(("name", "heavy"), [("mycobot280", 2), ("so101", 1)])
def test_an_arm_too_weak_for_rest_takes_a_posture_that_its_motors_lift(name, heavy):
    arm, path = load_arm(name), standard_path("circle-8s", load_arm(name))
    need = loads(arm, path, arm.rest)
    strong = 4.0 * need.max() * np.ones(arm.joints)
    weak = strong.copy()
    weak[heavy] = need[heavy]
    np.testing.assert_array_equal(path.home(arm, Motors(strong, strong)), arm.rest)
    home = path.home(arm, Motors(weak, weak))
    assert loads(arm, path, home)[heavy] < 0.95 * need[heavy]
    torque = gravity_torque(arm, arm.rest)
    lame = np.where((home - arm.rest) * torque > 1e-9, 0.0, weak)  # what may not lift itself is not raised
    raised = (path.home(arm, Motors(weak, lame)) - arm.rest) * torque
    assert (raised[lame == 0.0] <= 1e-9).all()


def test_a_path_that_the_motors_do_not_lift_is_refused_with_the_joint():
    arm = load_arm("so101")
    path = standard_path("circle-8s", arm)
    weak = 0.5 * loads(arm, path, arm.rest)
    with pytest.raises(InputError, match=r"too heavy: .* needs"):
        path.home(arm, Motors(weak, weak))


@pytest.mark.parametrize("height", [0.026, 0.04])
def test_an_accepted_path_keeps_the_clearance_of_targets(height):
    arm = load_arm("mycobot280")
    path = circle([0.16, 0.1, height], 0.03)
    if any(choose_postures(arm, path.place[::6], arm.rest).refusals):
        with pytest.raises(InputError):
            path.home(arm)
    else:
        way = along(arm, path, path.home(arm))
        assert clearances(arm, way).min() > 0.0
        assert np.maximum(arm.lower - way, way - arm.upper).max() < -np.radians(0.4)
