"""What servos that tell their load say of a joint's torques, before any motion is looked at."""

from dataclasses import replace

import numpy as np
import pytest

from rejoint.arms import load_arm
from rejoint.logs.runlog import RunLog
from rejoint.twin.identify import prior_by_loads
from rejoint.twin.parameters import Layout

ARM = load_arm("so101")
SLOPE = np.array([5.2, 5.2, 6.0, 5.2, 7.8])
"""[1/rad] share of each servo's largest torque per radian of error"""
LAYOUT = Layout(ARM.joints)
LIMIT, STIFFNESS = LAYOUT.at("torque_limit"), LAYOUT.at("stiffness")


def standing(loaded=True):
    """A log of an arm that stands in many places, away from its commands, and tells its loads with some noise."""
    rng = np.random.default_rng(4)
    lead = np.repeat(rng.uniform(-0.08, 0.08, (24, ARM.joints)), 60, axis=0)
    position = np.repeat(ARM.rest + rng.uniform(-0.3, 0.3, (24, ARM.joints)), 60, axis=0)
    time = 0.02 * np.arange(len(lead))
    log = RunLog.of(time, position + lead, position, arm=ARM)
    noisy = SLOPE * lead + rng.normal(0.0, 0.002, lead.shape)
    return replace(log, servo_load=noisy) if loaded else log


def conditioned(belief, place, value):
    """Mean and standard deviations of what is believed once one element is known."""
    covariance = np.linalg.inv(belief.precision)
    share = covariance[:, place] / covariance[place, place]
    mean = belief.mean + share * (value - belief.mean[place])
    return mean, np.sqrt(np.maximum(np.diag(covariance) - share * covariance[place], 0.0))


def test_stiffness_over_largest_torque_is_the_line_of_the_loads():
    belief = prior_by_loads(ARM, [standing()])
    covariance = np.linalg.inv(belief.precision)
    ratio = belief.mean[STIFFNESS] - belief.mean[LIMIT]
    np.testing.assert_allclose(np.exp(ratio), SLOPE, rtol=0.05)
    for joint in range(ARM.joints):
        row = np.zeros(LAYOUT.size)
        row[STIFFNESS.start + joint], row[LIMIT.start + joint] = 1.0, -1.0
        assert np.sqrt(row @ covariance @ row) < 0.15
    assert (np.sqrt(np.diag(covariance))[LIMIT] > 0.5).all()  # no load tells a torque in N m


def test_what_the_weight_tells_of_one_joint_holds_for_the_others():
    """An elbow that is known to be twice as stiff makes the pan, which no weight loads, twice as stiff too."""
    belief = prior_by_loads(ARM, [standing()])
    elbow, pan = STIFFNESS.start + 2, STIFFNESS.start
    mean, sigma = conditioned(belief, elbow, belief.mean[elbow] + np.log(2.0))
    assert mean[pan] - belief.mean[pan] == pytest.approx(np.log(2.0), abs=0.15)
    assert sigma[pan] < 0.6 * belief.sigma[pan]
    of_arm = LAYOUT.at("delay")
    np.testing.assert_allclose(mean[of_arm], belief.mean[of_arm])


def test_without_loads_or_without_servos_of_one_type_nothing_is_told():
    assert prior_by_loads(ARM, [standing(loaded=False)]) is None
    assert prior_by_loads(replace(ARM, servos=()), [standing()]) is None
    assert prior_by_loads(replace(ARM, servos=tuple("abcde")), [standing()]) is None
