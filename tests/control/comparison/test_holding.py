"""What is driven beside a comparison: the arm as it was found."""

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.control.comparison.compare import Settings, TrialRunner
from rejoint.control.comparison.protocols import INSET, iso_poses
from rejoint.control.comparison.result import Protocol
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


def holding(targets, *, batched=True, **more):
    settings = Settings(batched=batched, protocol=SHORT)
    return TrialRunner(Dragging, {"default": DefaultController}, targets[None], settings, **more)


def test_the_poses_are_the_centre_and_four_near_the_corners_of_a_diagonal_plane():
    poses, box = iso_poses(ARM), ARM.targets
    share = (poses - box.lower) / (box.upper - box.lower)
    np.testing.assert_allclose(share[0], 0.5)
    np.testing.assert_allclose(np.minimum(share[1:], 1.0 - share[1:]), INSET)
    np.testing.assert_allclose(share[:, 1], share[:, 2], err_msg="a plane through two opposite edges")


class Beside:
    """A correction that aims 10 mm beside every target."""

    def aim(self, target, start, where, near=None, turn=None):  # noqa: ARG002 - the same beside each
        return target + np.array([0.0, 0.01, 0.0]), turn

    def again(self, state):  # noqa: ARG002 - once is enough
        return None


@pytest.mark.parametrize("batched", [True, False])
def test_the_arm_as_it_was_found_is_not_aimed(batched):
    targets = ARM.targets.sample(np.random.default_rng(1), (2,))
    runner = holding(targets, batched=batched, correction=Beside())
    found = runner.as_found()
    assert [error.how for error in found.true] == ["known", "known"]
    np.testing.assert_allclose([error.value for error in found.true], BEHIND, rtol=0.1)
    assert (runner.compare().array("settled_true", "default") > 0.007).all()
