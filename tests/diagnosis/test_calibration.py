"""Calibration: the fit knows its derivatives and what was put in, the gate knows noise, the file knows its arm."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rejoint.arms import Arm, Displacement, mycobot280, so101, solve_position, tcp_position
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.rotations import difference, pose_of, turned
from rejoint.diagnosis.calibration.calibration import (
    DisplacementLayout,
    read_calibration,
    write_calibration,
)
from rejoint.diagnosis.calibration.fit import fit
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.system.errors import ContractError, FileError

ARM = mycobot280()
SIGMA = 5e-4


def worn(seed=0, scale=1.0):
    """Draw a displacement of the size of a worn arm's."""
    rng = np.random.default_rng(seed)
    return replace(
        Displacement.none(ARM),
        offset=scale * rng.normal(0.0, np.radians(0.3), 6),
        compliance=scale * rng.uniform(0.01, 0.025, 6),
        play=scale * np.radians(rng.uniform(0.8, 1.6, 6)),
    )


def postures(count, seed=0):
    """Postures of targets."""
    return solve_position(ARM, ARM.targets.sample(np.random.default_rng(seed), (count,)), ARM.rest).q


def measured(truth, count, *, seed=0, noise=SIGMA):
    """Measure an arm whose floating base joint lies anywhere in its play."""
    rng, q = np.random.default_rng(seed), postures(count, seed)
    links = truth.joints(ARM, q)
    links[:, 0] += 0.5 * truth.play[0] * rng.uniform(-1.0, 1.0, count)
    point = tcp_position(truth.moved(ARM), links) + rng.normal(0.0, noise, (count, 3))
    return Measurements(
        position=q,
        point=point,
        sigma=np.full(count, noise),
        posture=np.arange(count),
    )


@cache
def fitted(seed, count):
    """Fit to ``count`` points of a worn arm."""
    return fit(ARM, measured(worn(seed), count, seed=seed))


def error_of(found, truth):
    """Mean distance [m] of modelled and true tools at fresh postures, the base joint in the middle of its play."""
    q = postures(40, seed=99)
    return float(np.linalg.norm(found.tool(q) - truth.tool(ARM, q), axis=1).mean())


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.004, -0.003), (0.1, 0.05)])
def test_derivatives_are_finite_differences(tilt):
    layout, rng, q = DisplacementLayout(ARM), np.random.default_rng(1), postures(4)
    vector = layout.vector(worn())
    vector[layout.at("mass")] = rng.normal(0.0, 0.1, 6)
    vector[layout.at("tilt")] = tilt
    tool, slope = layout.linearised(vector, q)
    np.testing.assert_allclose(tool, layout.displacement(vector).tool_pose(ARM, q), atol=1e-12)
    for k in range(layout.body):
        step = 1e-6 * np.eye(layout.body)[k]
        ends = [layout.displacement(vector + sign * step).tool_pose(ARM, q) for sign in (1.0, -1.0)]
        assert np.allclose(difference(*ends) / 2e-6, slope[..., k], atol=1e-4), layout.names()[k]


def test_a_single_joint_by_hand():
    # A rod of 1 kg with its centre 0.1 m out, held level, its tool at 0.2 m: 0.981 N m bend it by 0.00981 rad at
    # 100 N m/rad, and its weight presses it to the lower end of 0.02 rad of play.
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    rod = Arm(
        name="rod",
        joint_names=("only",),
        offset=pose_of(turn, np.zeros(3))[None],
        axis=np.array([[0.0, 0.0, 1.0]]),
        tip=pose_of(np.eye(3), np.array([0.2, 0.0, 0.0])),
        lower=np.array([-2.0]),
        upper=np.array([2.0]),
        max_speed=np.ones(1),
        mass=np.ones(1),
        com=np.array([[0.1, 0.0, 0.0]]),
        inertia=1e-3 * np.eye(3)[None],
        rest=np.zeros(1),
        targets=ARM.targets,
        floor=-1.0,
        encoder_step=1e-3,
    )
    behind = replace(Displacement.none(rod), compliance=np.array([0.01]), play=np.array([0.02]))
    drop = 0.00981 + 0.01
    assert np.allclose(behind.tool(rod, np.zeros(1)), [0.2 * np.cos(drop), 0.0, -0.2 * np.sin(drop)], atol=1e-9)


@pytest.mark.parametrize(("count", "most"), [(5, 1.2e-3), (10, 1.0e-3), (20, 0.7e-3)])
def test_a_fit_finds_the_displacement_that_was_put_in(count, most):
    errors = []
    for seed in range(2):
        found = fitted(seed, count)
        assert found.used
        assert found.before > 5e-3 > 3e-3 > found.after
        errors.append(error_of(found, worn(seed)))
    assert np.mean(errors) < most


def test_a_base_that_stands_askew_is_told_from_the_points():
    truth = replace(worn(), gravity=turned(np.radians([8.0, 0.0, 0.0])) @ GRAVITY)
    m = measured(truth, 20)
    m = replace(m, point=truth.tool(ARM, m.position) + np.random.default_rng(0).normal(0.0, SIGMA, (20, 3)))
    assert error_of(fit(ARM, m), truth) < 0.4e-3


def test_a_horn_that_slipped_by_a_tooth_is_found():
    truth = replace(worn(), offset=np.radians([0.0, 14.4, 0.0, 0.0, 0.0, 0.0]))
    assert error_of(fit(ARM, measured(truth, 12)), truth) < 0.5e-3


def test_heights_alone_are_enough():
    truth = replace(worn(), offset=np.zeros(6))
    m = measured(truth, 12)
    found = fit(ARM, replace(m, point=np.where([False, False, True], m.point, np.nan)))
    q = postures(40, seed=99)
    assert found.used
    assert np.abs(found.tool(q)[:, 2] - truth.tool(ARM, q)[:, 2]).mean() < 0.8e-3


def test_the_gate_refuses_to_correct_noise():
    refused = 0
    for seed in range(4):
        found = fit(ARM, measured(Displacement.none(ARM), 6, seed=seed))
        refused += not found.used
        if not found.used:
            target = ARM.targets.lower[None]
            assert (found.aim(target, ARM.rest) == target).all()
        else:  # what is let through hardly moves the tool
            assert np.linalg.norm(found.tool(postures(20)) - tcp_position(ARM, postures(20)), axis=1).mean() < 0.6e-3
    assert refused >= 3


def test_a_wrong_earlier_calibration_is_not_believed():
    m = measured(worn(0), 10)
    wrong = fit(ARM, replace(m, point=m.point @ turned(np.radians([0.0, 0.0, 5.0])).T))
    assert wrong.used
    found, q = fit(ARM, m, prior=wrong), postures(40, seed=99)
    assert found.used
    np.testing.assert_allclose(found.tool(q), fitted(0, 10).tool(q), atol=1e-4)


def test_one_misread_point_corrects_nothing():
    m = measured(Displacement.none(ARM), 1)
    assert not fit(ARM, replace(m, point=m.point - [0.0, 0.0, 0.025])).used


def test_points_between_which_the_arm_was_moved_correct_nothing():
    m = measured(worn(0), 20)
    assert not fit(ARM, replace(m, point=m.point + 0.006 * (np.arange(20) % 4 == 0)[:, None])).used


@pytest.mark.parametrize("seed", [0, 1])
def test_a_few_points_help_where_the_links_are_not_as_described(seed):
    twist = np.random.default_rng([seed, 2]).normal(0.0, [1e-3] * 3 + [np.radians(0.3)] * 3, (7, 6))
    truth = replace(worn(seed), twist=twist)
    found, q = fit(ARM, measured(truth, 3, seed=seed)), postures(40, 100 + seed)
    assert found.used
    off = np.linalg.norm(truth.tool(ARM, q) - found.displacement.tool(ARM, q), axis=1)
    assert off.mean() < 0.4 * np.linalg.norm(truth.tool(ARM, q) - tcp_position(ARM, q), axis=1).mean()


def test_a_wrong_point_is_named_and_right_ones_are_not():
    named = accused = 0
    for seed in range(3):
        m = measured(worn(seed), 10, seed=seed)
        accused += len(fitted(seed, 10).suspects)
        point = m.point.copy()
        point[seed] += 7e-3 * np.eye(3)[seed % 3]
        named += fit(ARM, replace(m, point=point)).suspects[:1] == (seed,)
    assert named >= 2
    assert accused <= 1


def test_scatter_tells_the_play_of_a_floating_joint():
    for play in np.radians([0.1, 1.5]):
        found = fit(ARM, measured(replace(worn(1), play=play * np.ones(6)), 20))
        assert abs(found.displacement.play[0] - play) < 0.008


def test_aiming_brings_the_tool_to_the_target():
    found = fitted(0, 10)
    target = ARM.targets.sample(np.random.default_rng(3), (2, 5))
    settled = solve_position(ARM, found.aim(target, ARM.rest), ARM.rest).q
    assert np.linalg.norm(found.tool(settled) - target, axis=-1).max() < 0.3e-3


def test_intervals_hold_the_truth():
    inside, widths = [], []
    for seed in range(3):
        found = fitted(seed, 10)
        fresh = measured(worn(seed), 60, seed=100 + seed, noise=1e-9)
        away = np.linalg.norm(fresh.point - tcp_position(ARM, fresh.position), axis=1)
        _, low, high = found.distance(fresh.position)
        inside.append((away >= low) & (away <= high))
        widths.append(high - low)
    assert 0.9 <= np.mean(inside) <= 1.0
    assert np.mean(widths) < 6e-3


def test_a_file_gives_back_what_was_written(tmp_path):
    found, path = replace(fitted(0, 5), date="2026-01-31"), tmp_path / "calibration.toml"
    write_calibration(path, found)
    again = read_calibration(path, ARM)
    q = postures(5)
    assert (again.tool(q) == found.tool(q)).all()
    assert np.allclose(again.distance(q), found.distance(q), rtol=1e-9)
    for name in ("frame_name", "source", "date", "points", "before", "after", "used", "floor", "suspects"):
        assert getattr(again, name) == getattr(found, name)


def test_a_file_is_refused_for_another_arm_and_where_it_was_changed(tmp_path):
    path = tmp_path / "calibration.toml"
    write_calibration(path, fitted(0, 5))
    with pytest.raises(ContractError):
        read_calibration(path, so101())
    with pytest.raises(ContractError):
        read_calibration(path, replace(ARM, mass=1.1 * ARM.mass))
    text = path.read_text()
    path.write_text(text.replace("used = true", "used = false"))
    with pytest.raises(FileError, match="damaged"):
        read_calibration(path, ARM)
    for broken in ("", "format = 2", "format = 1\narm = 3"):
        path.write_text(broken)
        with pytest.raises(FileError, match="calibrat"):
            read_calibration(path, ARM)
