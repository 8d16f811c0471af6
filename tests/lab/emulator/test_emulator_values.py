"""Numbers on the wire: scales, truncation as the real firmware does it, Euler angles."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rejoint.arms import mycobot280, tcp_pose
from rejoint.arms.rotations import to_coords, to_pose
from rejoint.robots.mycobot import wire as values

ARM = mycobot280()
STEP = ARM.encoder_step


@pytest.mark.parametrize(("steps", "hundredths"), [(1, 8), (2, 17), (168, 1476), (-1, -8), (512, 4500), (-1024, -9000)])
def test_angles_are_truncated_as_in_the_log_of_a_real_arm(steps, hundredths):
    assert values.pack_angles(np.array([steps * STEP])) == hundredths.to_bytes(2, "big", signed=True)


def test_the_zero_pose_is_the_one_of_the_vendors_table():
    # upright: flange at (45.6, -63.4, 412.67 mm by the DH table), in tenths 456, -634, 4126
    packed = values.pack_coords(tcp_pose(ARM, np.zeros(6)))
    assert packed[:6] == bytes.fromhex("01C8 FD86 101E")


def test_numbers_too_large_for_the_wire_saturate():
    assert values.pack_int16([1e9, -1e9]) == bytes.fromhex("7FFF 8000")
    assert values.pack_bytes([300, -5, 12.9]) == bytes([255, 0, 12])


angles = st.floats(-3.1, 3.1)


@given(angles, st.floats(-1.5, 1.5), angles)
def test_euler_angles_are_zyx_and_invert(rx, ry, rz):
    coords = np.array([0.1, -0.2, 0.3, rx, ry, rz])
    pose = to_pose(coords)
    by_hand = Rotation.from_euler("xyz", [rx, ry, rz]).as_matrix()
    np.testing.assert_allclose(pose[:3, :3], by_hand, atol=1e-12)
    np.testing.assert_allclose(to_coords(pose), coords, atol=1e-9)


@given(angles, st.sampled_from([-np.pi / 2, np.pi / 2]), angles)
def test_euler_angles_at_the_singularity_give_the_same_rotation(rx, ry, rz):
    pose = to_pose(np.array([0, 0, 0, rx, ry, rz]))
    np.testing.assert_allclose(to_pose(to_coords(pose)), pose, atol=1e-6)
