"""Cutting a chain out of a model: what is kept, what is frozen, what is refused."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from rejoint.arms import (
    Box,
    Loaded,
    gravity_torque,
    jacobian,
    load_arm,
    read_arm,
    so101,
    solve_position,
    tcp_pose,
    tcp_position,
    write_arm_toml,
)
from rejoint.arms.chain import cut
from rejoint.arms.draft import finish
from rejoint.arms.ends import longest
from rejoint.arms.inertia import LINK_DENSITY, SpatialInertia, combined, inertia_matrix, usable
from rejoint.arms.modelfile import read_tree
from rejoint.system.errors import FileError, InputError, MissingExtraError

# Anchors off the body's origin, mixed axes, a joint reference, two joints on one body, a branch whose
# reference lies outside of its limits, and a gripper.
AWKWARD = """<mujoco model="awkward"><compiler angle="radian" autolimits="true"/>
<asset><mesh name="gone" file="nowhere.stl"/><texture name="t" type="2d" file="nowhere.png"/>
<material name="m" texture="t"/></asset>
<worldbody><body name="table" pos="1 2 0.7" euler="0 0 0.4">
 <body name="a" pos="0 0 0.2"><joint name="j1" axis="0 0.6 0.8" pos="0.01 0.02 0.03" range="-2 2"/>
  <geom type="box" size="0.05 0.04 0.1" material="m"/><geom type="mesh" mesh="gone" contype="0"/>
  <body name="lamp" pos="0.1 0 0"><joint name="swing" axis="0 1 0" range="0.3 0.9"/>
   <geom type="sphere" size="0.03" pos="0 0 0.1"/></body>
  <body name="b" pos="0.1 0 0.3" euler="0.3 0.2 0.1"><joint name="j2" axis="1 0 0" ref="0.5" range="-2 2"/>
   <joint name="j3" axis="0 1 0.2" pos="0 0 0.05" range="-2 2"/>
   <geom type="capsule" size="0.03 0.1" pos="0 0 0.1"/>
   <body name="c" pos="0 0.05 0.3"><joint name="j4" axis="0 1 0" range="-2 2"/>
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


def written(folder: Path, text: str, name: str = "arm.xml") -> str:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return str(path)


def with_given_workspace(path: str, tip: str | None = None) -> Loaded:
    """Read an arm without deriving its workspace, which takes a second."""
    draft = cut(read_tree(Path(path)), None, tip)
    box = Box(lower=-np.ones(3), upper=np.ones(3))
    return finish(replace(draft, rest=np.zeros(len(draft.joint_names)), targets=box))


def test_an_awkward_chain_agrees_with_mujoco(tmp_path: Path) -> None:
    arm = with_given_workspace(written(tmp_path, AWKWARD), "tcp").arm
    assert arm.joint_names == ("j1", "j2", "j3", "j4", "j5")
    spec = mujoco.MjSpec.from_string(AWKWARD)
    for geom in [g for b in spec.bodies for g in b.geoms if g.meshname]:
        spec.delete(geom)
    for geom in spec.geoms:
        geom.material = ""
    for element in [*spec.meshes, *spec.materials, *spec.textures, *spec.keys]:
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
        np.testing.assert_allclose(tcp_pose(arm, q)[:3, 3], expected, atol=1e-12)
        np.testing.assert_allclose(tcp_pose(arm, q)[:3, :3], turn.T @ data.site("tcp").xmat.reshape(3, 3), atol=1e-12)
        np.testing.assert_allclose(jacobian(arm, q), np.vstack(turn.T @ jacobians)[:, chain], atol=1e-12)
        # the link between the two joints of one body has no mass of its own and gets a small one
        bare = replace(arm, mass=np.where(np.arange(5) == 1, 0.0, arm.mass))
        np.testing.assert_allclose(gravity_torque(bare, q), data.qfrc_bias[chain], atol=1e-9)


def test_the_notes_name_what_was_assumed(tmp_path: Path) -> None:
    notes = "\n".join(with_given_workspace(written(tmp_path, AWKWARD), "tcp").notes)
    assert "body a: no inertial; its mass is that of its primitive shapes" in notes
    assert "link after joint j2: no mass; estimated" in notes
    assert "speed: no limit for j1, j2, j3, j4, j5; 90 deg/s" in notes
    assert "base: none given; table taken" in notes


@pytest.mark.parametrize(
    ("base", "tip", "message"),
    [
        ("tabel", "tcp", "no body called 'tabel'; did you mean table?"),
        (None, "tpc", "no body or site called 'tpc'; did you mean tcp?"),
        ("d", "c", "c does not hang below d"),
        ("lamp", "tcp", "tcp does not hang below lamp; the bodies above it are: table, a, b, c, d"),
        ("d", "tcp", "no revolute joint between d and d"),
    ],
)
def test_an_impossible_choice_is_named(tmp_path: Path, base: str, tip: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_arm(written(tmp_path, AWKWARD), base=base, tip=tip)


def test_a_prismatic_branch_does_not_end_the_longest_chain(tmp_path: Path) -> None:
    loaded = with_given_workspace(written(tmp_path, AWKWARD))
    assert loaded.arm.joints == 5
    assert any("tip: none given; d taken" in note and "beside it are tcp" in note for note in loaded.notes)


def test_two_equal_chains_are_ambiguous(tmp_path: Path) -> None:
    finger = '<body name="{0}"><joint name="{0}" axis="0 1 0" range="-1 1"/></body>'
    text = AWKWARD.replace('<site name="tcp"', finger.format("f1") + finger.format("f2") + '<site name="tcp"')
    with pytest.raises(InputError, match=r"be the tip of the arm \(6 joints each\): f1, f2; .* such as d,"):
        read_arm(written(tmp_path, text))


def gripper(kind: str, limit: str = '<limit lower="0" upper="1" velocity="3" effort="1"/>') -> str:
    """Two fingers behind the tool of `bare_urdf`; of kind ``mimic`` the second follows the first."""
    names = ("grip_left", "grip_right") if kind == "named" else ("motor", "idler")
    fingers = []
    for i, name in enumerate(names[: 1 if kind == "named" else 2]):
        mimic = f'<mimic joint="{names[0]}"/>' if i == 1 and kind == "mimic" else ""
        fingers.append(
            f'<link name="f{i}">{inertial(0.1)}</link><joint name="{name}" type="revolute"><parent link="tool"/>'
            f'<child link="f{i}"/><axis xyz="0 1 0"/>{limit}{mimic}</joint>'
        )
    return "".join(fingers) + "</robot>"


@pytest.mark.parametrize(("kind", "held"), [("mimic", "motor, idler"), ("named", "grip_left")])
def test_a_gripper_is_held_without_being_named(tmp_path: Path, kind: str, held: str) -> None:
    text = bare_urdf({i: inertial(1.0) for i in range(1, 5)}).replace("</robot>", gripper(kind))
    path = written(tmp_path, text, "bare.urdf")
    loaded = with_given_workspace(path)
    assert loaded.arm.joint_names == ("j1", "j2", "j3", "j4")
    assert loaded.arm.mass[3] == pytest.approx(1.2 if kind == "mimic" else 1.1)
    assert any("tip: none given; tool taken" in note for note in loaded.notes)
    hint = f"tip: {held.split(',')[0]} behind it taken for a gripper's and held; name a tip to drive it"
    assert hint in loaded.notes
    assert with_given_workspace(path, "f0").arm.joints == 5  # who names the finger gets it


def test_two_fingers_that_nothing_couples_stay_ambiguous(tmp_path: Path) -> None:
    text = bare_urdf({i: inertial(1.0) for i in range(1, 5)}).replace("</robot>", gripper("free"))
    with pytest.raises(InputError, match=r"tip of the arm \(5 joints each\): f0, f1; .* such as tool,"):
        read_arm(written(tmp_path, text, "bare.urdf"))


def test_an_arm_on_a_lift_beside_wheels_is_found(tmp_path: Path) -> None:
    wheel = (
        '<link name="wheel{0}"/><joint name="wheel{0}" type="continuous"><parent link="base"/><child link="wheel{0}"/>'
        '<axis xyz="0 1 0"/></joint>'
    )
    text = bare_urdf({i: inertial(1.0) for i in range(1, 5)}, {1: "prismatic"})
    for wheels in ("", wheel.format(1) + wheel.format(2)):
        loaded = with_given_workspace(written(tmp_path, text.replace("</robot>", wheels + "</robot>"), "bare.urdf"))
        assert loaded.arm.joint_names == ("j2", "j3", "j4")
        assert any(note.startswith("joint j1 slides (0 to 600 mm) and is not driven") for note in loaded.notes)


def test_an_arm_that_moves_in_a_plane_has_no_region_of_targets(tmp_path: Path) -> None:
    text = bare_urdf({i: inertial(1.0) for i in range(1, 5)}).replace('<axis xyz="0 0 1"/>', '<axis xyz="0 1 0"/>')
    loaded = read_arm(written(tmp_path, text, "bare.urdf"))
    assert any("4 joints move the TCP on a line or a surface only" in note for note in loaded.notes)
    assert loaded.arm.targets.contains(tcp_position(loaded.arm, loaded.arm.rest))
    assert np.ptp([loaded.arm.targets.lower, loaded.arm.targets.upper], axis=0).max() < 0.01


URDF = """<?xml version="1.0"?><robot name="bare" xmlns:xacro="http://www.ros.org/wiki/xacro">
<link name="base"><visual><geometry><mesh filename="package://none/base.dae"/></geometry></visual></link>
{links}{joints}</robot>"""


def bare_urdf(inertials: dict[int, str] | None = None, kinds: dict[int, str] | None = None) -> str:
    links, joints = [], []
    for i in range(1, 5):
        inertial = (inertials or {}).get(i, "")
        mesh = '<collision><geometry><mesh filename="package://none/l.stl"/></geometry></collision>'
        links.append(f'<link name="l{i}">{mesh}{inertial}</link>')
        kind = (kinds or {}).get(i, "revolute")
        limit = '<limit lower="{}" upper="{}" velocity="3" effort="1"/>'
        limits = {"revolute": limit.format(-2, 2), "prismatic": limit.format(0, 0.6)}
        joints.append(
            f'<joint name="j{i}" type="{kind}"><parent link="{f"l{i - 1}" if i > 1 else "base"}"/><child link="l{i}"/>'
            f'<origin xyz="0 0 {0.1 * i}" rpy="0 0 0"/><axis xyz="{"0 0 1" if i == 1 else "0 1 0"}"/>'
            f"{limits.get(kind, '')}</joint>"
        )
    links.append('<link name="tool"/>')
    joints.append(
        '<joint name="t" type="fixed"><parent link="l4"/><child link="tool"/><origin xyz="0 0 0.1"/>'
        '<safety:limit soft="1"/></joint>'
    )
    return URDF.format(links="".join(links), joints="".join(joints))


def inertial(mass: float, moments: str = "0.001 0.001 0.001", xyz: str = "0 0 0.05") -> str:
    xx, yy, zz = moments.split()
    return (
        f'<inertial><origin xyz="{xyz}"/><mass value="{mass}"/>'
        f'<inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def test_links_without_inertia_become_cylinders(tmp_path: Path) -> None:
    loaded = with_given_workspace(written(tmp_path, bare_urdf(), "bare.urdf"))
    lengths = np.array([0.2, 0.3, 0.4, 0.1])
    radius = lengths.sum() / 20
    np.testing.assert_allclose(loaded.arm.mass, LINK_DENSITY * np.pi * radius**2 * lengths)
    np.testing.assert_allclose(loaded.arm.com[:, 2], lengths / 2)
    axial, across = loaded.arm.mass * radius**2 / 2, loaded.arm.mass * (3 * radius**2 + lengths**2) / 12
    np.testing.assert_allclose(loaded.arm.inertia[:, 2, 2], axial)
    np.testing.assert_allclose(loaded.arm.inertia[:, 0, 0], across)
    assert sum("no mass; estimated" in note for note in loaded.notes) == 4


@pytest.mark.parametrize(
    ("value", "problem"),
    [
        (inertial(1.0, "0 0 0"), "body l2: its inertia belongs to no rigid body"),
        (inertial(1.0, "0.001 0.001 0.1"), "body l2: its inertia belongs to no rigid body"),
        (inertial(1.0, "1 1 1"), "an inertia of 1 kg m\\^2, more than 1 kg within"),
        (inertial(1.0, "1e-9 1e-9 1e-9"), "less than 1 kg of any metal can have"),
        (inertial(-1.0), "body l2: a mass of -1 kg .* cannot be"),
        (inertial(5000.0), "a mass of 5e\\+03 kg; estimated 2.36 kg"),
        (inertial(1.0, xyz="0 0 50"), "no usable centre of mass"),
    ],
)
def test_absurd_inertias_are_named_and_replaced(tmp_path: Path, value: str, problem: str) -> None:
    sound = {i: inertial(1.0) for i in (1, 3, 4)}
    loaded = with_given_workspace(written(tmp_path, bare_urdf({**sound, 2: value}), "bare.urdf"))
    assert any(re.search(problem, note) for note in loaded.notes)
    assert all(usable(inertia) for inertia in loaded.arm.inertia)
    assert (loaded.arm.mass > 0).all()
    assert (loaded.arm.mass < 10).all()
    assert (np.abs(loaded.arm.com) < 1).all()
    for i in (0, 2, 3):  # the neighbours keep what the file says
        np.testing.assert_allclose(loaded.arm.inertia[i], 0.001 * np.eye(3), atol=1e-12)


def test_missing_limits_and_speeds_are_named(tmp_path: Path) -> None:
    sound = {i: inertial(1.0) for i in range(1, 5)}
    loaded = with_given_workspace(written(tmp_path, bare_urdf(sound, {2: "continuous"}), "bare.urdf"))
    np.testing.assert_allclose(loaded.arm.upper, [2, np.pi, 2, 2])
    np.testing.assert_allclose(loaded.arm.max_speed, [3, np.pi / 2, 3, 3])
    assert "limits: none usable for j2; +-180 deg assumed" in loaded.notes
    assert "speed: no limit for j2; 90 deg/s assumed" in loaded.notes


def test_a_joint_that_follows_another_is_no_joint_of_the_chain(tmp_path: Path) -> None:
    mimic = '<mimic joint="j2"/>'
    text = bare_urdf({i: inertial(1.0) for i in range(1, 5)}).replace(
        '<child link="l4"/>', f'<child link="l4"/>{mimic}'
    )
    with pytest.raises(InputError, match="joint j4 between base and l4 is a coupled joint"):
        read_arm(written(tmp_path, text, "bare.urdf"), tip="l4")
    with pytest.raises(InputError, match=r"joint j4 cannot be held alone: it follows j2, .* --hold j4=0deg,j2=0deg"):
        read_arm(written(tmp_path, text, "bare.urdf"), tip="l4", hold={"j4": 0.2})
    both = cut(read_tree(Path(written(tmp_path, text, "bare.urdf")), {"j4": 0.2, "j2": 0.2}), None, "l4")
    assert both.joint_names == ("j1", "j3")
    loaded = with_given_workspace(written(tmp_path, text, "bare.urdf"))
    assert loaded.arm.joint_names == ("j1", "j2", "j3")
    assert loaded.arm.mass[2] == pytest.approx(2.0)  # the follower is frozen on the link that carries it


def test_a_chain_that_ends_before_a_follower_says_what_is_left_out(tmp_path: Path) -> None:
    sound = bare_urdf({i: inertial(1.0) for i in range(1, 5)})
    path = written(tmp_path, sound.replace('<child link="l3"/>', '<child link="l3"/><mimic joint="j2"/>'), "bare.urdf")
    loaded = with_given_workspace(path)
    assert loaded.arm.joint_names == ("j1", "j2")
    assert any("tip: j3 behind it follows j2, so j4 is left out" in note for note in loaded.notes)
    notes: list[str] = []
    held = read_tree(Path(path), {"j3": 0.0, "j2": 0.0})
    assert cut(held, None, held.bodies[longest(held, None, notes)[0]].name).joint_names == ("j1", "j4")
    assert not any("is left out" in note for note in notes)


def test_a_root_link_called_world_is_the_world(tmp_path: Path) -> None:
    fixed = '<joint name="w" type="fixed"><parent link="world"/><child link="base"/><origin xyz="0 0 1"/></joint>'
    sound = bare_urdf({i: inertial(1.0) for i in range(1, 5)})
    text = sound.replace("</robot>", f'<link name="world"/>{fixed}</robot>')
    path = written(tmp_path, text, "bare.urdf")
    q = np.zeros(4)
    assert tcp_pose(with_given_workspace(path).arm, q)[2, 3] == pytest.approx(1.1)
    whole = cut(read_tree(Path(path)), "world", "tool")
    box = Box(lower=-np.ones(3), upper=np.ones(3))
    assert tcp_pose(finish(replace(whole, rest=q, targets=box)).arm, q)[2, 3] == pytest.approx(2.1)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.urdf", "<robot><link></robot>", "it is not XML: mismatched tag: line 1"),
        ("a.xml", "<sdf/>", "its root element is <sdf>"),
        ("a.urdf", "<robot><xacro:macro name='a'/></robot>", "it is a xacro file"),
        ("a.urdf", "<robot><xacro:property name='a' value='1'/><link name='${a}'/></robot>", "it is a xacro file"),
        ("a.xml", "<mujoco><worldbody><wrong/></worldbody></mujoco>", "MuJoCo cannot read it"),
        ("a.xml", None, "there is no such file"),
    ],
)
def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, name: str, text: str | None, message: str) -> None:
    path = str(tmp_path / name) if text is None else written(tmp_path, text, name)
    with pytest.raises(FileError, match=message):
        read_arm(path)


def test_without_mujoco_the_remedy_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_arm_toml(tmp_path / "arm.toml", so101())
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert load_arm(str(tmp_path / "arm.toml")).joints == load_arm("so101").joints == 5
    with pytest.raises(MissingExtraError, match=r"missing: mujoco.*install 'rejoint\[train\]'"):
        read_arm(written(tmp_path, AWKWARD))


def test_an_unknown_name_lists_the_catalogue() -> None:
    with pytest.raises(InputError, match="known arms: mycobot280, so101"):
        read_arm("kuka")
    with pytest.raises(InputError, match="so101 is one already"):
        read_arm("so101", tip="gripper")


def test_lumping_two_balls_by_hand() -> None:
    # 1 kg at x = 0 and 3 kg at x = 4: centre at 3, 1*9 + 3*1 = 12 kg m^2 across, nothing along
    pieces = [
        SpatialInertia(mass=m, com=np.array([x, 0, 0]), inertia=np.zeros((3, 3))) for m, x in ((1.0, 0.0), (3.0, 4.0))
    ]
    whole = combined(pieces)
    assert whole.mass == 4.0
    np.testing.assert_allclose(whole.com, [3, 0, 0])
    np.testing.assert_allclose(whole.inertia, np.diag([0, 12, 12]))
    quarter_turn = np.array([[0, -1, 0, 5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    turned = combined([piece.seen_from(quarter_turn) for piece in pieces])
    np.testing.assert_allclose(turned.com, [5, 3, 0], atol=1e-15)
    np.testing.assert_allclose(turned.inertia, np.diag([12, 0, 12]), atol=1e-12)


def test_inertias_that_no_body_has_are_recognised() -> None:
    assert usable(np.diag([1.0, 1.0, 1.9]))
    assert not usable(np.diag([1.0, 1.0, 2.5]))
    assert not usable(np.diag([1.0, 1.0, -0.1]))
    assert not usable(inertia_matrix([1, 1, 1, 2, 0, 0]))
    assert not usable(np.full((3, 3), np.nan))


def numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.6f}" for value in values)


def random_chain(joints: int, seed: int) -> str:
    rng = np.random.default_rng(seed)
    bodies = [
        f'<body name="b{i}" pos="{numbers(rng.normal(0, 0.15, 3))}" euler="{numbers(rng.uniform(-2, 2, 3))}">'
        f'<joint name="j{i}" axis="{numbers(rng.normal(size=3))}" range="-2 2"/>'
        f'<inertial pos="{numbers(rng.normal(0, 0.05, 3))}" mass="{rng.uniform(0.5, 2):.6f}" '
        f'euler="{numbers(rng.uniform(-2, 2, 3))}" diaginertia="0.01 0.011 0.012"/>'
        for i in range(joints)
    ]
    return (
        '<mujoco><compiler angle="radian" autolimits="true"/><worldbody>'
        f'{"".join(bodies)}<site name="tcp" pos="0.1 0.02 0.05"/>{"</body>" * joints}</worldbody></mujoco>'
    )


@pytest.mark.parametrize("joints", [3, 5, 7])
def test_arms_of_any_number_of_joints_about_any_axes(tmp_path: Path, joints: int) -> None:
    path = written(tmp_path, random_chain(joints, seed=joints))
    arm = with_given_workspace(path, "tcp").arm
    model = mujoco.MjModel.from_xml_path(path)
    data, jac = mujoco.MjData(model), np.empty((2, 3, joints))
    postures = np.random.default_rng(1).uniform(arm.lower, arm.upper, (50, joints))
    for q in postures:
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        mujoco.mj_jacSite(model, data, jac[0], jac[1], 0)
        np.testing.assert_allclose(tcp_pose(arm, q)[:3, 3], data.site_xpos[0], atol=1e-12)
        np.testing.assert_allclose(jacobian(arm, q), np.vstack(jac), atol=1e-12)
        np.testing.assert_allclose(gravity_torque(arm, q), data.qfrc_bias, atol=1e-9)
    near = 0.9 * postures + 0.02
    solution = solve_position(arm, tcp_pose(arm, 0.9 * postures)[:, :3, 3], near)
    assert solution.converged.all()
    assert ((solution.q >= arm.lower) & (solution.q <= arm.upper)).all()
