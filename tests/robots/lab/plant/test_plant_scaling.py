"""A wear profile on arms of other sizes: similarity laws, and arms that nobody here designed."""

import dataclasses
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from modelfiles import ur5e
from rejoint.arms import Arm, Box, mycobot280, so101, solve_position, tcp_position
from rejoint.robots.lab.plant.plant import Plant
from rejoint.robots.lab.plant.wear import (
    PARAMETERS,
    Wear,
    effort,
    load_wear,
    parse_wear,
    scale_of,
)

ARM = mycobot280()
HEAVY = dataclasses.replace(ARM, name="heavy", mass=16.0 * ARM.mass, inertia=16.0 * ARM.inertia)
SCALING = ("healthy", "play-in-loop", "worn", "worn-true")


def resized(arm: Arm, length: float, mass: float) -> Arm:
    """The same arm, with lengths and masses times a factor."""

    def moved(pose: np.ndarray) -> np.ndarray:
        pose = pose.copy()
        pose[..., :3, 3] *= length
        return pose

    return dataclasses.replace(
        arm,
        name="resized",
        offset=moved(arm.offset),
        tip=moved(arm.tip),
        com=length * arm.com,
        mass=mass * arm.mass,
        inertia=mass * length**2 * arm.inertia,
        floor=length * arm.floor,
        targets=Box(lower=length * arm.targets.lower, upper=length * arm.targets.upper),
    )


def seven_joints() -> Arm:
    """A myCobot with another joint in its upper arm, about the axis of the link."""
    twist = np.eye(4)
    return dataclasses.replace(
        ARM,
        name="seven",
        joint_names=tuple(f"j{i}" for i in range(7)),
        offset=np.insert(ARM.offset, 2, twist, axis=0),
        axis=np.insert(ARM.axis, 2, [1.0, 0.0, 0.0], axis=0),
        **{
            name: np.insert(getattr(ARM, name), 2, value)
            for name, value in (("lower", -2.0), ("upper", 2.0), ("max_speed", 2.0), ("mass", 0.02), ("rest", 0.0))
        },
        com=np.insert(ARM.com, 2, 0.0, axis=0),
        inertia=np.insert(ARM.inertia, 2, 1e-5 * np.eye(3), axis=0),
    )


def settled_error(arm: Arm, wear: Wear, targets: np.ndarray, seed: int = 0) -> np.ndarray:
    """Encoder error (K,) [m] after being told once where to go, mean of the last second."""
    plant = Plant(arm, [wear], seed=seed)
    found = []
    for posture, target in zip(solve_position(arm, targets, arm.rest, tolerance=1e-6).q, targets, strict=True):
        plant.command(posture[None])
        plant.advance(4.0)
        rows = []
        for _ in range(20):
            plant.advance(0.05)
            rows.append(plant.encoder()[0])
        found.append(np.linalg.norm(tcp_position(arm, np.array(rows)) - target, axis=-1).mean())
    return np.array(found)


def test_on_the_mycobot_itself_nothing_is_scaled():
    scale = scale_of(mycobot280())
    np.testing.assert_array_equal(scale.row, np.arange(6))
    np.testing.assert_array_equal(scale.torque, np.ones(6))
    assert scale.time == 1.0
    for name in SCALING:
        text = (Path(find_spec("rejoint.robots.lab.plant").origin).parent / "profiles" / f"{name}.toml").read_text()
        written, loaded = parse_wear(text, name=name, joints=6), load_wear(name, mycobot280())
        for parameter in PARAMETERS:
            np.testing.assert_array_equal(getattr(loaded, parameter), getattr(written, parameter))


@pytest.mark.parametrize(("length", "mass"), [(2.0, 8.0), (0.5, 0.3), (3.0, 1.0)])
def test_a_resized_arm_has_the_dimensions_of_its_quantities(length, mass):
    """Lengths times a and masses times b: torques a b, times sqrt(a), and so every quantity by its unit."""
    other, torque, time = resized(ARM, length, mass), length * mass, length**0.5
    np.testing.assert_allclose(effort(other), torque * effort(ARM), rtol=2e-4)  # the IK damps in metres
    powers = {"damping_gain": torque * time, "reflected_inertia": torque * length, "play": 1.0, "load_friction": 1.0}
    for name in SCALING:
        old, new = load_wear(name, ARM), load_wear(name, other)
        for parameter in PARAMETERS:
            expected = powers.get(parameter, torque) * getattr(old, parameter)
            np.testing.assert_allclose(getattr(new, parameter), expected, rtol=2e-4, err_msg=f"{name} {parameter}")


@pytest.mark.parametrize("name", SCALING)
def test_a_heavier_arm_moves_bit_for_bit_in_the_same_way(name):
    """All torques and inertias are 16 times as large, which no position can show."""
    one, other = Plant(ARM, [load_wear(name, ARM)], seed=4), Plant(HEAVY, [load_wear(name, HEAVY)], seed=4)
    for k in range(40):
        command = (ARM.rest + 0.3 * np.sin(0.3 * k + np.arange(6)))[None]
        for plant in (one, other):
            plant.command(command)
            plant.advance(0.03)
        np.testing.assert_array_equal(other.link_position(), one.link_position())
    np.testing.assert_array_equal(other.torque, 16.0 * one.torque)
    one.set_power(np.array([False]))
    other.set_power(np.array([False]))
    for _ in range(20):  # down upon the mechanical stops
        one.advance(0.1)
        other.advance(0.1)
    np.testing.assert_array_equal(other.link_position(), one.link_position())


@pytest.mark.parametrize("make", [so101, ur5e, seven_joints])
def test_other_arms_are_healthy_and_worn_in_proportion(make):
    arm = make()
    targets = arm.targets.sample(np.random.default_rng(1), (6,))
    away = np.linalg.norm((arm.targets.lower + arm.targets.upper)[:2] / 2)
    healthy = settled_error(arm, load_wear("healthy", arm), targets).mean() / away
    worn = settled_error(arm, load_wear("worn", arm), targets).mean() / away
    assert 0.011 < healthy < 0.023  # the myCobot: 0.018
    assert 0.05 < worn < 0.18  # the myCobot: 0.12
    assert worn > 3 * healthy
