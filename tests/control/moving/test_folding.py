"""Arms whose motors hardly lift them fold; all others follow near to rest."""

from dataclasses import replace

import numpy as np
import pytest

from rejoint.arms import collides, gravity_torque, load_arm, tcp_position
from rejoint.control.moving.tracker import PathPostures, home_of
from rejoint.control.robot import Servos


def servos_with(arm, limits):
    """Servos of arms whose motors have these torque limits (B, n) [N m]."""
    some = np.ones_like(limits)
    return Servos(
        stiffness=5.0 * some,
        damping=0.2 * some,
        coulomb=0.05 * some,
        armature=0.01 * some,
        torque_limit=limits,
        offset=0.0 * some,
        delay=np.full(len(limits), 0.02),
    )


def loads(arm, home):
    """Usual torques (n,) [N m] of gravity in the region of targets."""
    places = arm.targets.sample(np.random.default_rng(5), (200,))
    return np.abs(gravity_torque(arm, PathPostures(arm, places, home=home).last)).mean(axis=0)


@pytest.mark.parametrize(("name", "heavy"), [("mycobot280", 2), ("so101", 1)])
def test_only_arms_that_are_too_weak_for_rest_fold(name, heavy):
    arm = load_arm(name)
    need = loads(arm, arm.rest)
    strong = 4.0 * need.max() * np.ones(arm.joints)
    weak = strong.copy()
    weak[heavy] = 1.3 * need[heavy] + 0.05
    home = home_of(arm, servos_with(arm, np.stack([strong, weak, strong])))
    np.testing.assert_array_equal(home[[0, 2]], np.tile(arm.rest, (2, 1)))
    assert (home[1] != arm.rest).sum() == 1
    assert ((home > arm.lower) & (home < arm.upper)).all()
    assert loads(arm, home[1])[heavy] < 0.95 * need[heavy]


def test_an_arm_that_no_fold_helps_stays_at_rest():
    arm = load_arm("so101")
    limits = 4.0 * loads(arm, arm.rest).max() * np.ones((1, arm.joints))
    limits[0, 2] = 1.3 * loads(arm, arm.rest)[2] + 0.05  # its elbow, which the wrist does not help
    np.testing.assert_array_equal(home_of(arm, servos_with(arm, limits))[0], arm.rest)


def test_no_arm_folds_into_itself_or_the_ground():
    arm = load_arm("mycobot280")
    tip = np.array(arm.tip)
    tip[2, 3] += 0.2  # [m] a tool so long that the arm touches something in places where the wrist is folded
    tooled = replace(arm, tip=tip)
    places = arm.targets.sample(np.random.default_rng(0), (32,))

    def touches(home):
        return collides(tooled, PathPostures(tooled, places, home=home).last).any()

    wrist = np.radians([0.0, 0.0, 0.0, 60.0, 0.0, 0.0])
    assert not touches(tooled.rest)
    assert touches(tooled.rest + wrist)
    assert touches(tooled.rest - wrist)
    home = home_of(tooled, servos_with(tooled, (1.3 * loads(tooled, tooled.rest) + 0.05)[None]))[0]
    assert not touches(home)


def test_a_folded_arm_has_its_tool_at_the_same_places():
    arm = load_arm("mycobot280")
    places = arm.targets.sample(np.random.default_rng(1), (50,))
    home = arm.rest - np.radians([0.0, 0.0, 0.0, 60.0, 0.0, 0.0])
    folded, plain = PathPostures(arm, places, home=home).last, PathPostures(arm, places).last
    np.testing.assert_allclose(tcp_position(arm, folded), places, atol=1e-5)
    assert np.degrees(np.abs(folded - plain)[:, 3]).min() > 30.0
    turned = PathPostures(arm, places, home=arm.rest)
    np.testing.assert_array_equal(turned.last, plain)
