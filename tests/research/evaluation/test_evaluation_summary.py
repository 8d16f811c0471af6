"""From outcomes to rows: every number worked by hand."""

import numpy as np
import pytest
from evaluation_samples import outcome

from rejoint_lab.research.evaluation.evaluate import outside, together
from rejoint_lab.research.evaluation.family import ArmFamily


def test_a_row_counts_what_it_says():
    settled = np.array([[0.2, 0.4], [0.3, 6.0], [np.nan, 0.5]])
    found = outcome(
        settled,
        np.array([[1.0, 2.0], [3.0, np.inf], [np.nan, 4.0]]),
        oscillation=np.array([[1e-4, 3e-4], [1e-4, 1e-4], [np.nan, 1e-4]]),
        crossed=np.array([[1.0, 1.0], [0.0, 1.0], [1.0, 0.0]]),
        crossing_error=np.array([[9e-3, 8e-3], [20e-3, 9e-3], [8e-3, 12e-3]]),
        crossing_time=np.array([[1.0, 2.0], [20.0, 2.0], [1.0, 20.0]]),
    )
    compared = together({"x": [found]}, np.zeros((3, 2, 3)), ArmFamily(arms=3))
    row = compared.row("x")
    assert compared.repetitions == 1
    assert row.settled.mean.value == pytest.approx(7.4e-3 / 5)
    assert row.settled.p95 == pytest.approx(np.quantile([0.2, 0.4, 0.3, 6.0, 0.5], 0.95) / 1e3)
    assert row.settled_true.mean.value == pytest.approx((7.4 / 5 + 7.0) / 1e3)
    assert row.settled_true.p95 == pytest.approx(row.settled.p95 + 7e-3)
    assert row.oscillation.mean.value == pytest.approx(7e-4 / 5)
    assert outside(compared, "x").mean() == pytest.approx(2 / 6)  # 6 mm, and the one that the guard stopped
    assert [one.within for one in row.stays] == [0.010, 0.005, 0.002]
    assert row.stays[-1].share.value == pytest.approx(4 / 6)
    assert row.stays[-1].median == pytest.approx(3.5)
    assert row.success.value == pytest.approx(4 / 6)
    assert row.crossing_error.mean.value == pytest.approx(66e-3 / 6)
    assert row.cycle_time.mean.value == pytest.approx((3.0 + 22.0 + 21.0) / 3)
