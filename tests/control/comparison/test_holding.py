"""What is driven beside a comparison: the arm as it was found, and poses come to from three directions."""

import numpy as np
import pytest

from rejoint.arms import mycobot280, tcp_position
from rejoint.control.classical import DefaultController
from rejoint.control.comparison.holding import Holding, found_errors, vary_directions
from rejoint.control.comparison.protocols import INSET, RISING_AHEAD, iso_poses
from rejoint.control.comparison.result import Protocol
from rejoint.control.robot import JointState

ARM = mycobot280()
SHORT = Protocol(hold=1.5, window=0.3)
BEHIND = 2e-3
"""[m] by which the tool of a `Dragging` arm stays behind its encoders"""


class Dragging:
    """Arms that go where they are sent at once, and whose tools stay behind along their last long way."""

    address, arm = "test", ARM

    def __init__(self, count, seed):  # noqa: ARG002 - as robots are opened
        self.count, self._now = count, np.zeros(count)
        self._position = np.tile(ARM.rest, (count, 1))
        self._came = np.tile(tcp_position(ARM, ARM.rest), (count, 1))
        self._way = np.tile([1.0, 0.0, 0.0], (count, 1))

    def read(self):
        return JointState(time=self._now.copy(), position=self._position.copy(), age=np.zeros(self.count))

    def step(self, command, active=None):  # noqa: ARG002 - all of them move
        moved = np.abs(command - self._position).max(axis=1) > 1e-9
        rested = ~moved & (np.abs(self._place() - self._came).max(axis=1) > 1e-4)
        way = self._place() - self._came
        length = np.linalg.norm(way, axis=1, keepdims=True)
        self._way = np.where(rested[:, None], way / np.maximum(length, 1e-9), self._way)
        self._came = np.where(rested[:, None], self._place(), self._came)
        self._position, self._now = command.copy(), self._now + 0.025
        return self.read()

    def _place(self):
        return tcp_position(ARM, self._position)

    def true_tcp(self):
        return self._place() - BEHIND * self._way

    def stop(self):
        pass

    close = stop


def holding(**more):
    return Holding(**{"open_robot": Dragging, "batched": True, "seed": 0} | more)


def test_the_poses_are_the_centre_and_four_near_the_corners_of_a_diagonal_plane():
    poses, box = iso_poses(ARM, RISING_AHEAD), ARM.targets
    share = (poses - box.lower) / (box.upper - box.lower)
    np.testing.assert_allclose(share[0], 0.5)
    np.testing.assert_allclose(np.minimum(share[1:], 1.0 - share[1:]), INSET)
    np.testing.assert_allclose(share[:, 0], share[:, 2], err_msg="a plane through two opposite edges")


def test_a_tool_that_drags_behind_varies_with_the_direction_and_its_encoders_do_not():
    found = vary_directions(holding(), "default", DefaultController, ARM, 2, SHORT)
    assert (found.poses, found.cycles) == (5, 2)
    assert found.encoders.mean.value < 2e-4
    assert found.tool.mean.value == pytest.approx(np.sqrt(2.0) * BEHIND, rel=0.1), "directions at right angles"


def test_cycles_on_one_arm_are_driven_one_after_the_other():
    targets = ARM.targets.sample(np.random.default_rng(0), (3, 2))
    side_by_side = holding().hold(DefaultController, targets, SHORT)
    in_turn = Holding(open_robot=Dragging, batched=False, seed=0).hold(DefaultController, targets, SHORT)
    np.testing.assert_allclose(in_turn["settled"], side_by_side["settled"], atol=1e-6)
    np.testing.assert_allclose(in_turn["settled_true"], side_by_side["settled_true"], atol=1e-4)


class Beside:
    """A correction that aims 10 mm beside every target."""

    def aim(self, target, start, where, near=None):  # noqa: ARG002 - the same beside each
        return target + np.array([0.0, 0.01, 0.0])

    def again(self, target, inputs):  # noqa: ARG002 - once is enough
        return None


def test_the_arm_as_it_was_found_is_not_aimed():
    targets = ARM.targets.sample(np.random.default_rng(1), (2,))
    how = holding(correction=lambda _: Beside())
    aimed = how.hold(DefaultController, targets[None], SHORT)["settled_true"][0]
    found = found_errors(how, DefaultController, targets, SHORT)
    assert [error.how for error in found.true] == ["known", "known"]
    np.testing.assert_allclose([error.value for error in found.true], BEHIND, rtol=0.1)
    assert (aimed > 0.007).all()
