"""What a comparison drives besides its controllers: the arm as it was found."""

from dataclasses import replace

import numpy as np
import pytest
from report_samples import make_calibration

import rejoint
from rejoint.arms import mycobot280
from rejoint.control.comparison.result import Protocol

SHORT = Protocol(dwell=1.0, hold=1.0, window=0.3)


def compared(controller, targets, **given):
    plan = rejoint.TrialPlan(repetitions=1, protocol=SHORT)
    return rejoint.compare("emulated:worn", [controller], targets, plan=plan, **given)


@pytest.mark.parametrize("used", [True, False])
def test_an_aimed_comparison_tells_how_the_arm_was_found(used):
    arm = mycobot280()
    targets = arm.targets.sample(np.random.default_rng(0), (1, 2))
    calibration = replace(make_calibration(arm)[0], used=used)
    found = compared("default", targets, settings=rejoint.Settings(calibration=calibration)).comparison
    assert (found.as_found is not None) is used
    if used:
        aimed = found.array("settled_true", "default").ravel()
        told = compared("default", targets).comparison.array("settled_true", "default").ravel()
        as_found = [error.value for error in found.as_found.true]
        np.testing.assert_allclose(as_found, told, rtol=1e-9, err_msg="the same drive, from the same start")
        assert (np.abs(aimed - as_found) > 1e-4).all()
