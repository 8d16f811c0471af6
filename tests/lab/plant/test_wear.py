import dataclasses
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rejoint.arms import mycobot280
from rejoint.arms.workspace import heaviest_load
from rejoint.system.errors import FileError, ProfileError
from rejoint_lab.plant.wear import (
    PARAMETERS,
    draw_wear,
    lifting_torque,
    load_wear,
    wear_arm,
    wear_names,
)

ARM = mycobot280()
SCALING = tuple(name for name in wear_names() if wear_arm(name) is None)
"""The profiles that fit every arm."""
FAMILY = [load_wear(f"worn?seed={seed}", ARM) for seed in range(20)]


def worn_text():
    wear = load_wear("worn", ARM)
    lines = []
    for name in PARAMETERS:
        value = getattr(wear, name)
        lines.append(f"play_deg = {np.degrees(value).tolist()}" if name == "play" else f"{name} = {value.tolist()}")
    return "[joints]\n" + "\n".join(lines) + "\n"


scalars = st.one_of(
    st.integers(), st.floats(), st.booleans(), st.text("abc", max_size=3), st.lists(st.floats(0, 9), max_size=7)
)


@settings(max_examples=150)
@given(field=st.sampled_from(PARAMETERS), value=scalars)
def test_any_value_of_a_field_is_a_wear_or_an_error_that_names_it(field, value):
    name = "play_deg" if field == "play" else field
    written = {True: "true", False: "false"}.get(value) if isinstance(value, bool) else repr(value)
    lines = [f"{name} = {written}" if line.startswith(f"{name} =") else line for line in worn_text().splitlines()]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "mine.toml"
        path.write_text("\n".join(lines))
        try:
            wear = load_wear(str(path), ARM)
        except (FileError, ProfileError):
            return
    assert np.isfinite(getattr(wear, field)).all()
    assert (getattr(wear, field) >= 0).all()


@pytest.mark.parametrize("name", PARAMETERS)
def test_the_family_draws_every_parameter_of_every_joint(name):
    worn = getattr(load_wear("worn", ARM), name)
    drawn = np.array([getattr(wear, name) for wear in FAMILY])
    ratio = drawn / worn
    assert len(np.unique(drawn[:, 0])) == len(FAMILY)
    assert (np.ptp(ratio, axis=0) > 0.05).all()
    assert ratio.max() < 1.45
    assert ratio.min() > 0.69


def test_no_neighbour_is_too_weak_to_lift_itself():
    weak = dataclasses.replace(load_wear("worn", ARM), torque_limit=np.full(6, 0.3))
    for seed in range(10):
        neighbour = draw_wear(weak, ARM, seed)
        assert (neighbour.torque_limit >= lifting_torque(neighbour, ARM) - 1e-12).all()


def test_every_profile_of_the_package_lifts_the_arm_everywhere_in_the_region():
    """The wrist alone may stick at its torque limit: shoulder and elbow then reach the target without it."""
    for name in SCALING:
        wear = load_wear(name, ARM)
        assert (wear.torque_limit >= lifting_torque(wear, ARM))[:3].all(), name
        moving = heaviest_load(ARM, 5) * (1 + wear.load_friction) + wear.coulomb
        assert (wear.torque_limit >= 1.1 * moving).all(), name
