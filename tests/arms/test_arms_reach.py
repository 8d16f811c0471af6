"""An arm whose tool does not move is refused before anything is derived from its reach."""

from pathlib import Path

import pytest

from rejoint.arms import load_arm
from rejoint.system.errors import RejointError


def test_an_arm_without_reach_says_what_is_missing(tmp_path: Path):
    (tmp_path / "rig.toml").write_text(
        'name = "rig"\n[[joint]]\nname = "servo"\nposition_m = [0, 0, 0.3]\naxis = [0, 1, 0]\n'
        "lower_deg = -120\nupper_deg = 120\nmax_speed_deg_s = 300\nmass_kg = 0.1\n"
    )
    with pytest.raises(RejointError, match=r"tool lies in the axis of servo: an arm without reach; .*tip.position_m"):
        load_arm(tmp_path / "rig.toml")
