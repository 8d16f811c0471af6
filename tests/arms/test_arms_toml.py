"""Arms as TOML files: round trip, completion, and errors that name line and key."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rejoint.arms import Arm, load_arm, mycobot280, read_arm, so101, tcp_pose, write_arm_toml
from rejoint.arms.rotations import quaternion_of, rotation_about, rotation_of
from rejoint.system.errors import FileError, InputError

SHOULDER = """name = "two"
rest_deg = [0, -40, 80]
[targets]
lower_m = [0.1, -0.1, 0.1]
upper_m = [0.2, 0.1, 0.2]
[tip]
position_m = [0, 0, 0.1]
"""

JOINTS = """[[joint]]
name = "pan"
position_m = [0, 0, 0.1]
lower_deg = -90
upper_deg = 90
max_speed_deg_s = 180
mass_kg = 0.5
com_m = [0, 0, 0.02]
inertia_kg_m2 = [1e-3, 1e-3, 1e-3, 0, 0, 0]
[[joint]]
name = "lift"
axis = [0, 2, 0]
position_m = [0, 0, 0.05]
[[joint]]
name = "elbow"
axis = [0, 1, 0]
position_m = [0, 0, 0.2]
"""


def write(folder: Path, text: str) -> str:
    path = folder / "arm.toml"
    path.write_text(text, encoding="utf-8")
    return str(path)


@pytest.mark.parametrize("make", [mycobot280, so101])
def test_round_trip(tmp_path: Path, make: type[Arm]) -> None:
    arm = make()
    write_arm_toml(tmp_path / "arm.toml", arm, notes=["as bought"])
    loaded = read_arm(str(tmp_path / "arm.toml"))
    assert loaded.notes == ()
    assert (loaded.arm.name, loaded.arm.joint_names) == (arm.name, arm.joint_names)
    for field in fields(Arm):
        if field.name in ("name", "joint_names", "targets"):
            continue
        wanted, found = getattr(arm, field.name), getattr(loaded.arm, field.name)
        if field.name == "servos":
            assert found == wanted
            continue
        np.testing.assert_allclose(found, wanted, rtol=1e-14, atol=1e-15, err_msg=field.name)
    np.testing.assert_array_equal(loaded.arm.targets.lower, arm.targets.lower)
    assert (tmp_path / "arm.toml").read_text().startswith("# as bought\nname = ")


def test_names_with_any_characters_survive(tmp_path: Path) -> None:
    odd = replace(so101(), name='the "best"\\arm\n2', joint_names=("ä", "b#", "[c]", "d=1", "e\t"))
    write_arm_toml(tmp_path / "arm.toml", odd)
    assert load_arm(str(tmp_path / "arm.toml")).name == odd.name
    assert load_arm(str(tmp_path / "arm.toml")).joint_names == odd.joint_names


def test_a_table_of_denavit_and_hartenberg_is_the_same_arm(tmp_path: Path) -> None:
    rows = [
        "d_m = 0.13122, alpha_deg = 90", "a_m = -0.1104, offset_deg = -90", "a_m = -0.096",
        "d_m = 0.0634, alpha_deg = 90, offset_deg = -90", "d_m = 0.07505, alpha_deg = -90, offset_deg = 90",
        "d_m = 0.0456",
    ]  # fmt: skip
    text = 'name = "mine"\n' + "".join(f'[[joint]]\nname = "j{i}"\ndh = {{ {row} }}\n' for i, row in enumerate(rows))
    arm = load_arm(write(tmp_path, text))
    q = np.random.default_rng(0).uniform(-2, 2, (50, 6))
    np.testing.assert_allclose(tcp_pose(arm, q), tcp_pose(mycobot280(), q), atol=1e-15)


def test_what_is_left_out_is_completed_and_named(tmp_path: Path) -> None:
    loaded = read_arm(write(tmp_path, SHOULDER + JOINTS))
    np.testing.assert_allclose(loaded.arm.axis[1], [0, 1, 0])
    np.testing.assert_allclose(np.degrees(loaded.arm.upper), [90, 180, 180])
    assert "limits: none usable for lift, elbow; +-180 deg assumed" in loaded.notes
    assert sum("no mass; estimated" in note for note in loaded.notes) == 2
    assert loaded.arm.mass[0] == 0.5


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("lower_deg = -90", "lower_deg = '-90'", "line 11: joint 1: lower_deg: expected a finite number, found '-90'"),
        ("upper_deg = 90", "uper_deg = 90", "line 12: joint 1: uper_deg: there is no such key; did you mean upper_deg"),
        ("axis = [0, 2, 0]", "axis = [0, 0, 0]", "line 19: joint 2: axis: an axis needs a direction"),
        ("axis = [0, 1, 0]", "axis = [0, 1]", r"line 23: joint 3: axis: expected 3 finite numbers, found \[0, 1\]"),
        ('name = "elbow"', 'name = "lift"', "line 18: joint 2: name: two joints are called 'lift'"),
        ('name = "elbow"', "", "line 21: joint 3: name: expected a text, found nothing"),
        ("max_speed_deg_s = 180", "max_speed_deg_s = 0", "line 13: .*expected a finite number above 0, found 0"),
        ("mass_kg = 0.5", "mass_kg = nan", "line 14: joint 1: mass_kg: expected a finite number above 0, found nan"),
        ("mass_kg = 0.5", "", "line 15: joint 1: com_m: needs mass_kg beside it"),
        ("[0, -40, 80]", "[0, -40]", "line 2: rest_deg: expected 3 finite numbers"),
        ("upper_m = [0.2", "upper_m = [0.1", "line 5: targets: upper_m: a box needs lower < upper"),
        ("position_m = [0, 0, 0.2]", "dh = { d_m = 1 }", "joint 1: dh: either every joint has a DH row or none"),
        ("[tip]\n", "[tip]\nquaternion = [1, 1, 0, 0]\n", "line 7: tip: quaternion: expected a unit quaternion"),
        ("[tip]", "[tap]", "line 6: tap: there is no such key; did you mean tip"),
        ("[tip]", "[tip", "it is not TOML: .*line 6"),
    ],
)
def test_a_mistake_is_named_with_its_line_and_key(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = SHOULDER + JOINTS
    assert text.count(old) == 1
    with pytest.raises(FileError, match=message):
        read_arm(write(tmp_path, text.replace(old, new)))


def test_targets_without_a_rest_posture_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="give rest_deg as well"):
        read_arm(write(tmp_path, (SHOULDER + JOINTS).replace("rest_deg = [0, -40, 80]\n", "")))


unit = st.floats(-1, 1, allow_nan=False)


@settings(max_examples=100)
@given(st.tuples(unit, unit, unit, unit).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_quaternions_and_rotations_are_two_forms_of_one_thing(values: tuple[float, ...]) -> None:
    quaternion = np.array(values) / np.linalg.norm(values)
    rotation = rotation_of(3 * quaternion)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert abs(quaternion @ quaternion_of(rotation)) == pytest.approx(1, abs=1e-14)
    angle = 2 * np.arctan2(np.linalg.norm(quaternion[1:]), quaternion[0])
    if np.linalg.norm(quaternion[1:]) > 1e-3:
        axis = quaternion[1:] / np.linalg.norm(quaternion[1:])
        np.testing.assert_allclose(rotation_about(axis, angle), rotation, atol=1e-12)
