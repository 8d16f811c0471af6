"""Calibrations on emulated arms: who stands askew falls to one side, and measured arms come nearer to their targets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rejoint.arms import mycobot280, tcp_position
from rejoint.control.integrator import IntegratorController
from rejoint.research.evaluation import calibrating
from rejoint.research.evaluation.calibrated import conclude, tables
from rejoint.research.evaluation.calibrating import find_condition, misdescribed, open_condition, try_condition
from rejoint.research.evaluation.family import ArmFamily
from rejoint.system.errors import InputError

ARM, FEW = mycobot280(), ArmFamily(arms=2, targets=1, seed=3)


def test_a_base_that_stands_askew_loads_the_base_joint() -> None:
    upright = open_condition(ARM, find_condition("worn"), FEW, 1).plant
    askew = open_condition(ARM, find_condition("askew"), FEW, 1).plant
    assert np.abs(upright.torque[:, 0]).max() < 1e-6 < 0.02 < np.abs(askew.torque[:, 0]).min()


def test_misdescribed_arms_are_elsewhere_than_their_description_says() -> None:
    condition = find_condition("misdescribed")
    plant = open_condition(ARM, condition, FEW, 1).plant
    for i in range(FEW.arms):
        own = misdescribed(ARM, condition, FEW.wear_seed(i))
        assert np.allclose(plant.true_tcp()[i], tcp_position(own, plant.link_position()[i]), atol=1e-12)
        assert np.allclose(np.abs(own.mass / ARM.mass - 1.0), 0.15)
    before = plant.link_position()
    plant.advance(0.2)
    assert np.abs(plant.link_position() - before).max() < np.radians(0.3)  # in balance under its own masses
    right = replace(condition, mass=0.0, shift=0.0, turn=0.0)
    assert np.allclose(misdescribed(ARM, right, 1).offset, ARM.offset)


def test_measured_arms_come_nearer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibrating, "POINTS", (5,))
    monkeypatch.setattr(calibrating, "HOLD", 5.0)
    monkeypatch.setattr(calibrating, "WRONG_AMONG", 5)
    found = try_condition(ARM, find_condition("worn"), IntegratorController, FEW, 1, lambda share, text: None)  # noqa: ARG005
    assert np.nanmean(found.before) > 4e-3 > 2.5e-3 > np.nanmean(found.tried[0].error)
    result = conclude("mycobot280", "test", "integrator", FEW, [found])
    assert [row.points for row in result.rows] == [0, 5]
    assert all(len(row) == len(headers) for _, headers, rows in tables(result) for row in rows)


def test_an_unknown_condition_names_the_others() -> None:
    with pytest.raises(InputError, match="askew"):
        find_condition("broken")
