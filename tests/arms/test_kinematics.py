"""Kinematics against finite differences and the paper's table; against MuJoCo with the arms of files."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from test_collision import each_arm

from rejoint.arms import (
    Arm,
    frames,
    gravity_torque,
    heights,
    jacobian,
    link_inertia,
    mycobot280,
    position_kinematics,
    tcp_pose,
    tcp_position,
)
from rejoint.arms.arm import dh_chain
from rejoint.twin.table import twin_spec
from rejoint_lab.research.reproduction.measures import DH_TABLE, PAPER_ANGLE_SHIFT, PAPER_DH_TABLE

ARM = mycobot280()


def random_postures(count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(ARM.lower, ARM.upper, (count, ARM.joints))


@pytest.mark.parametrize("shape", [(), (7,), (2, 3)])
def test_position_kinematics_are_those_of_the_frames(shape: tuple[int, ...]) -> None:
    q = np.random.default_rng(4).uniform(ARM.lower, ARM.upper, (*shape, 6))
    f = frames(ARM, q)
    tcp, found = position_kinematics(ARM, q)
    np.testing.assert_array_equal(tcp, f.tcp_position)
    columns = np.cross(f.axis, f.tcp_position[..., None, :] - f.position)
    np.testing.assert_allclose(found, np.swapaxes(columns, -1, -2), rtol=0.0, atol=1e-15)


def test_any_leading_shape_gives_the_same() -> None:
    q = random_postures(12).reshape(3, 4, 6)
    poses, torques, jacobians = tcp_pose(ARM, q), gravity_torque(ARM, q), jacobian(ARM, q)
    for i in np.ndindex(3, 4):
        np.testing.assert_allclose(poses[i], tcp_pose(ARM, q[i]), atol=1e-15)
        np.testing.assert_allclose(torques[i], gravity_torque(ARM, q[i]), atol=1e-15)
        np.testing.assert_allclose(jacobians[i], jacobian(ARM, q[i]), atol=1e-15)


def test_gravity_torque_is_the_gradient_of_the_potential() -> None:
    def potential(q: np.ndarray) -> float:
        f = frames(ARM, q)
        com = f.position + np.einsum("nij,nj->ni", f.rotation, ARM.com)
        return 9.81 * float(ARM.mass @ com[:, 2])

    for q in random_postures(10):
        steps = 1e-6 * np.eye(6)
        gradient = [(potential(q + s) - potential(q - s)) / 2e-6 for s in steps]
        np.testing.assert_allclose(gravity_torque(ARM, q), gradient, atol=1e-8)


def test_the_papers_table_is_the_same_mechanism() -> None:
    # the paper gives d1 and d5 as 131.2 and 74.1 mm, the vendor 131.22 and 75.05 mm
    rows = PAPER_DH_TABLE.copy()
    rows[[0, 4], 0] = DH_TABLE[[0, 4], 0]
    offset, axis, tip = dh_chain(rows)
    wide = {"lower": np.full(6, -10.0), "upper": np.full(6, 10.0)}
    paper = replace(ARM, offset=offset, axis=axis, tip=tip, **wide)
    q = random_postures(200)
    np.testing.assert_allclose(tcp_position(paper, q + PAPER_ANGLE_SHIFT), tcp_position(ARM, q), atol=1e-12)


def test_zero_posture_is_upright_at_the_vendors_height() -> None:
    np.testing.assert_allclose(tcp_position(ARM, np.zeros(6)), [0.0456, -0.0634, 0.41267], atol=1e-9)


@each_arm
def test_heights_are_those_of_the_frames(arm: Arm) -> None:
    q = np.random.default_rng(3).uniform(arm.lower, arm.upper, (4, 5, arm.joints))
    f = frames(arm, q)
    expected = np.concatenate([f.position[..., 2], f.tcp_position[..., 2:]], axis=-1)
    np.testing.assert_allclose(heights(arm, q), expected, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(heights(arm, q[0, 0]), expected[0, 0], rtol=0.0, atol=1e-14)


def test_link_inertia_is_the_mass_matrix_of_mujoco():
    model = twin_spec(ARM).compile()
    data, matrix = mujoco.MjData(model), np.zeros((ARM.joints, ARM.joints))
    data.qpos[:] = np.random.default_rng(7).uniform(-1.0, 1.0, ARM.joints)
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, matrix)
    expected = np.diag(matrix) - model.dof_armature
    np.testing.assert_allclose(link_inertia(ARM, data.qpos), expected, rtol=1e-9, atol=1e-12)
