import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rejoint.arms import gravity_torque, mycobot280, so101, solve_position
from rejoint.robots.lab.plant.scaling import largest_load
from rejoint.robots.lab.plant.wear import (
    PARAMETERS,
    Wear,
    draw_wear,
    lifting_torque,
    load_wear,
    parse_wear,
    wear_arm,
    wear_names,
)
from rejoint.system.errors import ProfileError

ARM = mycobot280()
SCALING = tuple(name for name in wear_names() if wear_arm(name) is None)
"""The profiles that fit every arm."""
FAMILY = [load_wear(f"worn?seed={seed}", ARM) for seed in range(20)]


def worn_text() -> str:
    wear = load_wear("worn", ARM)
    lines = []
    for name in PARAMETERS:
        value = getattr(wear, name)
        lines.append(f"play_deg = {np.degrees(value).tolist()}" if name == "play" else f"{name} = {value.tolist()}")
    return "[joints]\n" + "\n".join(lines) + "\n"


def test_the_profiles_of_the_package_load():
    assert set(SCALING) == {"healthy", "worn", "worn-true", "play-in-loop"}
    assert set(wear_names()) == {*SCALING, "so101", "so101-new"}
    for name in SCALING:
        wear = load_wear(name, ARM)
        assert wear.name == name
        assert wear.play_in_loop == (name == "play-in-loop")


def test_the_file_holds_degrees_and_the_wear_radians():
    wear = parse_wear(worn_text().replace("play_deg = [", "play_deg = 2.0 # ["), name="mine", joints=6)
    np.testing.assert_allclose(wear.play, np.radians(2.0), rtol=1e-15)


def test_a_worn_arm_is_worse_in_every_respect():
    healthy, worn = load_wear("healthy", ARM), load_wear("worn", ARM)
    for name in ("position_gain", "damping_gain", "torque_limit", "link_stiffness"):
        assert (getattr(worn, name) < getattr(healthy, name)).all()
    for name in ("coulomb", "stiction", "load_friction", "play", "ripple", "torque_noise"):
        assert (getattr(worn, name) > getattr(healthy, name)).all()


def test_a_user_s_file_loads(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(worn_text())
    np.testing.assert_allclose(load_wear(str(path), ARM).play, load_wear("worn", ARM).play, rtol=1e-12)
    drawn = load_wear(f"{path}?seed=3", ARM)
    assert (drawn.position_gain != load_wear("worn", ARM).position_gain).all()


@pytest.mark.parametrize("name", ["wron", "", "worn?seed=", "worn?seed=x", "worn?seed=-1", "none.toml", "worn.toml?"])
def test_an_unknown_profile_names_the_alternatives(name):
    with pytest.raises(ProfileError) as caught:
        load_wear(name, ARM)
    text = str(caught.value)
    assert "whole number" in text or all(known in text for known in wear_names())


def test_a_folder_is_not_a_profile(tmp_path):
    folder = tmp_path / "folder.toml"
    folder.mkdir()
    with pytest.raises(ProfileError, match="cannot read"):
        load_wear(str(folder), ARM)


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("coulomb", "columb", "columb"),
        ("play_deg", "play", "play_deg"),
        ("[joints]", "[joint]", r"\[joints\]"),
        ("[joints]", "play_in_loop = 1\n[joints]", "play_in_loop"),
        ("[joints]", "seed = 1\n[joints]", "seed"),
        ("ripple = [", "ripple = [0.1, ", "ripple"),
        ("ripple = [", "ripple = 'much' # [", "ripple"),
        ("ripple = [", "ripple = true # [", "ripple"),
        ("ripple = [", "ripple = nan # [", "ripple"),
        ("ripple = [", "ripple = -0.1 # [", "ripple"),
        ("torque_limit = [", "torque_limit = 0 # [", "torque_limit"),
        ("stiction = [", "stiction = 0.0 # [", "stiction"),
        ("position_gain = [", "position_gain = 1e5 # [", "position_gain"),
        ("[joints]", "scales = true\n[joints]", "scale"),
        ("[joints]", "scales = 1\n[joints]", "scales"),
        ("[joints]", "arm = 7\n[joints]", "arm"),
        ("[joints]", "arm = 'ur5e'\nscales = true\n[joints]", "mycobot280"),
        ("[joints]", "[joints]\noffset_deg = 'none'", "offset_deg"),
        ("[joints]", "[joints]\noffset_deg = inf", "offset"),
    ],
)
def test_a_wrong_field_is_named(old, new, found):
    with pytest.raises(ProfileError, match=found):
        parse_wear(worn_text().replace(old, new, 1), name="mine", joints=6)


def test_a_profile_for_another_number_of_joints_is_refused():
    with pytest.raises(ProfileError, match="7 numbers"):
        parse_wear(worn_text(), name="mine", joints=7)


@settings(max_examples=150)
@given(text=st.text(max_size=200))
def test_garbage_is_a_profile_error(text):
    with pytest.raises(ProfileError):
        parse_wear(text, name="garbage", joints=6)


scalars = st.one_of(
    st.integers(), st.floats(), st.booleans(), st.text("abc", max_size=3), st.lists(st.floats(0, 9), max_size=7)
)


@settings(max_examples=150)
@given(field=st.sampled_from(PARAMETERS), value=scalars)
def test_any_value_of_a_field_is_a_wear_or_a_profile_error(field, value):
    name = "play_deg" if field == "play" else field
    written = {True: "true", False: "false"}.get(value) if isinstance(value, bool) else repr(value)
    lines = [f"{name} = {written}" if line.startswith(f"{name} =") else line for line in worn_text().splitlines()]
    try:
        wear = parse_wear("\n".join(lines), name="mine", joints=6)
    except ProfileError:
        return
    assert np.isfinite(getattr(wear, field)).all()
    assert (getattr(wear, field) >= 0).all()


@settings(max_examples=100)
@given(data=st.binary(max_size=100))
def test_a_binary_file_is_a_profile_error(data, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "binary.toml"
    path.write_bytes(data)
    with pytest.raises(ProfileError):
        load_wear(str(path), ARM)


def test_the_family_is_seeded():
    again = load_wear("worn?seed=3", ARM)
    for name in PARAMETERS:
        np.testing.assert_array_equal(getattr(again, name), getattr(FAMILY[3], name))


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
    for wear in FAMILY:
        assert (wear.torque_limit >= lifting_torque(wear, ARM) - 1e-12).all()


def test_every_profile_of_the_package_lifts_the_arm_everywhere_in_the_region():
    """The wrist alone may stick at its torque limit: shoulder and elbow then reach the target without it."""
    for name in SCALING:
        wear = load_wear(name, ARM)
        assert (wear.torque_limit >= lifting_torque(wear, ARM))[:3].all(), name
        moving = largest_load(ARM) * (1 + wear.load_friction) + wear.coulomb
        assert (wear.torque_limit >= 1.1 * moving).all(), name


def test_the_largest_load_bounds_random_targets_up_to_the_grid():
    targets = ARM.targets.sample(np.random.default_rng(1), (200,))
    load = np.abs(gravity_torque(ARM, solve_position(ARM, targets, ARM.rest).q))
    assert (load <= largest_load(ARM) * 1.02 + 2e-3).all()


def test_a_wear_is_read_only_and_copies():
    values = {name: np.ones(6) for name in PARAMETERS}
    values |= {"reflected_inertia": np.full(6, 0.1), "link_stiffness": np.full(6, 50.0)}
    wear = Wear(name="mine", **values)
    values["play"][:] = 7.0
    assert (wear.play == 1.0).all()
    with pytest.raises(ValueError, match="read-only"):
        wear.play[0] = 2.0


def test_a_profile_of_one_arm_is_refused_for_others_and_says_what_to_do(tmp_path):
    assert wear_arm("so101") == wear_arm("so101?seed=2") == "so101"
    with pytest.raises(ProfileError, match=r"arm so101 alone, not mycobot280; give --arm so101") as caught:
        load_wear("so101", ARM)
    assert all(name in str(caught.value) for name in SCALING)
    mine = tmp_path / "mine.toml"
    mine.write_text("arm = 'mycobot280'\n" + worn_text())
    assert wear_arm(str(mine)) == "mycobot280"
    with pytest.raises(ProfileError, match="give --arm mycobot280"):
        load_wear(str(mine), so101())


def test_the_profile_of_the_so101_holds_what_was_identified_on_a_real_one():
    wear = load_wear("so101", so101())
    np.testing.assert_allclose(wear.position_gain, [25, 19, 20, 23, 26])
    viscous = wear.damping_gain + wear.torque_limit / 5.0  # the motor brakes by its back-EMF as well
    np.testing.assert_allclose(viscous, [1.6, 0.8, 0.9, 1.1, 1.3], atol=0.005)
    np.testing.assert_allclose(np.degrees(wear.offset), [0, 0.8, 0.95, 0.3, -0.1])
    assert wear.play_in_loop
    assert (load_wear("so101?seed=1", so101()).offset == wear.offset).all()


def test_a_profile_that_neither_scales_nor_names_an_arm_is_taken_as_it_stands(tmp_path):
    path = tmp_path / "plain.toml"
    values = {"reflected_inertia": 0.02, "link_stiffness": 100.0} | {"play_deg": 1.0, "damping_gain": 0.3}
    lines = [
        f"{'play_deg' if name == 'play' else name} = {values.get('play_deg' if name == 'play' else name, 0.5)}"
        for name in PARAMETERS
    ]
    path.write_text("[joints]\n" + "\n".join(lines) + "\n")
    wear = load_wear(str(path), so101())
    np.testing.assert_array_equal(wear.position_gain, np.full(5, 0.5))
    np.testing.assert_array_equal(wear.offset, np.zeros(5))
