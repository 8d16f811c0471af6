"""Laws of the finish: the tool comes to where it is seen to be at its target, and stays there."""

from collections import deque

import numpy as np
import pytest

from rejoint.arms import Displacement, mycobot280
from rejoint.control.controllers.classical import IntegratorController
from rejoint.control.guard import TRIPS
from rejoint.control.loop import Schedule, run
from rejoint.control.reference import TargetSequence
from rejoint.control.seeing import CALM, WIDEST, Finishing, Seen, Sighting
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear

ARM = mycobot280()
TARGETS = ARM.targets.sample(np.random.default_rng(11), (1, 3))
DWELL = 4.0


class Watching:
    """Sees the tool ``rate`` times a second, ``late`` [s]; hidden in an interval; every ``lost``-th is lost."""

    def __init__(self, robot, *, rate=15.0, late=0.1, hidden=(np.inf, np.inf), lost=0, wrong=0):
        self.robot, self.rate, self.late, self.hidden, self.lost, self.wrong = robot, rate, late, hidden, lost, wrong
        self.rng, self.taken, self.count = np.random.default_rng(0), deque(maxlen=50), 0
        self.last = -np.inf

    def sighting(self, now):
        if now - self.last >= 1.0 / self.rate:
            self.last, self.count = now, self.count + 1
            place = self.robot.true_tcp()[0] + self.rng.normal(0.0, 1e-4, 3)
            if self.wrong and self.count % self.wrong == 0:
                place = place + 0.04
            gone = self.lost and self.count % self.lost
            if not gone and not self.hidden[0] <= now < self.hidden[1]:
                self.taken.append(Sighting(time=now, place=place))
        ready = [one for one in self.taken if now - one.time >= self.late]
        return ready[-1] if ready else None


def driven(*, wear="worn?seed=701", **seeing):
    robot = EmulatedRobot(ARM, [load_wear(wear, ARM)])
    seen = Seen(ARM, Displacement.none(ARM), eye=Watching(robot, **seeing))
    controller = Finishing(ARM, IntegratorController(ARM), seen)
    states = []
    recording = run(
        robot,
        controller,
        TargetSequence(ARM, TARGETS, correction=seen),
        Schedule(dwell=DWELL),
        on_cycle=lambda _: states.append(controller.state),
    )
    return recording, np.array(states), seen


def true_errors(recording):
    at = (recording.since_target[:, 0] > DWELL - 0.2) & (recording.since_target[:, 0] <= DWELL)
    error = np.linalg.norm(recording.true_tcp - recording.target, axis=-1)[:, 0]
    return np.array([error[at & (recording.target_index[:, 0] == k)].mean() for k in range(TARGETS.shape[1])])


@pytest.fixture(scope="module")
def blind():
    """What the controller does by itself."""
    robot = EmulatedRobot(ARM, [load_wear("worn?seed=701", ARM)])
    return run(robot, IntegratorController(ARM), TARGETS, Schedule(dwell=DWELL))


def test_the_tool_of_a_worn_arm_comes_nearer_than_any_controller_brings_it(blind):
    recording, states, seen = driven()
    assert true_errors(blind).mean() > 4e-3
    assert true_errors(recording).mean() < 1e-3
    assert {"far", "fine"} <= set(states)
    assert len(seen.visits) == TARGETS.shape[1]
    for (count, told), true in zip(seen.visits, true_errors(recording), strict=True):
        assert count > 5
        assert abs(told - true) < 0.6e-3


@pytest.mark.parametrize("seeing", [{"rate": 30.0, "late": 0.05}, {"rate": 10.0, "late": 0.15}, {"lost": 2}])
def test_rate_delay_and_lost_sightings_do_not_matter_much(seeing):
    assert true_errors(driven(**seeing)[0]).mean() < 1.3e-3


def test_wrong_sightings_are_not_believed():
    assert true_errors(driven(wrong=4)[0]).mean() < 1.2e-3


def test_a_hidden_tool_leaves_the_controller_alone(blind):
    recording, states, seen = driven(hidden=(0.0, np.inf))
    assert set(states) == {"far"}
    assert [count for count, _ in seen.visits] == [0] * TARGETS.shape[1]
    np.testing.assert_array_equal(recording.command, blind.command)


def test_a_tool_that_is_hidden_on_the_way_is_left_where_it_is_held_or_to_the_controller():
    recording, states, _ = driven(hidden=(2.0, np.inf))
    time = recording.time[:, 0] - recording.time[0, 0]
    assert "fine" in states[time < 2.0]
    assert "fine" not in states[time > 3.0]
    assert true_errors(recording).max() < 0.012


def test_what_holds_does_not_drift_or_move():
    recording, states, _ = driven(wear="healthy")
    held = (states[1:] == "hold") & (states[:-1] == "hold")
    assert held.sum() > 40
    step = np.abs(np.diff(recording.command[:, 0], axis=0))[held & (np.diff(recording.target_index[:, 0]) == 0)]
    assert step.max() == 0.0
    assert true_errors(recording).mean() < 2.5 * CALM


def test_commands_pass_the_guard_and_swing_no_wider_than_said():
    recording, states, _ = driven()
    fine = (states == "fine")[1:] & (states == "fine")[:-1]
    step = np.abs(np.diff(recording.command[:, 0], axis=0))[fine]
    assert step.max() < 2.0 * WIDEST + np.radians(2.0)
    assert not (recording.reasons & np.uint16(TRIPS.value)).any()
