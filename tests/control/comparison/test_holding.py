"""What is driven beside a comparison: the arm as it was found, and poses come to from three directions."""

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.control.comparison.compare import Settings, TrialRunner, vary_directions
from rejoint.control.comparison.protocols import INSET, RISING_AHEAD, RISING_LEFT, iso_poses
from rejoint.control.comparison.result import Protocol, TargetErrors
from rejoint.control.controllers.classical import DefaultController
from standin import StandIn

ARM = mycobot280()
SHORT = Protocol(hold=1.5, window=0.3)
BEHIND = 2e-3
"""[m] by which the tool of a `Dragging` arm stays behind its encoders"""


class Dragging(StandIn):
    """Arms that go where they are sent at once, and whose tools stay behind along their last long way."""

    def __init__(self, count, seed):  # noqa: ARG002 - as robots are opened
        super().__init__(count)
        self.came, self.way = self.tcp(), np.eye(3)[[0] * count]

    def moved(self, command):
        way = self.tcp() - self.came
        length = np.linalg.norm(way, axis=1, keepdims=True)
        rested = (command == self.position).all(axis=1, keepdims=True) & (length > 1e-4)
        self.way = np.where(rested, way / np.maximum(length, 1e-9), self.way)
        self.came = np.where(rested, self.tcp(), self.came)
        return command.copy()

    def true_tcp(self):
        return self.tcp() - BEHIND * self.way


def holding(*, batched=True, **more):
    settings = Settings(batched=batched, repetitions=2, protocol=SHORT)
    return TrialRunner(Dragging, {"default": DefaultController}, np.zeros((1, 1, 3)), settings, **more)


@pytest.mark.parametrize(("plane", "across"), [(RISING_AHEAD, 0), (RISING_LEFT, 1)])
def test_the_poses_are_the_centre_and_four_near_the_corners_of_a_diagonal_plane(plane, across):
    poses, box = iso_poses(ARM, plane), ARM.targets
    share = (poses - box.lower) / (box.upper - box.lower)
    np.testing.assert_allclose(share[0], 0.5)
    np.testing.assert_allclose(np.minimum(share[1:], 1.0 - share[1:]), INSET)
    np.testing.assert_allclose(share[:, across], share[:, 2], err_msg="a plane through two opposite edges")


def test_a_tool_that_drags_behind_varies_with_the_direction_and_its_encoders_do_not():
    found = vary_directions(holding(), "default", ARM)
    assert (found.poses, found.cycles) == (5, 2)
    assert found.encoders.mean.value < 2e-4
    assert found.tool.mean.value == pytest.approx(np.sqrt(2.0) * BEHIND, rel=0.1), "directions at right angles"


def test_cycles_on_one_arm_are_driven_one_after_the_other():
    targets = ARM.targets.sample(np.random.default_rng(0), (3, 2))
    side_by_side = holding().hold("default", targets)
    in_turn = holding(batched=False).hold("default", targets)
    np.testing.assert_allclose(in_turn["settled"], side_by_side["settled"], atol=1e-6)
    np.testing.assert_allclose(in_turn["settled_true"], side_by_side["settled_true"], atol=1e-4)


class Beside:
    """A correction that aims 10 mm beside every target."""

    def aim(self, target, start, where, near=None, turn=None):  # noqa: ARG002 - the same beside each
        return target + np.array([0.0, 0.01, 0.0]), turn

    def again(self, target, inputs):  # noqa: ARG002 - once is enough
        return None


def test_the_arm_as_it_was_found_is_not_aimed():
    targets = ARM.targets.sample(np.random.default_rng(1), (2,))
    how = holding(correction=lambda _: Beside())
    aimed = how.hold("default", targets[None])["settled_true"][0]
    found = TargetErrors.of(how.hold("default", targets[None], corrected=False))
    assert [error.how for error in found.true] == ["known", "known"]
    np.testing.assert_allclose([error.value for error in found.true], BEHIND, rtol=0.1)
    assert (aimed > 0.007).all()
