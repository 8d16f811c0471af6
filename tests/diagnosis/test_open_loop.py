"""Errors of ten targets, worked by hand on a log that is made up."""

import dataclasses

import numpy as np
import pytest

from rejoint.arms import mycobot280, tcp_position
from rejoint.diagnosis.segments import open_loop_errors, settled_rows
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError

ARM = mycobot280()
OFFSETS = np.array([[0.003, 0.0, 0.004], [0.0, 0.0, 0.010], [0.0, -0.006, 0.008]])
"""[m] target minus settled TCP: 5, 10 and 10 mm; 4, 10 and 8 mm of it too low"""


def made_up():
    """Three targets for 2 s each; the arm is elsewhere for the first second of each."""
    time = np.arange(0.0, 6.0, 0.05)
    settled = time % 2.0 >= 0.9
    position = np.where(settled[:, None], ARM.rest, ARM.rest + 0.3)
    tcp = tcp_position(ARM, ARM.rest)
    target = tcp + OFFSETS[(time // 2.0).astype(int)]
    true = np.where(settled[:, None], tcp + np.array([0.0, 0.002, 0.0]), tcp + 0.1)
    return RunLog.of(time, position, position, arm=ARM, label="targets", target=target, true_tcp=true)


def test_only_the_last_second_of_each_target_counts():
    log = made_up()
    for index, rows in enumerate(settled_rows(log)):
        assert log.time[rows[0]] >= 2 * index + 0.9
        assert log.time[rows[-1]] == pytest.approx(2 * index + 1.95)


def test_errors_by_hand():
    found = open_loop_errors(ARM, made_up())
    assert [t.error_mm for t in found.targets] == pytest.approx([5.0, 10.0, 10.0])
    assert found.error_mm.value == pytest.approx(25 / 3)
    assert found.spread_mm == pytest.approx(np.std([5, 10, 10], ddof=1))
    # the tool is 2 mm aside in y: sqrt(9 + 4 + 16), sqrt(4 + 100), sqrt(64 + 64)
    assert [t.true_error_mm for t in found.targets] == pytest.approx([29**0.5, 104**0.5, 128**0.5])


def test_nobody_knows_the_tool():
    log = made_up()
    found = open_loop_errors(ARM, dataclasses.replace(log, true_tcp=np.full_like(log.true_tcp, np.nan)))
    assert found.true_error_mm is None
    assert all(t.true_error_mm is None for t in found.targets)


def test_a_log_without_targets_is_refused():
    log = made_up()
    with pytest.raises(InputError, match="no targets"):
        open_loop_errors(ARM, dataclasses.replace(log, target=np.full_like(log.target, np.nan)))
