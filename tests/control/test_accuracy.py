"""A true error says how it is known, and what is known is never mixed with what is modelled."""

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.control.comparison.compare import Settings, TrialRunner
from rejoint.control.comparison.result import Protocol
from rejoint.control.controllers.classical import DefaultController
from rejoint.control.correction import NOT_KNOWN, TrueError, mean_modelled, modelled
from rejoint.control.moving.drive import Deployment
from rejoint.robots import open_robot
from targetdrive import deploy

ARM = mycobot280()
TARGETS = ARM.targets.sample(np.random.default_rng(2), (2,))
QUICK = Protocol(dwell=1.0, hold=1.2, window=0.4)


class Model:
    """Says 2 mm, 1 to 4, everywhere."""

    def distance(self, position, target):  # noqa: ARG002
        return np.multiply.outer([2e-3, 1e-3, 4e-3], np.ones(position.shape[:-1]))


def blinded(robot):
    """The robot, that does not know where its tool is."""
    robot.true_tcp = lambda: np.full((robot.count, 3), np.nan)
    return robot


def test_the_mean_of_modelled_errors_has_the_means_of_their_ends():
    found = np.array([[1.0, 3.0, np.nan], [0.5, 1.5, np.nan], [2.0, 8.0, np.nan]])
    assert mean_modelled(found) == TrueError(how="modelled", value=2.0, low=1.0, high=5.0)
    assert mean_modelled(np.full((3, 2), np.nan)) == NOT_KNOWN


def test_where_the_arm_did_not_come_nothing_is_modelled():
    position = np.array([ARM.rest, np.full(ARM.joints, np.nan)])
    found = modelled(Model(), position, TARGETS)
    np.testing.assert_allclose(found[:, 0], [2e-3, 1e-3, 4e-3])
    assert np.isnan(found[:, 1]).all()


@pytest.mark.parametrize(
    ("blind", "model", "how"),
    [(False, None, "known"), (False, Model(), "known"), (True, Model(), "modelled"), (True, None, "not known")],
)
def test_a_deployment_tells_the_true_error_and_how_it_is_known(blind, model, how):
    robot = open_robot("emulated:worn", seed=1)
    job = Deployment(controller="default", targets=TARGETS[:1], dwell=0.5)
    _, found = deploy(blinded(robot) if blind else robot, DefaultController(ARM), job, model=model)
    (visit,) = found.visits
    assert visit.true_error.how == how
    if how == "modelled":
        assert (visit.true_error.value, visit.true_error.low, visit.true_error.high) == (2e-3, 1e-3, 4e-3)
    else:
        assert (visit.true_error.value is None) == (how == "not known")
        assert visit.true_error.value is None or visit.true_error.value > 3e-3


@pytest.mark.parametrize("blind", [False, True])
def test_a_comparison_models_only_what_nobody_knows(blind):
    def connect(count, seed):
        robot = open_robot("emulated:worn", count=count, seed=seed)
        return blinded(robot) if blind else robot

    settings = Settings(repetitions=2, seed=1, batched=True, protocol=QUICK)
    found = TrialRunner(connect, {"default": DefaultController}, TARGETS[None], settings, model=Model()).compare()
    hold = found.rows[0]
    if blind:
        assert hold.settled_true is None
        assert hold.accuracy_true is None
        assert hold.true_error == hold.settled_modelled
        np.testing.assert_allclose(
            [hold.true_error.value, hold.true_error.low, hold.true_error.high], [2e-3, 1e-3, 4e-3]
        )
    else:
        assert hold.settled_modelled is None
        assert hold.true_error == TrueError.of("known", hold.settled_true.mean)
