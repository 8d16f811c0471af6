"""Worn arms that are not a myCobot: the default misses, and what integrates brings them to their targets."""

import numpy as np
import pytest

from modelfiles import ur5e
from rejoint.arms import so101
from rejoint.control.comparison.compare import Settings, TrialRunner
from rejoint.control.comparison.result import Protocol
from rejoint.control.controllers.catalogue import make_controller
from rejoint.control.targets import draw_targets
from rejoint.robots import open_robot
from rejoint.twin.parameters import nominal_parameters


@pytest.mark.parametrize(
    ("make", "address"), [(so101, "emulated:worn"), (so101, "emulated:so101"), (ur5e, "emulated:worn")]
)
def test_a_worn_arm_of_any_size_is_brought_within_10_mm(make, address):
    arm = make()
    stiffness = nominal_parameters(arm).stiffness
    found = TrialRunner(
        lambda count, seed: open_robot(address, arm=arm, seed=seed, count=count),
        {
            name: lambda arm, name=name: make_controller(name, arm, stiffness=stiffness)
            for name in ("default", "integrator", "feedforward")
        },
        draw_targets(arm, sets=1, count=4, seed=2),
        Settings(batched=True, seed=2, protocol=Protocol(dwell=6.0, hold=5.0)),
    ).compare()
    rows = {row.controller: row for row in found.rows}
    assert rows["default"].settled.mean.value > 0.015
    for name in ("integrator", "feedforward"):
        assert rows[name].success.value == 1.0, name
        assert rows[name].failures == 0
        assert rows[name].settled.mean.value < 0.005, name
        assert rows[name].oscillation.mean.value < 0.003, name
        assert np.isfinite(rows[name].settled_true.mean.value)
