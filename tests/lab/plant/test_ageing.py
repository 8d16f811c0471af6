import numpy as np
import pytest

from rejoint.arms import load_arm
from rejoint_lab.plant.plant import Plant
from rejoint_lab.plant.wear import LIFE, PARAMETERS, damages, load_wear, severity

ARM = load_arm("mycobot280")
HEALTHY = load_wear("healthy", ARM)
HOURS = (0.0, 3.0, 20.0, 47.5, 300.0, 1000.0, 4000.0)
WORSE = {
    "coulomb": 1,
    "stiction": 1,
    "load_friction": 1,
    "ripple": 1,
    "torque_noise": 1,
    "play": 1,
    "position_gain": -1,
    "link_stiffness": -1,
    "torque_limit": -1,
    "damping_gain": -1,
}


def test_no_hours_are_no_wear():
    fresh, drawn = load_wear("healthy?seed=4&hours=0", ARM), load_wear("healthy?seed=4", ARM)
    for name in PARAMETERS:
        np.testing.assert_allclose(getattr(fresh, name), getattr(drawn, name), rtol=1e-15)


@pytest.mark.parametrize("profile", ["healthy", "worn"])
def test_wear_only_grows_and_the_same_seed_ages_alike(profile):
    arms = [load_wear(f"{profile}?seed=4&hours={hours}", ARM) for hours in HOURS]
    for name, sign in WORSE.items():
        values = sign * np.array([getattr(arm, name) for arm in arms])
        assert (np.diff(values, axis=0) >= -1e-15).all(), name
    again = load_wear(f"{profile}?seed=4&hours=300", ARM)
    assert all((getattr(again, name) == getattr(arms[4], name)).all() for name in PARAMETERS)


def test_wear_goes_with_load_and_travel():
    """Shoulder and elbow carry the arm; the last joint turns for no target, and so never wears."""
    rate = severity(HEALTHY, ARM)
    assert rate[1] > rate[2] > rate[3] > rate[4] > rate[5] >= 0.0
    assert rate[5] < 1e-9
    mean = np.mean([damages(HEALTHY, ARM, LIFE, seed) for seed in range(200)], axis=(0, 1))
    np.testing.assert_allclose(mean, rate, rtol=0.06, atol=1e-9)  # a damage of one is a life of mean load and travel


def test_warmth_is_a_state_and_no_wear():
    cold, warm = (load_wear(f"healthy?seed=4&hours=300&ambient={ambient}", ARM) for ambient in (25, 35))
    assert (warm.play == cold.play).all()
    assert (warm.position_gain == cold.position_gain).all()
    assert (warm.coulomb < cold.coulomb).all()
    assert 0.0 < np.abs(warm.offset - cold.offset).max() <= np.radians(0.2)
    assert Plant(ARM, [cold, warm], seed=0).temperature.tolist() == [[25.0] * 6, [35.0] * 6]
