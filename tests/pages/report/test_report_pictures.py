"""The figures of a report show the data of the run: the artists' data are compared with the results, not pixels."""

import numpy as np
import pytest


@pytest.fixture(scope="module")
def figures(whole):
    return whole[1]


def bars(axes):
    """Heights of vertical bars by label."""
    return {
        group.get_label(): [bar.get_height() for bar in group.patches]
        for group in axes.containers
        if getattr(group, "patches", None)
    }


def error_bars(axes):
    return [group for group in axes.containers if hasattr(group, "has_yerr")]


def whiskers(axes):
    """Ends (K, 2) of all error bars, one group after the other."""
    segments = [
        segment[:, 0 if group.has_xerr else 1]
        for group in error_bars(axes)
        for lines in group[2]
        for segment in lines.get_segments()
    ]
    return np.array(segments)


def points(axes, across):
    """Values of the points with error bars, in the order in which they were drawn."""
    drawn = [group[0].get_xdata() if across else group[0].get_ydata() for group in error_bars(axes)]
    return np.concatenate(drawn).astype(float)


def test_bars_per_target_are_means_over_the_repetitions_with_their_extremes(figures, comparison, diagnosis):
    axes = figures["error-per-target"].axes[0]
    assert "[mm]" in axes.get_ylabel()
    heights, chosen = bars(axes), ("default", "pid-sum", "policy")
    assert tuple(heights) == chosen, "the arm as it was, the recommended one, and one more"
    ends = []
    for name in chosen:
        first_set = 1e3 * comparison.array("settled", name)[0]
        np.testing.assert_allclose(heights[name], first_set.mean(axis=0))
        ends.append(np.stack([first_set.min(axis=0), first_set.max(axis=0)], axis=1))
    np.testing.assert_allclose(whiskers(axes), np.concatenate(ends))
    levels = {line.get_label(): line.get_ydata()[0] for line in axes.lines if len(set(line.get_ydata())) == 1}
    assert levels["healthy arm, mean and range"] == diagnosis.healthy.error_mm.value
    assert levels["counts as reached: 10 mm"] == 10.0


def test_training_curves_are_those_of_the_file(figures):
    k = np.arange(1, 81)
    axes = figures["training"].axes
    expected = (1 - 3 * np.exp(-k / 15), 100 * (1 - np.exp(-k / 20)), 50 * np.exp(-k / 12) + 0.8)
    for one, values in zip(axes, expected, strict=True):
        np.testing.assert_allclose(one.lines[0].get_xdata(), 16384 * k / 1e6)
        np.testing.assert_allclose(one.lines[0].get_ydata(), values)
