"""The size of an arm is a ratio of like to like."""

import dataclasses

import numpy as np
import pytest

from rejoint.arms import mycobot280, so101
from rejoint.arms.workspace import length_size, moves_tool, torque_size, unloaded_joints

ARM = mycobot280()


def test_the_mycobot_is_the_measure():
    assert (torque_size(mycobot280()), length_size(mycobot280())) == (1.0, 1.0)


def test_load_goes_with_mass_and_length_and_reach_with_length_alone():
    heavy = dataclasses.replace(ARM, mass=4.0 * ARM.mass)
    assert torque_size(heavy) == pytest.approx(4.0)
    assert length_size(heavy) == 1.0
    offset, tip = ARM.offset.copy(), ARM.tip.copy()
    offset[:, :3, 3] *= 2.0
    tip[:3, 3] *= 2.0
    long = dataclasses.replace(
        ARM,
        offset=offset,
        tip=tip,
        com=2.0 * ARM.com,
        targets=dataclasses.replace(ARM.targets, lower=2.0 * ARM.targets.lower, upper=2.0 * ARM.targets.upper),
    )
    assert length_size(long) == pytest.approx(2.0)
    assert torque_size(long) == pytest.approx(2.0, rel=1e-3)


def test_bases_and_wrist_rolls_carry_no_weight():
    np.testing.assert_array_equal(unloaded_joints(ARM), [True, False, False, False, True, True])
    np.testing.assert_array_equal(unloaded_joints(so101()), [True, False, False, False, True])


@pytest.mark.parametrize("arm", [ARM, so101()], ids=lambda arm: arm.name)
def test_the_last_joint_of_an_arm_only_turns_its_tool(arm):
    np.testing.assert_array_equal(moves_tool(arm), np.arange(arm.joints) < arm.joints - 1)
