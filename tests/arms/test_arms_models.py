"""Arms from URDF and MJCF files that other people wrote, against MuJoCo and against each other.

The files ship inside the packages robopal (MJCF of Panda and UR5e, both forms of a Diana), airo-models (URDF
of UR3e and UR5e) and ManipulaPy (URDF of arms of five more makers), which are installed with the development extra.
None is imported.
"""

from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np
import pytest

from modelfiles import packaged, without_workspace
from real_so101 import MODEL, NO_MODEL
from rejoint.arms import (
    Arm,
    gravity_torque,
    jacobian,
    read_arm,
    so101,
    solve_position,
    tcp_pose,
)
from rejoint.arms.arm import MODELS

ROBOPAL = "assets/models/manipulators"
FILES = {
    "panda": ("robopal", f"{ROBOPAL}/Panda/panda.xml", "link0", "attachment_site", 7),
    "ur5e-mjcf": ("robopal", f"{ROBOPAL}/UR5e/ur5e.xml", "base", "attachment_site", 6),
    "diana-mjcf": ("robopal", f"{ROBOPAL}/DianaMed/DianaMed.xml", "base_link", "attachment_site", 7),
    "diana-urdf": ("robopal", f"{ROBOPAL}/DianaMed/DianaMed.urdf", "base_link", "link7", 7),
    "ur5e-urdf": ("airo_models", "arms/ur5e/ur5e.urdf", "base_link", "tool0", 6),
    "ur3e-urdf": ("airo_models", "arms/ur3e/ur3e.urdf", "base_link", "tool0", 6),
}

# Another author's arms: seven joints, continuous ones, grippers with fingers of their own or coupled, a root called
# world, an inertia that belongs to no body, links without any.
DATA = "ManipulaPy_data"
MORE = {
    "ur10": ("ManipulaPy", f"{DATA}/universal_robots/ur10/ur10.urdf", "base_link", "tool0", 6),
    "crx10ia": ("ManipulaPy", f"{DATA}/fanuc_crx/crx10ia.urdf", "base_link", "flange", 6),
    "iiwa14": ("ManipulaPy", f"{DATA}/kuka_iiwa/iiwa14/iiwa14.urdf", "iiwa_link_0", "iiwa_link_ee", 7),
    "gen3": ("ManipulaPy", f"{DATA}/kinova/gen3/gen3.urdf", "base_link", "EndEffector_Link", 7),
    "jaco": ("ManipulaPy", f"{DATA}/kinova/jaco/jaco_6dof.urdf", "j2s6s300_link_base", "j2s6s300_end_effector", 6),
    "xarm6": ("ManipulaPy", f"{DATA}/xarm/xarm6_with_gripper.urdf", "link_base", "xarm_gripper_base_link", 6),
}


def file_of(name: str) -> Path:
    return packaged(*{**FILES, **MORE}[name][:2])


@lru_cache
def arm_of(name: str) -> Arm:
    return read_arm(str(file_of(name)), base=FILES[name][2], tip=FILES[name][3]).arm


def stripped_model(path: Path) -> mujoco.MjModel:
    """The whole file as MuJoCo compiles it, with its shapes removed since no mesh of a URDF can be found."""
    spec = mujoco.MjSpec.from_file(str(path))
    for body in spec.bodies:
        for geom in list(body.geoms):
            spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    for key in list(spec.keys):
        spec.delete(key)
    spec.compiler.fusestatic = False
    spec.compiler.balanceinertia = True
    return spec.compile()


def relative_tip(model: mujoco.MjModel, data: mujoco.MjData, base: str, tip: str) -> np.ndarray:
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, tip)
    place = data.body(tip) if body >= 0 else data.site(tip)
    turn = data.body(base).xmat.reshape(3, 3)
    pose = np.eye(4)
    pose[:3, :3] = turn.T @ place.xmat.reshape(3, 3)
    pose[:3, 3] = turn.T @ (place.xpos - data.body(base).xpos)
    return pose


@pytest.mark.parametrize("name", [*FILES, *MORE])
def test_kinematics_and_gravity_agree_with_mujoco_on_the_whole_file(name: str) -> None:
    file, (base, tip, joints) = file_of(name), {**FILES, **MORE}[name][2:]
    arm, model = arm_of(name) if name in FILES else without_workspace(file, base, tip), stripped_model(file)
    assert arm.joints == joints
    data = mujoco.MjData(model)
    for q in np.random.default_rng(1).uniform(arm.lower, arm.upper, (100, joints)):
        for joint, angle in zip(arm.joint_names, q, strict=True):
            data.joint(joint).qpos = angle
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(tcp_pose(arm, q), relative_tip(model, data, base, tip), atol=1e-9)
        held = [float(data.joint(joint).qfrc_bias[0]) for joint in arm.joint_names]
        np.testing.assert_allclose(gravity_torque(arm, q), held, atol=1e-8)


@pytest.mark.parametrize("name", FILES)
def test_jacobian_is_the_derivative_and_targets_are_reached(name: str) -> None:
    arm, step = arm_of(name), 1e-6
    q = np.random.default_rng(2).uniform(arm.lower, arm.upper, (10, arm.joints))
    for i in range(arm.joints):
        turn = step * np.eye(arm.joints)[i]
        numeric = (tcp_pose(arm, q + turn)[:, :3, 3] - tcp_pose(arm, q - turn)[:, :3, 3]) / (2 * step)
        np.testing.assert_allclose(jacobian(arm, q)[:, :3, i], numeric, atol=1e-8)
    targets = arm.targets.sample(np.random.default_rng(3), (300,))
    solution = solve_position(arm, targets, arm.rest)
    assert solution.converged.all()
    assert ((solution.q > arm.lower) & (solution.q < arm.upper)).all()


def test_two_authors_urdf_and_mjcf_of_one_mechanism_agree() -> None:
    urdf, mjcf = arm_of("diana-urdf"), arm_of("diana-mjcf")
    q = np.random.default_rng(4).uniform(mjcf.lower, mjcf.upper, (200, 7))
    # the MJCF gives six digits
    np.testing.assert_allclose(tcp_pose(urdf, q)[:, :3, 3], tcp_pose(mjcf, q)[:, :3, 3], atol=1e-5)
    np.testing.assert_allclose(urdf.mass, mjcf.mass, rtol=1e-5)
    np.testing.assert_allclose(gravity_torque(urdf, q), gravity_torque(mjcf, q), atol=2e-3)


@pytest.mark.skipif(not MODEL.exists(), reason=NO_MODEL)
def test_the_catalogues_so101_is_its_makers() -> None:
    ours, theirs = so101(), read_arm(str(MODEL), base="base", tip="gripperframe").arm
    assert ours.joint_names == theirs.joint_names
    q = np.random.default_rng(6).uniform(ours.lower, ours.upper, (200, 5))
    np.testing.assert_allclose(tcp_pose(ours, q), tcp_pose(theirs, q), atol=1e-12)
    np.testing.assert_allclose(gravity_torque(ours, q), gravity_torque(theirs, q), atol=1e-9)
    for field in ("lower", "upper", "mass", "com"):
        np.testing.assert_allclose(getattr(ours, field), getattr(theirs, field), atol=1e-12, err_msg=field)
    np.testing.assert_allclose(ours.inertia, theirs.inertia, atol=1e-10)


@pytest.mark.parametrize(
    ("name", "place", "kg"),
    [
        ("koch", (0.21508, -0.005947, 0.1678), 0.226),  # the sums of the bodies of MuJoCo Menagerie
        ("wx250s", (0.458325, 0.0, 0.36065), 1.6),  # Interbotix' kinematics, and their masses without the base
        ("vx300s", (0.536494, 0.0, 0.42705), 2.8),
        ("omx", (0.286, 0.0, 0.2045), 0.51),  # ROBOTIS' kinematics
    ],
)
def test_the_catalogues_dynamixel_arms_are_their_makers(name: str, place: tuple[float, ...], kg: float) -> None:
    loaded = read_arm(MODELS / f"{name}.toml")
    assert loaded.notes == ()
    np.testing.assert_allclose(tcp_pose(loaded.arm, np.zeros(loaded.arm.joints))[:3, 3], place, atol=2e-4)
    assert loaded.arm.mass.sum() == pytest.approx(kg, rel=0.02)
    assert all(loaded.arm.servos)
