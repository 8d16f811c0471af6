"""A URDF of one unit: read back, its forward kinematics is that of the links as they are."""

from dataclasses import replace

import numpy as np
import pytest

from madetwin import displaced
from rejoint.arms import load_arm, tcp_pose
from rejoint.arms.loading import unit_arm, write_urdf
from rejoint.arms.rotations import roll_pitch_yaw, turned
from rejoint.arms.workspace import posture_grid


@pytest.mark.parametrize("name", ["mycobot280", "so101"])
def test_what_is_read_back_is_the_displaced_arm(tmp_path, name):
    arm, path = load_arm(name), tmp_path / "unit.urdf"
    zero = np.zeros(arm.joints)
    rigid = replace(displaced(arm, seed=0, offset=0.02), compliance=zero, play=zero)
    write_urdf(path, unit_arm(arm, rigid), note="of one unit -- only")
    back = load_arm(path)
    position = np.random.default_rng(1).uniform(arm.lower, arm.upper, (200, arm.joints))
    np.testing.assert_allclose(tcp_pose(back, position), rigid.tool_pose(arm, position), atol=1e-9)
    assert back.joint_names == arm.joint_names
    for field in ("lower", "upper", "max_speed", "mass", "com", "inertia"):
        np.testing.assert_allclose(getattr(back, field), getattr(arm, field), atol=1e-12)
    assert "<calibration" not in path.read_text()


def test_rigid_links_take_the_mean_of_play_and_flex():
    arm = load_arm("mycobot280")
    whole, position = displaced(arm, seed=0, offset=0.02), posture_grid(arm, 3).q
    rigid = whole.rigid(arm, position)
    assert not rigid.play.any()
    assert not rigid.compliance.any()
    np.testing.assert_allclose(rigid.joints(arm, position).mean(axis=0), whole.joints(arm, position).mean(axis=0))
    off = np.linalg.norm(rigid.tool(arm, position) - whole.tool(arm, position), axis=-1).mean()
    bare = replace(whole, play=np.zeros(6), compliance=np.zeros(6))
    assert off < 0.5 * np.linalg.norm(bare.tool(arm, position) - whole.tool(arm, position), axis=-1).mean()


@pytest.mark.parametrize("pitch", [0.0, 0.3, np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9])
def test_angles_give_their_rotation_also_where_two_axes_meet(pitch):
    axes = np.eye(3)

    def rotation(roll, pitch, yaw):
        return turned(yaw * axes[2]) @ turned(pitch * axes[1]) @ turned(roll * axes[0])

    wanted = rotation(0.7, pitch, -2.1)
    np.testing.assert_allclose(rotation(*roll_pitch_yaw(wanted)), wanted, atol=1e-15)
