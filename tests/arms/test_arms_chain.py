"""Cutting a chain out of a model: what is kept, what is frozen, what is refused."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import mujoco
import numpy as np

from modelfiles import without_workspace
from rejoint.arms import (
    gravity_torque,
    jacobian,
    tcp_pose,
)
from rejoint.arms.inertia import pseudo_inertia, rigid_body
from rejoint.arms.modelfile import cut, read_tree

# Anchors off the body's origin, mixed axes, a joint reference, two joints on one body, a branch whose
# reference lies outside of its limits, and a gripper.
AWKWARD = """<mujoco model="awkward"><compiler angle="radian" autolimits="true"/>
<asset><mesh name="hull" vertex="0 0 0 0.1 0 0 0 0.1 0 0 0 0.1"/><texture name="t" type="2d" file="nowhere.png"/>
<material name="m" texture="t"/></asset>
<worldbody><body name="table" pos="1 2 0.7" euler="0 0 0.4">
 <body name="a" pos="0 0 0.2"><joint name="j1" axis="0 0.6 0.8" pos="0.01 0.02 0.03" range="-2 2"/>
  <geom type="box" size="0.05 0.04 0.1" material="m"/><geom type="mesh" mesh="hull" contype="0" mass="0.2"/>
  <body name="lamp" pos="0.1 0 0"><joint name="swing" axis="0 1 0" range="0.3 0.9"/>
   <geom type="sphere" size="0.03" pos="0 0 0.1"/></body>
  <body name="b" pos="0.1 0 0.3" euler="0.3 0.2 0.1"><joint name="j2" axis="1 0 0" ref="0.5" range="-2 2"/>
   <joint name="j3" axis="0 1 0.2" pos="0 0 0.05" range="-2 2"/>
   <geom type="capsule" size="0.03 0.1" pos="0 0 0.1"/>
   <body name="c" pos="0 0.05 0.3" gravcomp="1"><joint name="j4" axis="0 1 0" range="-2 2" stiffness="3"/>
    <inertial pos="0 0 0.1" mass="0.7" diaginertia="0.002 0.002 0.001"/>
    <body name="d" pos="0 0 0.25"><joint name="j5" axis="-1 0 1" range="-2 2"/>
     <geom type="cylinder" size="0.02 0.05" pos="0 0 0.05"/><site name="tcp" pos="0.01 0.02 0.15" euler="0.1 0.7 0"/>
     <body name="left"><joint name="l" type="slide" axis="0 1 0" range="0.01 0.04"/>
      <geom type="box" size="0.01 0.01 0.03" pos="0 0.02 0.1"/></body>
     <body name="right"><joint name="r" type="slide" axis="0 -1 0" range="0.01 0.04"/>
      <geom type="box" size="0.01 0.01 0.03" pos="0 -0.02 0.1"/></body>
</body></body></body></body></body></worldbody>
<equality><joint joint1="l" joint2="r"/></equality>
<actuator><motor joint="j1"/></actuator>
<keyframe><key qpos="0 0 0 0 0 0 0 0"/></keyframe></mujoco>"""


close = partial(np.testing.assert_allclose, atol=1e-12)


def written(folder: Path, text: str) -> Path:
    path = folder / "arm.xml"
    path.write_text(text)
    return path


def test_an_awkward_chain_agrees_with_mujoco(tmp_path: Path) -> None:
    arm = without_workspace(written(tmp_path, AWKWARD), None, "tcp")
    assert arm.joint_names == ("j1", "j2", "j3", "j4", "j5")
    assert cut(read_tree(tmp_path / "arm.xml"), None, "tcp").notes[-1].startswith("springs, gravcomp in the file")
    spec = mujoco.MjSpec.from_string(AWKWARD)
    for geom in spec.geoms:
        geom.material = ""
    for element in [*spec.materials, *spec.textures, *spec.keys]:
        spec.delete(element)
    model = spec.compile()
    data = mujoco.MjData(model)
    jacobians = np.empty((2, 3, model.nv))
    chain = [model.joint(name).dofadr[0] for name in arm.joint_names]
    for q in np.random.default_rng(0).uniform(arm.lower, arm.upper, (100, 5)):
        data.joint("swing").qpos = 0.3  # its reference, 0, is outside of its limits
        data.joint("l").qpos = data.joint("r").qpos = 0.01
        for name, angle in zip(arm.joint_names, q, strict=True):
            data.joint(name).qpos = angle
        mujoco.mj_forward(model, data)
        mujoco.mj_jacSite(model, data, jacobians[0], jacobians[1], model.site("tcp").id)
        turn = data.body("table").xmat.reshape(3, 3)
        expected = turn.T @ (data.site("tcp").xpos - data.body("table").xpos)
        close(tcp_pose(arm, q)[:3, 3], expected)
        close(tcp_pose(arm, q)[:3, :3], turn.T @ data.site("tcp").xmat.reshape(3, 3))
        close(jacobian(arm, q), np.vstack(turn.T @ jacobians)[:, chain])
        # the link between the two joints of one body has no mass of its own and gets a small one
        bare = replace(arm, mass=np.where(np.arange(5) == 1, 0.0, arm.mass))
        np.testing.assert_allclose(gravity_torque(bare, q), data.qfrc_bias[chain], atol=1e-9)


def test_lumping_two_balls_by_hand() -> None:
    # 1 kg at x = 0 and 3 kg at x = 4: centre at 3, 1*9 + 3*1 = 12 kg m^2 across, nothing along
    whole = sum(pseudo_inertia(m, [x, 0.0, 0.0], np.zeros((3, 3))) for m, x in ((1.0, 0.0), (3.0, 4.0)))
    mass, com, inertia = rigid_body(whole)
    assert mass == 4.0
    np.testing.assert_allclose(com, [3, 0, 0])
    np.testing.assert_allclose(inertia, np.diag([0, 12, 12]))
    quarter_turn = np.array([[0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    _, com, inertia = rigid_body(quarter_turn @ whole @ quarter_turn.T)
    np.testing.assert_allclose(com, [5, 3, 0], atol=1e-15)
    close(inertia, np.diag([12, 0, 12]))
