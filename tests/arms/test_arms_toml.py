"""Arms as TOML files: round trip, completion, and errors that name line and key."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rejoint.arms import Arm, Box, differing, load_arm, mycobot280, read_arm, so101, tcp_pose, write_arm_toml
from rejoint.control.controllers.policy import law_digests
from rejoint.system.errors import FileError

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
    path.write_text(text)
    return str(path)


BOXES = tuple(Box(lower=np.array([0.1 * k, -0.2, 0.0]), upper=np.array([0.1 * k + 0.03, 1 / 3, 0.3])) for k in (1, 2))


@pytest.mark.parametrize("arm", [mycobot280(), replace(so101(), keep_out=BOXES)])
def test_round_trip(tmp_path: Path, arm: Arm) -> None:
    write_arm_toml(tmp_path / "arm.toml", arm)
    loaded = read_arm(str(tmp_path / "arm.toml"))
    assert loaded.notes == ()
    assert differing(loaded.arm, arm) == ()
    assert law_digests(loaded.arm) == law_digests(arm)
    boxes = zip((loaded.arm.targets, *loaded.arm.keep_out), (arm.targets, *arm.keep_out), strict=True)
    for one, other in boxes:
        np.testing.assert_array_equal([one.lower, one.upper], [other.lower, other.upper])


@pytest.mark.parametrize("limits", ["lower_deg = 100\nupper_deg = 90", "upper_deg = 90"])
def test_half_written_limits_are_refused(tmp_path: Path, limits: str) -> None:
    with pytest.raises(FileError, match="lower_deg"):
        load_arm(write(tmp_path, SHOULDER + JOINTS.replace("lower_deg = -90\nupper_deg = 90", limits)))


def test_a_table_of_denavit_and_hartenberg_is_the_same_arm(tmp_path: Path) -> None:
    rows = [
        "d_m = 0.13122, alpha_deg = 90",
        "a_m = -0.1104, offset_deg = -90",
        "a_m = -0.096",
        "d_m = 0.0634, alpha_deg = 90, offset_deg = -90",
        "d_m = 0.07505, alpha_deg = -90, offset_deg = 90",
        "d_m = 0.0456",
    ]
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


def test_a_given_mass_counts_however_unlikely(tmp_path: Path) -> None:
    loaded = read_arm(write(tmp_path, SHOULDER + JOINTS.replace("= 0.5", "= 500")))
    assert loaded.arm.mass[0] == 500.0
    assert any("500 kg in all" in note for note in loaded.notes)
