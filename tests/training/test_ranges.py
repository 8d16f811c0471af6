import dataclasses

import numpy as np
import pytest

from madetwin import made_twin
from rejoint.arms import mycobot280
from rejoint.training.ranges import BroadRanges, IdentifiedRanges, MixedRanges, training_ranges
from rejoint.twin.parameters import nominal_parameters, pack, prior, vector_names

ARM = mycobot280()
BROAD = BroadRanges(arm=ARM)


def make_twin():
    """A twin whose stiffness and delay are known to 4 % and 1 ms; all else is as vague as the prior."""
    belief, names = prior(ARM), vector_names(ARM.joint_names)
    known = np.array([name.startswith(("stiffness", "delay")) for name in names])
    sigma = np.where(known, [0.04 if "stiffness" in name else 0.001 for name in names], belief.sigma)
    found = {"covariance": np.diag(sigma**2), "narrowing": sigma / belief.sigma, "identified": known}
    return made_twin(ARM, nominal_parameters(ARM), **found)


def draws(ranges, count=4000):
    return ranges.draw(np.random.default_rng(0), count)


def test_broad_ranges_keep_their_bounds():
    draw = draws(BROAD)
    stiffness = draw.twin.stiffness[:, 0]
    assert 3.0 * 0.75 <= stiffness.min() < 3.2
    assert 14.0 < stiffness.max() <= 12.0 * 1.25 + 0.01
    assert abs((draw.twin.coulomb == 0.0).all(axis=1).mean() - 0.2) < 0.03
    for values, (low, high) in (
        (draw.command_delay, (0.005, 0.040)),
        (draw.readback_delay, (0.005, 0.030)),
        (draw.period, (0.018, 0.055)),
        (draw.twin.stiction, (1.0, 2.2)),
    ):
        width = high - low
        assert low <= values.min() < low + 0.05 * width
        assert high - 0.05 * width < values.max() <= high


def test_what_is_identified_is_drawn_closely_and_the_rest_broadly():
    draw = draws(IdentifiedRanges(broad=BROAD, twin=make_twin()))
    spread = (pack(draw.twin) - pack(nominal_parameters(ARM))).std(axis=0)
    names = vector_names(ARM.joint_names)
    stiffness, armature = spread[names.index("stiffness.joint3")], spread[names.index("armature.joint3")]
    assert 1.5 * 0.04 < stiffness < 2.5 * 0.04  # wider: no twin has the structure of the arm
    assert armature > 0.3  # as vague as the prior
    assert (draw.period.min(), draw.period.max()) == pytest.approx((0.018, 0.055), rel=0.01)


def test_mixed_ranges_take_whole_arms_from_either_side():
    soft = BroadRanges(arm=ARM, stiffness=(0.5, 0.6), command_delay=(0.001, 0.002))
    hard = BroadRanges(arm=ARM, stiffness=(3.0, 4.0), command_delay=(0.050, 0.060))
    draw = draws(MixedRanges(first=soft, second=hard, share=0.25))
    is_soft = draw.command_delay < 0.01
    assert abs(is_soft.mean() - 0.25) < 0.03
    assert draw.twin.stiffness[is_soft, 0].max() < draw.twin.stiffness[~is_soft, 0].min()


def test_an_identified_acceleration_is_trained_on_and_changes_nothing_else_of_those_arms():
    twin = make_twin()
    limited = dataclasses.replace(twin, acceleration=39.0)
    free, bound = (draws(IdentifiedRanges(broad=BROAD, twin=t), 500) for t in (twin, limited))
    assert (free.acceleration == np.inf).all()
    assert np.log(bound.acceleration).mean() == pytest.approx(np.log(39.0), abs=0.01)
    assert 0.03 < np.log(bound.acceleration).std() < 0.07
    np.testing.assert_array_equal(pack(free.twin), pack(bound.twin))
    np.testing.assert_array_equal(free.period, bound.period)
    mixed = draws(training_ranges(ARM, limited))
    assert abs(np.isfinite(mixed.acceleration).mean() - 0.5) < 0.03  # the broad half limits speeds


def test_backlash_is_met_where_motors_cross_it_slowly():
    twin = make_twin()
    none = draws(BROAD.reaching(twin), 50)
    assert not none.backlash.any()
    damped = dataclasses.replace(twin.parameters, damping=4.0 * twin.parameters.damping)
    draw = draws(BROAD.reaching(dataclasses.replace(twin, parameters=damped)))
    seen = draw.backlash.any(axis=1)
    assert abs(seen.mean() - 0.6) < 0.03
    assert np.degrees(draw.backlash.max()) == pytest.approx(1.8, abs=0.01)
    assert 0.02 <= draw.grease.min() < draw.grease.max() <= 0.2
    # what is drawn besides does not depend on it
    moved = dataclasses.replace(BROAD.reaching(dataclasses.replace(twin, parameters=damped)), backlash=(0.0, 0.0))
    np.testing.assert_array_equal(draws(moved).twin.damping, draw.twin.damping)
