"""Descriptions as other people write them, each small and with one thing that kept an arm from being used."""

from pathlib import Path

import numpy as np
import pytest

from rejoint.arms import Arm, load_arm, mycobot280, read_arm
from rejoint.arms.modelfile import cut, read_tree
from rejoint.arms.workspace import reach
from rejoint.system.errors import InputError

Z, Y = "0 0 1", "0 1 0"

SIX = (  # kind, origin in the frame before, axis, limits [rad] or [m]: the build of a UR5, half its size
    ("revolute", "0 0 0.045", Z, (-6.28, 6.28)),
    ("revolute", "0 0.068 0", Y, (-6.28, 6.28)),
    ("revolute", "0 -0.06 0.21", Y, (-3.14, 3.14)),
    ("revolute", "0 0 0.2", Y, (-6.28, 6.28)),
    ("revolute", "0 0.046 0", Z, (-6.28, 6.28)),
    ("revolute", "0 0 0.047", Y, (-6.28, 6.28)),
)
LIFT = ("prismatic", "0.05 0 0.3", Z, (0.1, 0.4))


def urdf(joints: tuple, more: str = "") -> str:
    """Links ``l1`` on, each of a kilogram, joints ``j1`` on, and ``tool0`` at their end."""
    parts = ['<link name="base"/>']
    for i, (kind, origin, axis, (low, high)) in enumerate(joints, start=1):
        parent = "base" if i == 1 else f"l{i - 1}"
        parts.append(
            f'<link name="l{i}"><inertial><origin xyz="0 0 0.05"/><mass value="1"/><inertia ixx="0.004" iyy="0.004" '
            f'izz="0.004" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j{i}" type="{kind}"><parent '
            f'link="{parent}"/><child link="l{i}"/><origin xyz="{origin}"/><axis xyz="{axis}"/>'
            f'<limit lower="{low}" upper="{high}" velocity="2" effort="1"/></joint>'
        )
    parts.append(fixed(f"l{len(joints)}", "tool0", "0 0.1 0"))
    return f'<robot name="stranger">{"".join(parts)}{more}</robot>'


def fixed(parent: str, child: str, origin: str = "0 0 0") -> str:
    joint = f'<joint name="to-{child}" type="fixed"><parent link="{parent}"/><child link="{child}"/>'
    return f'<link name="{child}"/>{joint}<origin xyz="{origin}"/></joint>'


def written(folder: Path, text: str, name: str = "arm.urdf") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def names_and_notes(path: Path, **choice: str) -> tuple[tuple[str, ...], str]:
    draft = cut(read_tree(path), choice.get("base"), choice.get("tip"))
    return draft.arm.joint_names, "\n".join(draft.notes)


@pytest.fixture(scope="module")
def six(tmp_path_factory: pytest.TempPathFactory) -> Arm:
    return load_arm(written(tmp_path_factory.mktemp("six"), urdf(SIX)))


def test_a_slide_is_held_and_its_place_can_be_given(tmp_path: Path) -> None:
    path = written(tmp_path, urdf((LIFT, *SIX)))
    names, notes = names_and_notes(path)
    assert names == tuple(f"j{i}" for i in range(2, 8))
    assert "joint j1 slides (100 to 400 mm) and is not driven" in notes
    assert "fixed at 100 mm" in notes  # zero is outside of its limits
    low, high = (read_tree(path, {"j1": place}) for place in (0.1, "350mm"))
    first = [cut(tree, None, None).arm.offset[0, :3, 3] for tree in (low, high)]
    np.testing.assert_allclose(first[0], [0.05, 0, 0.445], atol=1e-12)
    np.testing.assert_allclose(first[1] - first[0], [0, 0, 0.25], atol=1e-12)
    with pytest.raises(InputError):
        read_tree(path, {"j1": "10deg"})


def test_a_held_hinge_turns_what_it_carries(tmp_path: Path) -> None:
    path = written(tmp_path, urdf(SIX))
    whole, held = cut(read_tree(path), None, None), cut(read_tree(path, {"j4": 0.7}), None, None)
    assert held.arm.joint_names == ("j1", "j2", "j3", "j5", "j6")
    assert held.arm.mass[2] == pytest.approx(whole.arm.mass[2] + whole.arm.mass[3])
    q = np.array([0.3, -0.4, 0.9, 0.2, 0.5])
    five, six = (chain_tcp(draft.arm, angles) for draft, angles in ((held, q), (whole, np.insert(q, 3, 0.7))))
    np.testing.assert_allclose(five, six, atol=1e-12)


@pytest.mark.parametrize("name", ["world", "ceiling"])
def test_a_fixed_joint_turns_the_base(tmp_path: Path, name: str) -> None:
    mount = f'<link name="{name}"/>{fixed(name, "base")}'.replace("xyz", 'rpy="1 0 0" xyz')
    arm = load_arm(written(tmp_path, urdf(SIX).replace('<link name="base"/>', mount)))
    np.testing.assert_allclose(arm.offset[0, 2, 2], np.cos(1.0))


def chain_tcp(draft, q: np.ndarray) -> np.ndarray:
    from rejoint.arms.rotations import turned

    pose = np.eye(4)
    for offset, axis, angle in zip(draft.offset, draft.axis, q, strict=True):
        turn = np.eye(4)
        turn[:3, :3] = turned(angle * axis)
        pose = pose @ offset @ turn
    return (pose @ draft.tip)[:3, 3]


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


def test_units_of_others_are_doubted(tmp_path: Path) -> None:
    arm = read_arm(written(tmp_path, urdf(SIX).replace('lower="-3.14" upper="3.14"', 'lower="-180" upper="180"')))
    assert any("those of j3 are beyond 4 turns, and not believed" in note for note in arm.notes)
    np.testing.assert_allclose((arm.arm.lower[2], arm.arm.upper[2]), (-np.pi, np.pi))
    turned = read_arm(written(tmp_path, urdf(SIX).replace('lower="-3.14" upper="3.14"', 'lower="2" upper="-1"')))
    np.testing.assert_allclose((turned.arm.lower[2], turned.arm.upper[2]), (-1.0, 2.0))
    millimetres = tuple(
        (kind, " ".join(str(1e3 * float(part)) for part in origin.split()), axis, limits)
        for kind, origin, axis, limits in SIX
    )
    with pytest.raises(
        InputError, match=r"its links add up to \d+ m, at most 30 m were expected; are they in millimet"
    ):
        read_arm(written(tmp_path, urdf(millimetres)))


@pytest.mark.parametrize("size", [1.0, 3.0])
def test_assumed_encoders_move_the_tool_of_a_longer_arm_no_farther_than_of_a_short_one(tmp_path, size):
    places = [" ".join(str(size * float(part)) for part in origin.split()) for _, origin, _, _ in SIX]
    joints = tuple((kind, place, axis, limits) for (kind, _, axis, limits), place in zip(SIX, places, strict=True))
    path = tmp_path / "arm.urdf"
    path.write_text(urdf(joints))
    arm, small = load_arm(path), mycobot280()
    assert arm.encoder_step * reach(arm) <= small.encoder_step * reach(small) * (1.0 + 1e-9)


def test_a_joint_of_the_chain_that_follows_another_is_refused(tmp_path: Path) -> None:
    end = '</joint><link name="l4"'
    with pytest.raises(InputError, match=r"j3 .* j2"):
        read_arm(written(tmp_path, urdf(SIX).replace(end, f'<mimic joint="j2"/>{end}')))


def test_a_site_at_the_end_of_an_mjcf_is_the_tip(tmp_path: Path):
    links, ends = "", ""
    for j, axis in enumerate((Z, Y, Y, Y)):
        links += f'<body name="l{j}" pos="0 0 0.1"><joint name="j{j}" axis="{axis}" range="-2 2"/>'
        links += '<geom type="capsule" fromto="0 0 0 0 0 0.1" size="0.01" mass="0.1"/>'
        ends += "</body>"
    model = f'<mujoco model="koch"><compiler angle="radian"/><worldbody>{links}<site name="tcp" pos="0 0 0.17"/>{ends}'
    arm = load_arm(written(tmp_path, model + "</worldbody></mujoco>", "arm.xml"))
    assert arm.name == "own-koch"
    np.testing.assert_allclose(arm.tip[:3, 3], [0.0, 0.0, 0.17])
