"""Inverse kinematics: what it promises about limits, targets and least squares."""

import numpy as np

from rejoint.arms import dls, mycobot280, position_kinematics, solve_position, tcp_position

ARM = mycobot280()


def test_dls_equals_the_papers_form() -> None:
    q = np.random.default_rng(1).uniform(ARM.lower, ARM.upper, (30, 6))
    j, e = position_kinematics(ARM, q)[1], np.random.default_rng(2).normal(size=(30, 3))
    paper = [np.linalg.solve(a.T @ a + 0.05**2 * np.eye(6), a.T @ b) for a, b in zip(j, e, strict=True)]
    np.testing.assert_allclose(dls(j, e), paper, rtol=1e-9)


def test_an_unreachable_target_is_reported_and_kept_inside_limits() -> None:
    target = np.array([1.0, 0.0, 0.2])
    solution = solve_position(ARM, target, ARM.rest)
    assert not solution.converged
    assert np.linalg.norm(target - tcp_position(ARM, solution.q)) > 0.5
    assert ((solution.q >= ARM.lower) & (solution.q <= ARM.upper)).all()


def test_the_null_space_does_not_drift_over_many_targets() -> None:
    targets = ARM.targets.sample(np.random.default_rng(4), (300,))
    q = ARM.rest
    for target in targets:
        q = solve_position(ARM, target, q).q
    straight = solve_position(ARM, targets[-1], ARM.rest).q
    assert np.abs(q - straight).max() < np.radians(20)
