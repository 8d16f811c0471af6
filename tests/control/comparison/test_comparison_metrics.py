"""Metrics on signals whose answers are known by hand, and intervals against simulation and textbooks."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rejoint.arms import mycobot280
from rejoint.control.comparison.protocols import crossing, oscillation, settled, stay_time
from rejoint.control.targets import draw_targets, read_targets
from rejoint.system.errors import InputError
from rejoint.system.statistics import (
    FEWEST_CLUSTERS,
    above_zero,
    bootstrap_mean,
    cluster,
    clustered_share,
    paired_difference,
    spread,
    wilson,
)

ARM = mycobot280()
SINCE = np.linspace(0.0, 8.0, 321)


def test_an_exponential_approach_by_hand():
    """|e| = 80 mm exp(-t): below d for good at ln(80 mm / d); mean of the last second is its integral."""
    error = 0.08 * np.exp(-SINCE)
    for d in (0.01, 0.005, 0.002):
        exact = np.log(0.08 / d)
        assert 0.0 <= stay_time(SINCE, error, d) - exact <= 0.025
        reached, row = crossing(error, d)
        assert reached
        assert 0.0 <= SINCE[row] - exact <= 0.025
    mean = 0.08 * (np.exp(-7.0) - np.exp(-8.0))
    assert settled(SINCE, error, 1.0) == pytest.approx(mean, rel=1e-4)


def test_leaving_again_counts_for_staying_but_not_for_crossing():
    error = np.full(len(SINCE), 0.001)
    error[:40] = error[100] = 0.02
    assert crossing(error, 0.01) == (True, 40)
    assert stay_time(SINCE, error, 0.01) == SINCE[101]
    error[-1] = 0.02
    assert stay_time(SINCE, error, 0.01) == np.inf
    assert stay_time(SINCE, np.zeros(len(SINCE)), 0.01) == 0.0
    assert stay_time(SINCE, np.full(len(SINCE), np.nan), 0.01) == np.inf


def test_a_target_never_reached_ends_at_its_last_row():
    assert crossing(0.02 + SINCE, 0.01) == (False, len(SINCE) - 1)


def test_settled_weighs_by_time_not_by_rows():
    since = np.concatenate([np.linspace(0, 7.5, 10), np.linspace(7.5, 8.0, 500)[1:]])
    since = np.insert(since, np.searchsorted(since, 7.0), 7.0)
    signal = np.interp(since, [7.0, 7.5, 8.0], [1.0, 1.0, 3.0])
    assert settled(since, signal, 1.0) == pytest.approx(0.5 * 1.0 + 0.5 * 2.0, rel=1e-6)


def test_oscillation_of_a_circle_is_its_radius():
    angle = 2 * np.pi * np.arange(200) / 40
    since = np.arange(200) / 40
    tcp = np.stack([0.2 + 0.003 * np.cos(angle), 0.003 * np.sin(angle), np.full(200, 0.2)], axis=-1)
    assert oscillation(since, tcp, 40 / 40) == pytest.approx(0.003, rel=0.01)
    assert oscillation(since, tcp[:1].repeat(200, axis=0), 1.0) == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize(
    ("hits", "trials", "low", "high"),
    [(0, 10, 0.0, 0.2775), (10, 10, 0.7225, 1.0), (5, 10, 0.2366, 0.7634), (81, 263, 0.2553, 0.3662)],
)
def test_wilson_agrees_with_published_values(hits, trials, low, high):
    """81 of 263: Newcombe, Statistics in Medicine 17 (1998), table I; the others follow from the formula by hand."""
    found = wilson(hits, trials)
    assert (found.low, found.high) == pytest.approx((low, high), abs=1e-4)


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1))
def test_intervals_hold_their_value_and_repeat(seed):
    rng = np.random.default_rng(seed)
    values, labels = rng.lognormal(size=40), np.repeat(np.arange(8), 5)
    found = bootstrap_mean(values, labels)
    assert found.low <= found.value <= found.high
    assert found.value == pytest.approx(values.mean())
    assert found == bootstrap_mean(values, labels)
    shuffled = rng.permutation(40)
    assert bootstrap_mean(values[shuffled], labels[shuffled]).value == pytest.approx(found.value)


def test_the_bootstrap_covers_the_mean_of_dependent_results():
    """95 % nominal; percentile intervals of 12 clusters cover a little less, ignoring clusters covers half."""
    rng = np.random.default_rng(0)
    labels, hits, naive = np.repeat(np.arange(12), 10), 0, 0
    for _ in range(300):
        values = rng.normal(size=12).repeat(10) + 0.5 * rng.normal(size=120)
        found = bootstrap_mean(values, labels)
        single = bootstrap_mean(values, np.arange(120))
        hits += found.low <= 0.0 <= found.high
        naive += single.low <= 0.0 <= single.high
    assert 0.86 <= hits / 300 <= 0.98
    assert naive / 300 < 0.7


@pytest.mark.parametrize("clusters", range(1, 7))
def test_few_clusters_have_no_interval(clusters):
    """Their least and greatest mean would miss the truth more often than in one case of twenty."""
    values, labels = np.random.default_rng(0).normal(size=6 * clusters), np.repeat(np.arange(clusters), 6)
    for found in (bootstrap_mean(values, labels), spread(values, labels).mean):
        assert found.value == pytest.approx(values.mean())
        known = clusters >= FEWEST_CLUSTERS
        assert (found.low is not None, found.high is not None, above_zero(found)) == (known, known, False)
    assert spread(values[:1], labels[:1]).std is None
    assert 1 - 2.0 ** (1 - FEWEST_CLUSTERS) > 0.9 > 1 - 2.0 ** (2 - FEWEST_CLUSTERS)


def test_shares_of_dependent_results_are_less_certain():
    labels = np.repeat(np.arange(10), 10)
    alike = np.repeat(np.arange(10) % 2, 10).astype(float)
    mixed = (np.arange(100) % 2).astype(float)
    one, other = clustered_share(alike, labels), clustered_share(mixed, labels)
    assert one.value == other.value == 0.5
    assert (other.low, other.high) == pytest.approx((wilson(50, 100).low, wilson(50, 100).high))
    assert one.high - one.low > 2.5 * (other.high - other.low)
    sure = clustered_share(np.ones(100), labels)
    assert sure == wilson(100, 100)


def test_clusters_are_the_largest_units_that_are_enough():
    name, labels = cluster((5, 2, 3))
    assert (name, labels.tolist()) == ("target sets", np.repeat(np.arange(5), 6).tolist())
    name, labels = cluster((2, 3, 4))
    assert (name, labels.tolist()) == ("trials", np.repeat(np.arange(6), 4).tolist())
    assert cluster((1, 2, 10))[0] == "targets"


def test_pairs_remove_what_is_common():
    rng = np.random.default_rng(1)
    common, labels = rng.normal(0.0, 10.0, 60), np.repeat(np.arange(12), 5)
    first, second = common + 0.3 + 0.01 * rng.normal(size=60), common.copy()
    second[7] = np.nan
    found = paired_difference(first, second, labels)
    assert found.low < 0.3 < found.high
    assert found.high - found.low < 0.02
    assert paired_difference(first, np.full(60, np.nan), labels) is None


def test_drawn_targets_are_inside_and_sets_do_not_depend_on_their_number():
    few, many = draw_targets(ARM, sets=2, count=4, seed=3), draw_targets(ARM, sets=5, count=4, seed=3)
    assert (many[:2] == few).all()
    assert ((many >= ARM.targets.lower) & (many <= ARM.targets.upper)).all(axis=-1).all()
    assert len(np.unique(many.reshape(-1, 3), axis=0)) == 20
    assert (draw_targets(ARM, sets=2, count=4, seed=4) != few).any()
    with pytest.raises(InputError, match="at least 1"):
        draw_targets(ARM, sets=0)


@pytest.mark.parametrize(
    "text", ["\ufeffX, Y ,z\n150,0,200\n\n130,-100,150.5\n", "x_m;y [mm];z\n0,15;0;200\n0,13;-100;150,5\n"]
)
def test_targets_from_a_file_are_metres(tmp_path, text):
    path = tmp_path / "targets.csv"
    path.write_text(text)
    np.testing.assert_allclose(read_targets(path, ARM)[0], [[0.15, 0.0, 0.2], [0.13, -0.1, 0.1505]])


def test_targets_are_not_kept_to_the_region_where_they_are_drawn(tmp_path):
    path = tmp_path / "targets.csv"
    path.write_text("x,y,z\n120,0,120\n-150,120,200\n0,-200,80\n")
    targets, _ = read_targets(path, ARM)
    assert not ((targets >= ARM.targets.lower) & (targets <= ARM.targets.upper)).all(axis=-1).any()
