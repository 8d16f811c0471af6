"""Laws of what sightings tell: noise is averaged out, links that float are followed, and no news changes nothing."""

import numpy as np
import pytest

from rejoint.arms import Displacement, mycobot280, position_kinematics, tcp_position
from rejoint.control.controllers.classical import IntegratorController
from rejoint.control.loop import Schedule, run
from rejoint.control.reference import TargetSequence
from rejoint.control.seeing import NOISE, Finishing, Seen, Sighting
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear
from standin import state_of

ARM = mycobot280()
POSTURE = ARM.rest + np.radians([20.0, -20.0, -30.0, 10.0, 5.0, 0.0])
PERIOD = 1 / 15
START = np.ones(1, dtype=bool)


class Told:
    """Gives the sightings that it is told."""

    def __init__(self, robot=None):
        self.robot, self.one, self.asked = robot, None, -np.inf

    def sighting(self, now):
        self.asked = now
        return self.one


def standing(shifts):
    """Return what an arm that stands makes of sightings ``shifts`` (K, 3) [m] beside its encoders: (K, 3) [m]."""
    eye, place, found = Told(), tcp_position(ARM, POSTURE), []
    seen = Seen(ARM, Displacement.none(ARM), eye=eye)
    seen.aim(place[None], POSTURE[None], START)
    for k, shift in enumerate(shifts):
        now = k * PERIOD
        eye.one = Sighting(time=now, place=place + shift)
        state = state_of(POSTURE, now)
        seen.again(state)
        missing = seen.missing(state)
        found.append(np.full(3, np.nan) if missing is None else -missing)
    return np.array(found)


def directions():
    """Return the one (3,) in which the base turns the tool, and two across it."""
    along = position_kinematics(ARM, POSTURE)[1][:, 0]
    along = along / np.linalg.norm(along)
    return along, np.linalg.svd(along[None])[2][1:]


@pytest.mark.parametrize("seed", range(3))
def test_noise_across_what_floats_is_averaged_to_less_than_half(seed):
    _, across = directions()
    shift = np.array([1e-3, -2e-3, 1e-3])
    noisy = shift + np.random.default_rng(seed).normal(0.0, NOISE, (60, 3))
    off = (standing(noisy)[15:] - shift) @ across.T
    assert np.sqrt((off**2).mean()) < 0.42 * NOISE


def test_a_link_that_floats_is_followed_within_two_sightings_and_others_by_degrees():
    along, across = directions()
    for direction, least, most in ((along, 0.9, 1.1), (across[0], 0.0, 0.6)):
        steps = np.zeros((20, 3))
        steps[12:] = 1e-3 * direction
        followed = standing(steps)[13] @ direction / 1e-3
        assert least < followed < most


class Frozen:
    """Sees the tool once, and then for ever the same."""

    def __init__(self, robot):
        self.robot, self.one = robot, None

    def sighting(self, now):
        if self.one is None:
            self.one = Sighting(time=now, place=self.robot.true_tcp()[0])
        return self.one


def test_a_picture_that_freezes_leaves_the_controller_to_the_model():
    targets = ARM.targets.sample(np.random.default_rng(11), (1, 2))
    commands = []
    for eye_of in (Frozen, Told):
        robot = EmulatedRobot(ARM, [load_wear("worn?seed=701", ARM)])
        seen = Seen(ARM, Displacement.none(ARM), eye=eye_of(robot))
        controller = Finishing(ARM, IntegratorController(ARM), seen)
        commands.append(
            run(robot, controller, TargetSequence(ARM, targets, correction=seen), Schedule(dwell=2.0)).command
        )
        assert seen.used <= 1
    np.testing.assert_array_equal(*commands)
