"""Splitting logs into visits: hand-worked times and errors."""

from dataclasses import replace

import numpy as np
import pytest

from rejoint.arms import load_arm, tcp_position
from rejoint.logs.runlog import RunLog
from rejoint.pages.report.figures import spread_over_time, visits


@pytest.fixture(scope="module")
def arm():
    return load_arm("mycobot280")


def log_of(arm, target):
    rows = len(target)
    position = arm.rest + 0.01 * np.arange(rows)[:, None]
    return RunLog.of(10 + 0.5 * np.arange(rows), position, position, arm=arm, label="hold", target=target)


def test_a_visit_starts_with_the_last_row_of_the_one_before(arm):
    a, b = np.array([0.15, 0.0, 0.2]), np.array([0.2, 0.05, 0.2])
    log = log_of(arm, np.array([a, a, a, b, b]))
    first, second = visits(arm, log)
    np.testing.assert_array_equal(first[0], [0, 0.5, 1.0])
    np.testing.assert_array_equal(second[0], [0, 0.5, 1.0])
    tcp = tcp_position(arm, log.position)
    np.testing.assert_allclose(first[1], np.linalg.norm(tcp[:3] - a, axis=1))
    np.testing.assert_allclose(second[1], np.linalg.norm(tcp[2:] - b, axis=1))


def test_encoders_are_judged_by_where_they_were_to_stand(arm):
    a, b, beside = np.array([0.15, 0.0, 0.2]), np.array([0.15, 0.02, 0.2]), np.array([0.0, 0.0, 0.007])
    log = log_of(arm, np.array([a, a, b, b, b]))
    again = np.array([a + beside, a + beside, b + beside, b + beside, b - beside])  # aimed once more at the end
    _, (_, error) = visits(arm, replace(log, aim=again))
    tcp = tcp_position(arm, log.position)
    np.testing.assert_allclose(error[0], np.linalg.norm(tcp[1] - b - beside))
    np.testing.assert_allclose(error[-1], np.linalg.norm(tcp[4] - b + beside))


def test_rows_without_a_target_belong_to_no_visit(arm):
    nothing, a = np.full(3, np.nan), np.array([0.15, 0.0, 0.2])
    assert len(list(visits(arm, log_of(arm, np.array([nothing, nothing, a, a, nothing]))))) == 1
    assert not list(visits(arm, log_of(arm, np.full((3, 3), np.nan))))


def test_the_spread_is_of_what_was_last_read_and_ends_with_half_of_the_visits():
    time, long = np.array([0.0, 1.0]), np.array([0.0, 1.0, 2.0, 3.0])
    found = [(time, np.array([4.0, 2.0])), (time, np.array([4.0, 2.0])), (long, np.array([4.0, 3.0, 2.0, 1.0]))]
    middle, low, high = spread_over_time(found, np.array([0.0, 0.9, 1.0, 2.5]))
    np.testing.assert_allclose(middle[:3], [4.0, 4.0, 2.0])
    assert np.isnan(middle[3])
    assert low[2] < high[2]
