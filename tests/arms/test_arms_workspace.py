"""The rest posture and the target region that are derived: the properties they promise, not their values."""

from dataclasses import replace

import numpy as np
import pytest

from rejoint.arms import (
    Arm,
    frames,
    gravity_torque,
    mycobot280,
    position_kinematics,
    so101,
    solve_position,
    tcp_position,
)
from rejoint.arms.workspace import (
    AXIS_CLEARANCE,
    EDGES,
    LIMIT_MARGIN,
    REST_HEIGHT,
    derive_targets,
    derive_workspace,
    on_a_surface,
    reach,
    rising_frames,
)
from rejoint.system.errors import InputError

ARMS = {"mycobot280": mycobot280, "so101": so101}


@pytest.fixture(scope="module", params=ARMS)
def derived(request: pytest.FixtureRequest) -> Arm:
    arm = ARMS[request.param]()
    rest, targets = derive_workspace(arm)
    return replace(arm, rest=rest, targets=targets)


def manipulability(arm: Arm, q: np.ndarray) -> np.ndarray:
    j = position_kinematics(arm, q)[1]
    return np.sqrt(np.linalg.det(j @ np.swapaxes(j, -1, -2)))


def test_the_rest_posture_is_a_good_one(derived: Arm) -> None:
    q, f = derived.rest, frames(derived, derived.rest)
    middle, half = (derived.upper + derived.lower) / 2, (derived.upper - derived.lower) / 2
    assert (np.abs(q - middle) < 0.8 * half).all()
    np.testing.assert_allclose(np.degrees(q), np.rint(np.degrees(q)), atol=1e-9)
    assert f.tcp_position[0] > 0.15 * reach(derived)
    assert f.tcp_position[2] > derived.floor + REST_HEIGHT * reach(derived)
    assert f.position[:, 2].max() > f.tcp_position[2]  # elbow up
    others = np.random.default_rng(1).uniform(derived.lower, derived.upper, (2000, derived.joints))
    assert manipulability(derived, q) > np.quantile(manipulability(derived, others), 0.6)
    load = np.abs(gravity_torque(derived, others)).max(axis=-1)
    assert np.abs(gravity_torque(derived, q)).max() < load.max()


def test_every_target_is_reached_with_margins_and_above_the_floor(derived: Arm) -> None:
    check_targets(derived)


def test_a_stretched_arm_cuts_the_region() -> None:
    forward, upward = [15.0, -50, -45, -20, 0, 0], [15.0, -15, -20, -15, 0, 0]
    for posture, axis in ((forward, 0), (upward, 2)):
        arm = replace(mycobot280(), rest=np.radians(posture))
        arm = replace(arm, targets=derive_targets(arm)[1])
        assert arm.targets.upper[axis] < tcp_position(arm, arm.rest)[axis] + 0.001  # nothing beyond where it starts
        check_targets(arm)


def check_targets(derived: Arm) -> None:
    targets = np.concatenate([derived.targets.sample(np.random.default_rng(2), (1000,)), corners(derived)])
    solution = solve_position(derived, targets, derived.rest)
    assert solution.converged.all()
    np.testing.assert_allclose(tcp_position(derived, solution.q), targets, atol=2e-5)
    assert (np.hypot(*targets.T[:2]) > AXIS_CLEARANCE * reach(derived) - 1e-3).all()
    margin = 0.9 * LIMIT_MARGIN * (derived.upper - derived.lower)  # a tenth less than on the grid that was checked
    assert ((solution.q > derived.lower + margin) & (solution.q < derived.upper - margin)).all()
    f = frames(derived, solution.q)
    assert (f.position[..., 2].min(axis=-1) > min(derived.floor, derived.offset[0, 2, 3] - 1e-9)).all()
    start, millimetre = tcp_position(derived, derived.rest), 1e-3  # to which the bounds are rounded
    assert (derived.targets.lower - millimetre < start).all()
    assert (start < derived.targets.upper + millimetre).all()
    assert (derived.targets.upper - derived.targets.lower <= EDGES * reach(derived) + 1e-9).all()


def corners(arm: Arm) -> np.ndarray:
    box = np.array([arm.targets.lower, arm.targets.upper])
    return np.stack(np.meshgrid(*box.T), axis=-1).reshape(-1, 3)


def test_the_region_of_a_mycobot_is_much_like_the_papers() -> None:
    arm = mycobot280()  # whose own region is that of Park et al. 2024
    _, found = derive_workspace(arm)
    common = np.minimum(found.upper, arm.targets.upper) - np.maximum(found.lower, arm.targets.lower)
    assert common.prod() > 0.5 * (arm.targets.upper - arm.targets.lower).prod()


def test_an_arm_without_targets_is_known() -> None:
    arm = so101()
    planar = replace(arm, axis=np.tile([1.0, 0, 0], (5, 1)), offset=np.tile(np.eye(4), (5, 1, 1)))
    assert on_a_surface(planar)
    assert not on_a_surface(arm)
    with pytest.raises(InputError):
        derive_targets(replace(arm, rest=arm.upper))


def test_a_shoulder_on_its_column_neither_rises_nor_sinks() -> None:
    np.testing.assert_array_equal(rising_frames(mycobot280()), [False, False, True, True, True, True])
    np.testing.assert_array_equal(rising_frames(so101()), [False, False, True, True, True])
