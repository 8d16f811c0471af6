"""A wear profile on arms of other sizes: similarity laws, and arms that nobody here designed."""

import dataclasses

import numpy as np
import pytest

from modelfiles import resized
from rejoint.arms import mycobot280
from rejoint_lab.plant.plant import Plant
from rejoint_lab.plant.wear import (
    PARAMETERS,
    effort,
    load_wear,
)

ARM = mycobot280()
HEAVY = dataclasses.replace(ARM, name="heavy", mass=16.0 * ARM.mass, inertia=16.0 * ARM.inertia)
SCALING = ("healthy", "play-in-loop", "worn", "worn-true")


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
    one.set_power(False)
    other.set_power(False)
    for _ in range(20):  # down upon the mechanical stops
        one.advance(0.1)
        other.advance(0.1)
    np.testing.assert_array_equal(other.link_position(), one.link_position())
