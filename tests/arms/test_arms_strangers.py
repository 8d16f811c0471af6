"""Descriptions as other people write them, each small and with one thing that kept an arm from being used."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rejoint.arms import Arm, load_arm, read_arm, tcp_position
from rejoint.arms.chain import cut
from rejoint.arms.inertia import SpatialInertia, plausible_links
from rejoint.arms.modelfile import read_tree
from rejoint.arms.room import is_safe, room, unsafe
from rejoint.arms.workspace import rising_frames
from rejoint.diagnosis.excitation import FULL, SHORT, plan_excitation
from rejoint.system.errors import FileError, InputError

Z, Y, X = "0 0 1", "0 1 0", "1 0 0"

SIX = (  # kind, origin in the frame before, axis, limits [rad] or [m]: the build of a UR5, half its size
    ("revolute", "0 0 0.045", Z, (-6.28, 6.28)),
    ("revolute", "0 0.068 0", Y, (-6.28, 6.28)),
    ("revolute", "0 -0.06 0.21", Y, (-3.14, 3.14)),
    ("revolute", "0 0 0.2", Y, (-6.28, 6.28)),
    ("revolute", "0 0.046 0", Z, (-6.28, 6.28)),
    ("revolute", "0 0 0.047", Y, (-6.28, 6.28)),
)
LIFT = ("prismatic", "0.05 0 0.3", Z, (0.1, 0.4))


def urdf(joints: tuple, more: str = "", tool: str = "0 0.1 0", root: str = "base") -> str:
    """Links ``l1`` on, each of a kilogram, joints ``j1`` on, and ``tool0`` at their end."""
    parts = [f'<link name="{root}"/>']
    for i, (kind, origin, axis, (low, high)) in enumerate(joints, start=1):
        parent = root if i == 1 else f"l{i - 1}"
        parts.append(
            f'<link name="l{i}"><inertial><origin xyz="0 0 0.05"/><mass value="1"/><inertia ixx="0.004" iyy="0.004" '
            f'izz="0.004" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j{i}" type="{kind}"><parent '
            f'link="{parent}"/><child link="l{i}"/><origin xyz="{origin}"/><axis xyz="{axis}"/>'
            f'<limit lower="{low}" upper="{high}" velocity="2" effort="1"/></joint>'
        )
    parts.append(fixed(f"l{len(joints)}", "tool0", tool))
    return f'<robot name="stranger">{"".join(parts)}{more}</robot>'


def fixed(parent: str, child: str, origin: str = "0 0 0") -> str:
    joint = f'<joint name="to-{child}" type="fixed"><parent link="{parent}"/><child link="{child}"/>'
    return f'<link name="{child}"/>{joint}<origin xyz="{origin}"/></joint>'


def written(folder: Path, text: str, name: str = "arm.urdf") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def names_and_notes(path: Path, **choice: str) -> tuple[tuple[str, ...], str]:
    draft = cut(read_tree(path), choice.get("base"), choice.get("tip"))
    return draft.joint_names, "\n".join(draft.notes)


def upside_down(text: str) -> str:
    """Hang the robot of a URDF from a ceiling two metres up."""
    joint = '<joint name="ceiling" type="fixed"><parent link="world"/><child link="base"/>'
    hung = f'<link name="world"/>{joint}<origin xyz="0.3 0 2" rpy="3.141592653589793 0 0"/></joint></robot>'
    return text.replace("</robot>", hung)


def check_can_be_diagnosed(arm: Arm) -> None:
    """The rest posture that was derived, and every excitation about it, are safe."""
    assert is_safe(arm, arm.rest)
    assert arm.targets.contains(tcp_position(arm, arm.rest))
    for plan in (SHORT, FULL):
        excitation = plan_excitation(arm, seed=0, plan=plan)
        assert is_safe(arm, excitation.command(np.arange(0.0, excitation.duration, 0.1))).all()


@pytest.fixture(scope="module")
def six(tmp_path_factory: pytest.TempPathFactory) -> Arm:
    return load_arm(written(tmp_path_factory.mktemp("six"), urdf(SIX)))


def test_a_shoulder_that_never_rises_may_be_low(six: Arm) -> None:
    arm = six  # its shoulder moves sideways, 45 mm above the base
    assert arm.offset[0, 2, 3] < arm.floor + 0.05
    np.testing.assert_array_equal(rising_frames(arm), [False, False, True, True, True, True])
    check_can_be_diagnosed(arm)


def test_a_frame_that_no_posture_lifts_high_enough_may_be_low(tmp_path: Path) -> None:
    waist = ("revolute", "0 0 -0.02", X, (-0.5, 0.5))  # lifts the shoulder by little more than a finger
    arm = load_arm(written(tmp_path, urdf((waist, *SIX))))
    assert rising_frames(arm)[2]
    assert not rising_frames(arm, arm.floor + 0.06)[2]
    check_can_be_diagnosed(arm)


def test_a_rest_posture_without_room_gives_way_to_the_next(tmp_path: Path) -> None:
    # the best-scored posture of an arm with a narrow waist lies nearer to its limit than an excitation may come
    waist = ("revolute", "0 0 0.1", Y, (-0.1, 0.6))
    arm = load_arm(written(tmp_path, urdf((SIX[0], waist, ("revolute", "0 0.068 0.1", Y, (-2.5, 2.5)), *SIX[2:]))))
    share, spread = room(arm)
    assert min(share, spread) >= 0.25
    check_can_be_diagnosed(arm)


def test_an_arm_that_hangs_is_said_to_be_taken_as_standing(tmp_path: Path) -> None:
    _, notes = names_and_notes(written(tmp_path, upside_down(urdf(SIX))))
    assert "base: base is tilted by 180 deg in the file; gravity, floor and targets are taken as if it stood" in notes


def test_a_posture_that_is_not_safe_says_why(six: Arm) -> None:
    arm = six
    assert unsafe(arm, arm.rest) == ""
    assert "j3 within 10 deg of a limit" in unsafe(arm, np.where(np.arange(6) == 2, 3.1, arm.rest))
    fallen = unsafe(arm, arm.rest + np.array([0, 1.2, 0, 0, 0, 0]))
    assert "mm above the base" in fallen
    for q in np.random.default_rng(0).uniform(arm.lower, arm.upper, (50, 6)):
        assert bool(is_safe(arm, q)) == (unsafe(arm, q) == "")
    stretched = replace(arm, rest=np.where(np.arange(6) == 2, 3.1, arm.rest))
    with pytest.raises(
        InputError, match=r"rest posture is not safe .*: j3 within 10 deg of a limit.*; give another rest_deg"
    ):
        plan_excitation(stretched, seed=0)


def test_an_arm_on_a_surface_is_told_of_its_tip_and_not_of_a_derived_posture(tmp_path: Path) -> None:
    flat = [("revolute", f"0 0 {length}", Y, (-1.0, 1.0)) for length in (0.1, 0.2, 0.2)]
    arm = read_arm(written(tmp_path, urdf(tuple(flat)))).arm
    with pytest.raises(InputError, match=r"its joints move the TCP on a line or a surface only.*; choose a tip that"):
        plan_excitation(arm, seed=0)


def test_a_slide_is_held_and_its_place_can_be_given(tmp_path: Path) -> None:
    path = written(tmp_path, urdf((LIFT, *SIX)))
    names, notes = names_and_notes(path)
    assert names == tuple(f"j{i}" for i in range(2, 8))
    assert "joint j1 slides (100 to 400 mm) and is not driven" in notes
    assert "fixed at 100 mm" in notes  # zero is outside of its limits
    assert "--hold j1=100mm" in notes
    low, high = (read_tree(path, {"j1": place}) for place in (0.1, 0.35))
    first = [cut(tree, None, None).offset[0, :3, 3] for tree in (low, high)]
    np.testing.assert_allclose(first[0], [0.05, 0, 0.445], atol=1e-12)
    np.testing.assert_allclose(first[1] - first[0], [0, 0, 0.25], atol=1e-12)


def test_a_held_hinge_turns_what_it_carries(tmp_path: Path) -> None:
    path = written(tmp_path, urdf(SIX))
    whole, held = cut(read_tree(path), None, None), cut(read_tree(path, {"j4": 0.7}), None, None)
    assert held.joint_names == ("j1", "j2", "j3", "j5", "j6")
    assert any("joint j4: held at 40.11 deg" in note for note in held.notes)
    assert held.links[2].mass == pytest.approx(whole.links[2].mass + whole.links[3].mass)
    q = np.array([0.3, -0.4, 0.9, 0.2, 0.5])
    five, six = (chain_tcp(draft, angles) for draft, angles in ((held, q), (whole, np.insert(q, 3, 0.7))))
    np.testing.assert_allclose(five, six, atol=1e-12)


def chain_tcp(draft, q: np.ndarray) -> np.ndarray:
    from rejoint.arms.rotations import rotation_about

    pose = np.eye(4)
    for offset, axis, angle in zip(draft.offset, draft.axis, q, strict=True):
        turn = np.eye(4)
        turn[:3, :3] = rotation_about(axis, angle)
        pose = pose @ offset @ turn
    return (pose @ draft.tip)[:3, 3]


@pytest.mark.parametrize(
    ("hold", "message"),
    [
        ({"j9": 0.1}, "no joint called 'j9'; it has: j1, j2"),
        ({"j1": 0.5}, "joint j1 cannot be held at 0.5 m: it goes from 0.1 to 0.4"),
    ],
)
def test_what_cannot_be_held_is_named(tmp_path: Path, hold: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_arm(written(tmp_path, urdf((LIFT, *SIX))), hold=hold)


def test_a_mobile_base_is_no_part_of_the_arm(tmp_path: Path) -> None:
    span = (-10.0, 10.0)
    wheels = (("prismatic", "0 0 0", X, span), ("prismatic", "0 0 0", Y, span), ("continuous", "0 0 0", Z, span))
    names, notes = names_and_notes(written(tmp_path, urdf((*wheels, LIFT, *SIX))))
    assert names == tuple(f"j{i}" for i in range(5, 11))
    assert "base: none given; l3 taken; j1, j2, j3 before it move all of it" in notes
    assert "joint j4 slides" in notes
    assert "joint j1 slides" not in notes
    lift_alone, _ = names_and_notes(written(tmp_path, urdf((LIFT, *SIX))))
    assert len(lift_alone) == 6  # one slide is an axis under the arm, and its base stays on the floor


def test_frames_on_one_link_need_no_choice_and_two_arms_do(tmp_path: Path) -> None:
    frames = fixed("l6", "camera") + fixed("l6", "ee_link")
    _, notes = names_and_notes(written(tmp_path, urdf(SIX, frames)))
    assert "tip: none given; tool0 taken, the end of the longest chain (beside it are camera, ee_link," in notes
    _, notes = names_and_notes(written(tmp_path, urdf(SIX, frames).replace("tool0", "lamp")))
    assert "tip: none given; ee_link taken" in notes  # the one that is called a tool's
    _, notes = names_and_notes(written(tmp_path, urdf(SIX, fixed("l6", "camera")).replace("tool0", "lamp")))
    assert "tip: none given; l6 taken" in notes  # no name tells, so the link that carries them
    other = urdf(SIX, fixed("l6", "camera")).partition("<link")[2].replace("</robot>", "")
    twin = ("<link" + other).replace('"l', '"r').replace('name="j', 'name="k').replace("tool0", "tool1")
    twin = twin.replace('<link name="base"/>', "").replace("camera", "lens")
    with pytest.raises(InputError, match=r"be the tip of the arm \(6 joints each\): tool0, tool1; name the tip"):
        read_arm(written(tmp_path, urdf(SIX, fixed("l6", "camera") + twin)))


def test_what_is_no_whole_model_says_what_it_is(tmp_path: Path) -> None:
    fragment = written(tmp_path, '<mujocoinclude><geom size="1"/></mujocoinclude>', "hand.xml")
    with pytest.raises(FileError, match=r"a fragment that other MJCF files include; give a whole one$"):
        read_arm(fragment)
    for name in ("scene.xml", "other.xml"):
        written(tmp_path, f'<mujoco><include file="{"hand.xml" if name == "scene.xml" else "x.xml"}"/></mujoco>', name)
    with pytest.raises(FileError, match=r"give a whole one, such as scene\.xml$"):
        read_arm(fragment)
    with pytest.raises(FileError, match=r"a xacro file, .*: xacro ur5\.urdf\.xacro > ur5\.urdf \(xacro comes with ROS"):
        read_arm(written(tmp_path, "<robot/>", "ur5.urdf.xacro"))
    with pytest.raises(FileError, match=r"xacro ur5\.urdf > ur5-expanded\.urdf"):
        read_arm(written(tmp_path, "<robot><xacro:include filename='a'/></robot>", "ur5.urdf"))


def test_what_an_arm_does_not_need_may_be_wrong(tmp_path: Path) -> None:
    plain = cut(read_tree(written(tmp_path, urdf(SIX))), None, None)
    shapes = '<visual><geometry/></visual><collision><geometry><mesh filename="package://a/b.stl" scale="1 1 1 1"/>'
    text = urdf(SIX, '<transmission name="t"/><gazebo><plugin/></gazebo><link name="sheet"><inertial/></link>')
    text = text.replace("</inertial></link>", f"</inertial>{shapes}</geometry></collision></link>", 3)
    text = text.replace(f'<axis xyz="{Y}"/>', f'<axis xyz="{Y}"/><dynamics damping="x"/>')
    text = (
        text.replace("</robot>", "")
        + '<joint name="s" type="fixed"><parent link="l2"/><child link="sheet"/></joint></robot>'
    )
    found = cut(read_tree(written(tmp_path, text)), None, None)
    np.testing.assert_array_equal(found.offset, plain.offset)
    for one, other in zip(found.links, plain.links, strict=True):
        assert one.mass == other.mass
        np.testing.assert_array_equal(one.inertia, other.inertia)


def test_a_property_that_nothing_uses_makes_no_template(tmp_path: Path) -> None:
    plain = cut(read_tree(written(tmp_path, urdf(SIX))), None, None)
    mesh = '<visual><geometry><mesh filename="$(find a)/${b}.dae"/></geometry></visual></link>'
    text = urdf(SIX, '<xacro:property name="width" value=".2"/>').replace("</inertial></link>", f"</inertial>{mesh}")
    text = text.replace("<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"')
    found = cut(read_tree(written(tmp_path, text)), None, None)
    assert found.joint_names == plain.joint_names
    np.testing.assert_array_equal(found.offset, plain.offset)


def test_a_mass_without_an_inertia_is_kept_and_the_inertia_estimated(tmp_path: Path) -> None:
    text = re.sub(r"<inertia [^>]*/>", "", urdf(SIX))
    loaded = read_arm(written(tmp_path, text))
    np.testing.assert_array_equal(loaded.arm.mass, np.ones(6))
    np.testing.assert_allclose(loaded.arm.com, np.tile([0.0, 0.0, 0.05], (6, 1)))
    assert "body l2: its inertia belongs to no rigid body (moments 0, 0, 0 kg m^2)" in loaded.notes
    assert sum("no usable inertia; estimated" in note for note in loaded.notes) == 6


def test_a_frame_of_next_to_no_inertia_does_not_keep_an_arm_from_being_read(tmp_path: Path) -> None:
    moments = 'ixx="3.3e-22" iyy="3.3e-22" izz="5e-22" ixy="0" ixz="0" iyz="0"'
    frame = f'<link name="imu"><inertial><mass value="1e-7"/><inertia {moments}/></inertial></link>'
    text = urdf(SIX, fixed("l3", "imu").replace('<link name="imu"/>', frame))
    found, plain = (cut(read_tree(written(tmp_path, one)), None, None) for one in (text, urdf(SIX)))
    assert found.links[2].mass == pytest.approx(plain.links[2].mass, abs=1e-6)
    np.testing.assert_allclose(found.links[2].inertia, plain.links[2].inertia, atol=1e-6)


def test_warnings_are_notes_and_leave_nothing_behind(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    stiff = urdf(SIX).replace('lower="-3.14" upper="3.14"', 'lower="0.2" upper="0.2"')
    _, notes = names_and_notes(written(tmp_path, stiff))
    assert "MuJoCo: joint 'j3' has equal lower and upper limits, limit ignored" in notes
    assert capfd.readouterr() == ("", "")
    assert [path.name for path in tmp_path.iterdir()] == ["arm.urdf"]


def test_a_mistake_is_named_with_the_line_of_the_file(tmp_path: Path) -> None:
    lines = urdf(SIX).replace("<joint", "\n<joint").replace('xyz="0 0.068 0"', 'xyz="0 0.068"')
    found = 1 + lines.split("\n").index(next(line for line in lines.split("\n") if 'xyz="0 0.068"' in line))
    with pytest.raises(FileError, match=rf"MuJoCo cannot read it: .*'xyz'.*line {found}; correct the file"):
        read_arm(written(tmp_path, "\n".join(lines.split("\n"))))


def test_meshes_with_masses_keep_them_and_shapes_to_be_seen_have_none(tmp_path: Path) -> None:
    text = """<mujoco><compiler angle="radian"/><asset><mesh name="gone" file="nowhere.stl"/></asset><worldbody>
     <body name="base"><body name="a" pos="0 0 0.1"><joint name="j1" axis="0 0 1" range="-2 2"/>
      <geom type="mesh" mesh="gone" mass="0.7" pos="0 0 0.1"/><geom type="cylinder" size="0.04 0.01" mass="0"/>
      <body name="b" pos="0 0 0.2"><joint name="j2" axis="0 1 0" range="-2 2"/><geom type="sphere" size="0.1" mass="0"/>
       <body name="c" pos="0 0 0.2"><joint name="j3" axis="1 0 0" range="-2 2"/><geom type="sphere" size="0.05"/>
     </body></body></body></body></worldbody></mujoco>"""
    draft = cut(read_tree(written(tmp_path, text, "arm.xml")), None, None)
    assert [link.mass for link in draft.links[:2]] == pytest.approx([0.7, 0.0])
    np.testing.assert_allclose(draft.links[0].com, [0, 0, 0.1], atol=1e-12)
    assert any("body a: no inertial; the masses of its meshes are taken as balls" in note for note in draft.notes)


def test_a_name_that_is_there_twice_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="repeated name 'j2' in joint; correct the file"):
        read_arm(written(tmp_path, urdf(SIX).replace('name="j3"', 'name="j2"')))


def test_units_of_others_are_doubted(tmp_path: Path) -> None:
    arm = read_arm(written(tmp_path, urdf(SIX).replace('lower="-3.14" upper="3.14"', 'lower="-180" upper="180"')))
    assert any("those of j3 are beyond 4 turns, and not believed" in note for note in arm.notes)
    np.testing.assert_allclose((arm.arm.lower[2], arm.arm.upper[2]), (-np.pi, np.pi))
    millimetres = tuple(
        (kind, " ".join(str(1e3 * float(part)) for part in origin.split()), axis, limits)
        for kind, origin, axis, limits in SIX
    )
    with pytest.raises(
        InputError, match=r"its links add up to \d+ m, at most 30 m were expected; are they in millimet"
    ):
        read_arm(written(tmp_path, urdf(millimetres)))


def test_speeds_that_nothing_has_are_not_believed(tmp_path: Path) -> None:
    """A guard without a limit of speed would be the price of a placeholder, or of degrees."""
    fast = urdf(SIX).replace('velocity="2"', 'velocity="180"', 1).replace('velocity="2"', 'velocity="40"', 1)
    loaded = read_arm(written(tmp_path, fast))
    np.testing.assert_allclose(loaded.arm.max_speed, [np.pi / 2, 40, 2, 2, 2, 2])
    assert "speed: limits of j1 are beyond 10 turns a second, and not believed" in "\n".join(loaded.notes)
    assert "speed: no limit for j1; 90 deg/s assumed" in loaded.notes


@pytest.mark.parametrize(("kilograms", "told"), [("1", False), ("0.05", False), ("0.001", True)])
def test_masses_of_next_to_nothing_are_doubted(tmp_path: Path, kilograms: str, told: bool) -> None:
    ends = np.tile([0.0, 0.0, 0.1], (6, 1))
    links = [SpatialInertia(mass=float(kilograms), com=ends[0] / 2, inertia=np.eye(3) * 1e-3)] * 6
    _, notes = plausible_links("abcdef", links, ends)
    assert any("kg in all, where solid links of that length have 1.7 kg" in note for note in notes) is told


@pytest.mark.parametrize("encoding", ["utf-16", "iso-8859-1", "utf-8"])
def test_a_file_is_read_in_the_encoding_that_it_declares(tmp_path: Path, encoding: str) -> None:
    text = f'<?xml version="1.0" encoding="{encoding}"?>\n' + urdf(SIX).replace('"j1"', '"Gelenkhöhe"')
    path = tmp_path / "arm.urdf"
    path.write_bytes(text.encode(encoding))
    assert cut(read_tree(path), None, None).joint_names[0] == "Gelenkhöhe"
    path.write_bytes(text.replace(encoding, "no-such").encode())
    with pytest.raises(FileError, match="save it as UTF-8"):
        read_tree(path)
