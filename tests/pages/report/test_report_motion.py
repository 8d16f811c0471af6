"""Splitting logs into visits: hand-worked times and errors."""

from dataclasses import replace

import numpy as np
import pytest

from rejoint.arms import load_arm, tcp_position
from rejoint.logs.runlog import RunLog
from rejoint.pages.report.figures import encoder_path, visits


@pytest.fixture(scope="module")
def arm():
    return load_arm("mycobot280")


def log_of(arm, target, period=0.5):
    rows = len(target)
    position = arm.rest + 0.01 * np.arange(rows)[:, None]
    return RunLog.of(10 + period * np.arange(rows), position, position, arm=arm, label="hold", target=target)


def test_a_visit_starts_with_the_last_row_of_the_one_before(arm):
    a, b = np.array([0.15, 0.0, 0.2]), np.array([0.2, 0.05, 0.2])
    log = log_of(arm, np.array([a, a, a, b, b]))
    first, second = visits(arm, log)
    np.testing.assert_array_equal(first.time, [0, 0.5, 1.0])
    np.testing.assert_array_equal(second.time, [0, 0.5, 1.0])
    tcp = tcp_position(arm, log.position)
    np.testing.assert_allclose(first.encoder_error, np.linalg.norm(tcp[:3] - a, axis=1))
    np.testing.assert_allclose(second.encoder_error, np.linalg.norm(tcp[2:] - b, axis=1))
    assert np.isnan(first.true_error).all()
    np.testing.assert_array_equal(encoder_path(arm, log), tcp)


def test_encoders_are_judged_by_where_they_were_to_stand(arm):
    a, b, beside = np.array([0.15, 0.0, 0.2]), np.array([0.15, 0.02, 0.2]), np.array([0.0, 0.0, 0.007])
    log = log_of(arm, np.array([a, a, b, b, b]))
    again = np.array([a + beside, a + beside, b + beside, b + beside, b - beside])  # aimed once more at the end
    _, second = visits(arm, replace(log, aim=again))
    tcp = tcp_position(arm, log.position)
    np.testing.assert_allclose(second.aim, b - beside)
    np.testing.assert_allclose(second.encoder_error[0], np.linalg.norm(tcp[1] - b - beside))
    np.testing.assert_allclose(second.encoder_error[-1], np.linalg.norm(tcp[4] - b + beside))
    np.testing.assert_allclose(second.target, b)


def test_rows_without_a_target_belong_to_no_visit(arm):
    nothing, a = np.full(3, np.nan), np.array([0.15, 0.0, 0.2])
    found = visits(arm, log_of(arm, np.array([nothing, nothing, a, a, nothing])))
    assert len(found) == 1
    np.testing.assert_array_equal(found[0].target, a)
    assert visits(arm, log_of(arm, np.full((3, 3), np.nan))) == ()
