import dataclasses

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.control.policy import load_policy
from rejoint.training.presets import DEFAULT, PAPER
from rejoint.training.ranges import BroadRanges, IdentifiedRanges, MixedRanges, PaperRanges
from rejoint.training.train import TrainingOptions, know_stiffness, train, training_ranges
from rejoint.twin.parameters import nominal_parameters, pack, prior, vector_names
from rejoint.twin.prediction import PredictionError
from rejoint.twin.twin import HeldOut, Twin

ARM = mycobot280()
BROAD = BroadRanges(arm=ARM)
ERROR = PredictionError(joints=np.zeros(6), joint=0.0, tcp=0.0)


def make_twin() -> Twin:
    """A twin whose stiffness and delay are known to 4 % and 1 ms; all else is as vague as the prior."""
    belief, names = prior(ARM), vector_names(ARM.joint_names)
    known = np.array([name.startswith(("stiffness", "delay")) for name in names])
    sigma = np.where(known, [0.04 if "stiffness" in name else 0.001 for name in names], belief.sigma)
    return Twin(
        arm=ARM.name, joint_names=ARM.joint_names, parameters=nominal_parameters(ARM), covariance=np.diag(sigma**2),
        lower=belief.lower, upper=belief.upper, narrowing=sigma / belief.sigma, identified=known,
        held_out=HeldOut(seconds=1.0, no_twin=ERROR, healthy_twin=ERROR, twin=ERROR), fit_seconds=1.0,
    )  # fmt: skip


def draws(ranges, count=4000, seed=0):
    return ranges.draw(np.random.default_rng(seed), count)


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
        (draw.stiction, (1.0, 2.2)),
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


def test_some_joints_are_nearly_powerless():
    for ranges in (
        BROAD,
        IdentifiedRanges(broad=dataclasses.replace(BROAD, torque_limit=(1.0, 1.0)), twin=make_twin()),
    ):
        limit = draws(ranges).twin.torque_limit / nominal_parameters(ARM).torque_limit
        strong = draws(dataclasses.replace(BROAD, weak_joints=0.0)).twin.torque_limit
        assert strong.min() > 0.7 * nominal_parameters(ARM).torque_limit.min()
        assert 0.03 < (limit < 0.3).mean() < 0.12
    weak = BROAD.weaken(np.random.default_rng(0), 5000)
    assert abs((weak < 1.0).mean() - 0.08) < 0.01
    assert weak.min() >= 0.05
    assert weak[weak < 1.0].max() <= 0.5


def test_both_ways_share_the_identified_delay():
    draw = draws(IdentifiedRanges(broad=BROAD, twin=make_twin()))
    np.testing.assert_allclose(draw.command_delay + draw.readback_delay, draw.twin.delay)
    share = draw.command_delay / draw.twin.delay
    assert 0.3 <= share.min() < 0.32
    assert 0.68 < share.max() <= 0.7


def test_mixed_ranges_take_whole_arms_from_either_side():
    soft = BroadRanges(arm=ARM, stiffness=(0.5, 0.6), command_delay=(0.001, 0.002))
    hard = BroadRanges(arm=ARM, stiffness=(3.0, 4.0), command_delay=(0.050, 0.060))
    draw = draws(MixedRanges(first=soft, second=hard, share=0.25))
    is_soft = draw.command_delay < 0.01
    assert abs(is_soft.mean() - 0.25) < 0.03
    assert draw.twin.stiffness[is_soft, 0].max() < draw.twin.stiffness[~is_soft, 0].min()


def test_the_paper_s_ranges_are_those_of_the_paper():
    draw = draws(PaperRanges(arm=ARM), 3000)
    p, d = draw.twin.stiffness[:, 0] / 0.06, draw.twin.damping[:, 0] / 0.012
    assert 50.0 <= p.min() < 51.0
    assert 199.0 < p.max() <= 200.0
    assert ((d >= p / 50.0) & (d <= p / 10.0)).all()
    assert 1 / 60 <= draw.period.min() < draw.period.max() <= 1 / 30
    assert draw.twin.offset.std() == pytest.approx(np.radians(1.0), rel=0.02)


def test_the_paper_s_healthy_arm_is_one_stiff_pair():
    draw = draws(training_ranges(ARM, None, dataclasses.replace(PAPER, ranges="paper-healthy")), 200)
    np.testing.assert_allclose(draw.twin.stiffness, 0.06 * 1e4)
    np.testing.assert_allclose(draw.twin.damping, 0.012 * 1e3)
    assert draw.twin.offset.std() == pytest.approx(np.radians(1.0), rel=0.1)  # the noise of the task stays


def test_the_paper_s_units_go_with_the_weight_of_the_arm():
    heavy = dataclasses.replace(ARM, mass=16.0 * ARM.mass, inertia=16.0 * ARM.inertia)
    one, other = draws(PaperRanges(arm=ARM), 50).twin, draws(PaperRanges(arm=heavy), 50).twin
    for name in ("stiffness", "damping", "armature", "torque_limit"):
        np.testing.assert_allclose(getattr(other, name), 16.0 * getattr(one, name), rtol=1e-9)
    np.testing.assert_array_equal(other.offset, one.offset)


def test_broad_ranges_reach_out_to_a_twin_of_another_make_and_leave_others_alone():
    twin = make_twin()
    assert BROAD.reaching(twin) == BROAD
    sticky = dataclasses.replace(
        twin.parameters, coulomb=10.0 * twin.parameters.coulomb, stiffness=0.2 * twin.parameters.stiffness
    )
    moved = BROAD.reaching(dataclasses.replace(twin, parameters=sticky))
    assert moved.coulomb == pytest.approx((0.0, 10.0))
    assert moved.stiffness == pytest.approx((0.2, 0.2 * BROAD.stiffness[1] / BROAD.stiffness[0]))
    assert (moved.damping, moved.torque_limit, moved.armature) == (BROAD.damping, BROAD.torque_limit, BROAD.armature)
    drawn = draws(moved).twin
    assert drawn.coulomb.max() > 9.0 * nominal_parameters(ARM).coulomb.max()


def test_an_identified_acceleration_is_trained_on_and_changes_nothing_else_of_those_arms():
    twin = make_twin()
    limited = dataclasses.replace(twin, acceleration=39.0)
    free, bound = (draws(IdentifiedRanges(broad=BROAD, twin=t), 500) for t in (twin, limited))
    assert (free.acceleration == np.inf).all()
    assert np.log(bound.acceleration).mean() == pytest.approx(np.log(39.0), abs=0.01)
    assert 0.03 < np.log(bound.acceleration).std() < 0.07
    np.testing.assert_array_equal(pack(free.twin), pack(bound.twin))
    np.testing.assert_array_equal(free.period, bound.period)
    mixed = draws(training_ranges(ARM, limited, DEFAULT))
    assert abs(np.isfinite(mixed.acceleration).mean() - 0.5) < 0.03  # the broad half limits speeds


def test_stiction_that_logs_have_told_is_trained_on_and_an_assumed_one_is_drawn():
    twin = make_twin()
    told = dataclasses.replace(twin, stiction=1.25)
    assumed, known = (draws(IdentifiedRanges(broad=BROAD, twin=t), 500) for t in (twin, told))
    np.testing.assert_array_equal(assumed.stiction, draws(BROAD, 500).stiction)
    assert np.ptp(assumed.stiction) > 0.1
    assert (known.stiction == 1.25).all()
    np.testing.assert_array_equal(pack(assumed.twin), pack(known.twin))


def test_ranges_follow_from_preset_and_twin():
    twin = make_twin()
    assert isinstance(training_ranges(ARM, None, DEFAULT), BroadRanges)
    assert training_ranges(ARM, twin, DEFAULT).first.twin is twin
    noisy = dataclasses.replace(PAPER, joint_noise=np.radians(5.0))
    assert training_ranges(ARM, twin, noisy).joint_noise == np.radians(5.0)


def test_a_policy_says_which_twin_it_was_trained_on(tmp_path):
    twin = make_twin()
    result = train(ARM, twin, out=tmp_path, options=TrainingOptions(agents=8, threads=1, iterations=1))
    assert load_policy(result.policy, ARM).contract.twin_digest == twin.digest()


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


def test_the_law_is_patient_on_such_arms_alone():
    twin = make_twin()
    damped = dataclasses.replace(twin.parameters, damping=4.0 * twin.parameters.damping)
    recipe = know_stiffness(DEFAULT, ARM, dataclasses.replace(twin, parameters=damped))
    assert recipe.task.law.decay_start > 0.0
    assert know_stiffness(DEFAULT, ARM, twin).task.law.decay_start == 0.0
    assert know_stiffness(DEFAULT, ARM, None).task.law.decay_start == 0.0
    assert know_stiffness(PAPER, ARM, dataclasses.replace(twin, parameters=damped)) == PAPER
