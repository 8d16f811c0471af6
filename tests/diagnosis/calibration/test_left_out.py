"""What a calibration keeps and tells of single points, and what would press floating joints to one side."""

from dataclasses import replace

import numpy as np
import pytest

from madetwin import made_calibration
from rejoint.arms import Displacement, gravity_torque, load_arm, mycobot280, tcp_position
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.rotations import turned
from rejoint.arms.workspace import posture_grid
from rejoint.diagnosis.calibration.calibration import (
    WEDGE,
    DisplacementLayout,
    preload,
)
from rejoint.diagnosis.calibration.fit import fit
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.procedure import suggest

ARM = mycobot280()


def calibration(sigma=1e-9, arm=ARM, **values):
    found = replace(Displacement.none(arm), **{name: np.asarray(value) for name, value in values.items()})
    return made_calibration(
        arm,
        found,
        covariance=sigma**2 * np.eye(DisplacementLayout(arm).body),
        floor=max(sigma, 1e-9),
        left_out=np.array([[2e-3, 1e-3]] * 4),
    )


def test_a_mean_error_lies_in_its_interval_and_grows_with_what_is_open():
    position, sharp, open_ = posture_grid(ARM, 3).q, calibration(offset=np.full(6, 0.01)), calibration(1e-3)
    mean, low, high = open_.distance(position)
    assert ((low < mean) & (mean < high)).all()
    away = np.linalg.norm(sharp.tool(position) - tcp_position(ARM, position), axis=-1)
    np.testing.assert_allclose(sharp.distance(position)[0], away, atol=1e-7)
    assert (mean > 1e-3).all()


def test_a_joint_that_may_lie_on_either_flank_stays_in_its_play():
    """Draws of how askew the base stands tell where the tool may be; a slope at the reversal said 30 mm."""
    doubt, lean = np.radians(2.0), np.array([np.sin(np.radians(3.0)), 0.0, -np.cos(np.radians(3.0))])
    own = calibration(play=[0.015, 0, 0, 0, 0, 0], gravity=9.81 * lean)
    covariance = np.zeros_like(own.covariance)
    tilt = own.layout.at("tilt")
    covariance[tilt, tilt] = doubt**2 * np.eye(2)
    own = replace(own, covariance=covariance)
    postures = np.repeat(ARM.rest[None], 41, axis=0)
    postures[:, 0] = np.radians(np.linspace(-20.0, 20.0, 41))  # gravity presses the base joint to either side

    vector = own.layout.vector(own.displacement)
    drawn = np.repeat(vector[None], 400, axis=0)
    drawn[:, tilt] += doubt * np.random.default_rng(0).standard_normal((400, 2))
    tools = np.stack([own.layout.displacement(one).tool(ARM, postures) for one in drawn])
    seen = np.sqrt(((tools - own.tool(postures)) ** 2).sum(axis=-1).mean(axis=0))
    known = np.sqrt(np.trace(own.spread(postures), axis1=-2, axis2=-1))
    np.testing.assert_allclose(known, seen, rtol=0.15, atol=2e-4)


@pytest.mark.parametrize("name", ["mycobot280", "so101"])
def test_a_wedge_presses_a_base_joint(name):
    arm = load_arm(name)
    own = calibration(1e-4, arm, play=0.03 * np.eye(arm.joints)[0])
    what = preload(own, posture_grid(arm, 3).q)
    assert what.joints == arm.joint_names[:1]
    assert what.wedge < 0.5 * what.chance


def test_the_side_to_raise_is_across_the_arm_and_no_joint_floats_where_the_base_leans():
    position = ARM.rest + np.radians([[90.0, 0, 0, 0, 0, 0]])  # it points along y
    own = calibration(1e-4, play=0.03 * np.eye(6)[0])
    assert preload(own, position).side in ("-x", "+x")
    own = replace(own, displacement=replace(own.displacement, gravity=turned(WEDGE * np.eye(3)[0]) @ GRAVITY))
    assert preload(own, posture_grid(ARM, 3).q).joints == ()


@pytest.mark.parametrize("name", ["mycobot280", "so101"])
def test_no_joint_rests_on_either_flank_where_it_is_to_be_measured(name):
    """A load whose sign changes within the play leaves the side to chance: such a point once read as a tilted base."""
    arm = load_arm(name)
    around = [suggest(arm, 20, visits=2).postures + side for side in np.radians([-0.6, 0.6])]
    loads = np.array([gravity_torque(arm, q) for q in around])
    assert not ((loads.min(axis=0) < -2e-3) & (loads.max(axis=0) > 2e-3)).any()


def test_a_slip_at_one_point_of_ten_does_not_condemn_the_others():
    """A decimal point in the wrong place had all ten refused as points of another frame."""
    position = suggest(ARM, 10).postures
    worn = replace(Displacement.none(ARM), compliance=np.full(6, 0.02), play=np.full(6, 0.02))
    point = worn.tool(ARM, position) + np.random.default_rng(0).normal(0.0, 5e-4, (10, 3))
    point[3, 0] *= 10.0
    found = fit(ARM, Measurements(position=position, sigma=np.full(10, 5e-4), point=point, posture=np.arange(10)))
    assert found.suspects == (3,)
    assert found.used
