"""The figures of a report show the data of the run: the artists' data are compared with the results, not pixels."""

import numpy as np
import pytest
from report_samples import SPEED, trial_log

from rejoint.arms import tcp_position
from rejoint.pages.report.sections.motion import STEP


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
    heights, chosen = bars(axes), ("default", "pid-sum", "policy")
    assert tuple(heights) == chosen, "the arm as it was, the recommended one, and one more"
    ends = []
    for name in chosen:
        first_set = 1e3 * comparison.row(name).outcomes.array("settled")[0]
        np.testing.assert_allclose(heights[name], first_set.mean(axis=0))
        ends.append(np.stack([first_set.min(axis=0), first_set.max(axis=0)], axis=1))
    np.testing.assert_allclose(whiskers(axes), np.concatenate(ends))
    levels = {line.get_label(): line.get_ydata()[0] for line in axes.lines if len(set(line.get_ydata())) == 1}
    assert levels["healthy arm, mean and range"] == diagnosis.healthy.error_mm.value
    assert levels["counts as reached: 10 mm"] == 10.0


def test_settled_errors_and_cycle_times_are_those_of_the_comparison(figures, comparison):
    axes = figures["settled-error"].axes[0]
    rows = [spread.mean for row in comparison.rows for spread in (row.hold.settled, row.hold.settled_true)]
    np.testing.assert_allclose(points(axes, across=True), [1e3 * one.value for one in rows])
    np.testing.assert_allclose(whiskers(axes), [[1e3 * one.low, 1e3 * one.high] for one in rows])
    assert [label.get_text() for label in axes.get_yticklabels()] == list(comparison.controllers)
    axes = figures["cycle-time"].axes[0]
    times = [row.crossing.cycle_time.mean for row in comparison.rows]
    np.testing.assert_allclose(points(axes, across=True), [one.value for one in times])
    np.testing.assert_allclose(whiskers(axes), [[one.low, one.high] for one in times])


def test_open_loop_bars_are_the_targets_of_the_diagnosis(figures, diagnosis):
    found = bars(figures["open-loop"].axes[0])
    assert found == {
        "this arm, by its encoders": [target.error_mm for target in diagnosis.open_loop.targets],
        "this arm, true error of the tool": [target.true_error_mm for target in diagnosis.open_loop.targets],
    }


@pytest.mark.parametrize(
    ("key", "field", "factor"), [("joint-damping-ratio", "damping_ratio", 1.0), ("joint-lag", "lag_s", 1e3)]
)
def test_points_of_the_joints_lie_over_their_healthy_ranges(figures, diagnosis, key, field, factor):
    axes = figures[key].axes[0]
    measured = [getattr(row, field) for row in diagnosis.measurement.joints]
    healthy = [getattr(row, field) for row in diagnosis.healthy.joints]
    np.testing.assert_allclose(points(axes, across=False), [factor * one.value for one in measured])
    np.testing.assert_allclose(whiskers(axes), [[factor * one.low, factor * one.high] for one in measured])
    ranges = [[bar.get_y(), bar.get_y() + bar.get_height()] for bar in axes.patches]
    np.testing.assert_allclose(ranges, [[factor * one.low, factor * one.high] for one in healthy])
    means = axes.collections[0]
    np.testing.assert_allclose(
        [path.vertices[:, 1].mean() for path in means.get_paths()], [factor * one.value for one in healthy]
    )


def test_predictions_and_parameters_of_the_twin(figures, twin):
    held = twin.held_out
    widths = [bar.get_width() for bar in figures["held-out"].axes[0].patches]
    np.testing.assert_allclose(widths, [1e3 * one.tcp for one in (held.no_twin, held.healthy_twin, held.twin)])
    axes, (low, high) = figures["twin-stiffness"].axes[0], twin.interval
    known = twin.identified[:6]
    assert known.any()
    assert not known.all()
    order = [*np.flatnonzero(known), *np.flatnonzero(~known)]
    np.testing.assert_allclose(points(axes, across=False), twin.parameters.stiffness[order])
    np.testing.assert_allclose(whiskers(axes), np.stack([low.stiffness, high.stiffness], axis=1)[order])
    filled, hollow = (group[0].get_markerfacecolor() for group in error_bars(axes))
    assert filled != hollow
    assert hollow == "#ffffff"


def test_training_curves_are_those_of_the_file(figures):
    k = np.arange(1, 81)
    axes = figures["training"].axes
    expected = (1 - 3 * np.exp(-k / 15), 100 * (1 - np.exp(-k / 20)), 50 * np.exp(-k / 12) + 0.8)
    for one, values in zip(axes, expected, strict=True):
        np.testing.assert_allclose(one.lines[0].get_xdata(), 16384 * k / 1e6)
        np.testing.assert_allclose(one.lines[0].get_ydata(), values)


def test_paths_are_those_of_the_encoders_through_the_targets_of_the_log(figures, arm, comparison):
    targets = np.array(comparison.targets[0])
    for name in ("default", "policy"):
        above, side = figures[f"path-{name}"].axes
        tcp = 1e3 * tcp_position(arm, trial_log(arm, name, "crossing", targets).position)
        np.testing.assert_allclose(np.transpose(above.lines[0].get_data()), tcp[:, [1, 0]], atol=1e-9)
        np.testing.assert_allclose(np.transpose(side.lines[0].get_data()), tcp[:, [0, 2]], atol=1e-9)
        crosses = [line.get_data() for line in side.lines if line.get_marker() == "+"]
        np.testing.assert_allclose(np.squeeze(crosses), 1e3 * targets[:, [0, 2]])


def test_errors_over_time_are_medians_over_the_targets(figures, arm, comparison):
    targets, period = np.array(comparison.targets[0]), 0.04
    drawn = {line.get_label(): line for line in figures["error-over-time"].axes[0].lines}
    for name in SPEED:
        log = trial_log(arm, name, "hold", targets)
        error = 1e3 * np.linalg.norm(tcp_position(arm, log.position) - log.target, axis=1)
        each = len(log) // len(targets)
        for after in (0, 10, 100):  # control cycles; the first target was set when the first row was read
            rows = np.arange(len(targets)) * each + after - (np.arange(len(targets)) > 0)
            values = error[rows]
            if after == 0:  # what was last read before the target was set, against the new target
                values = 1e3 * np.linalg.norm(tcp_position(arm, log.position[rows]) - targets, axis=1)
            point = round(after * period / STEP)
            assert drawn[name].get_xdata()[point] == pytest.approx(after * period)
            assert drawn[name].get_ydata()[point] == pytest.approx(np.median(values))
