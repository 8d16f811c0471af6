"""Plans on twins that are right, wrong and lost, and the hand-over from the plan to what holds the arm."""

from dataclasses import replace

import numpy as np
import pytest

from rejoint.arms import mycobot280, tcp_position
from rejoint.control.controllers.catalogue import shelf_path
from rejoint.control.controllers.feedforward import FeedforwardController
from rejoint.control.controllers.policy import load_policy
from rejoint.control.loop import Schedule, run
from rejoint.training.ranges import BroadRanges
from rejoint.twin import predictive
from rejoint.twin.predictive import LATE, Planner, PredictiveController
from rejoint.twin.simulation import Draw, TwinRobot

ARM = mycobot280()
RANGES = BroadRanges(arm=ARM, weak_joints=0.0, torque_limit=(2.0, 3.0), coulomb=(0.0, 0.4), period=(0.024, 0.026))
TARGETS = ARM.targets.sample(np.random.default_rng(3), (2, 1))


@pytest.fixture(autouse=True)
def changed(monkeypatch):
    """Change constants of the plan; few candidates are enough for the tests."""
    monkeypatch.setattr(predictive, "SAMPLES", 12)
    return lambda **values: [monkeypatch.setattr(predictive, name, value) for name, value in values.items()]


class PlanAlone:
    """Sends what is planned, to the end."""

    name = "plan"

    def __init__(self, planner):
        self.planner = planner
        self.reset = planner.reset

    def command(self, inputs):
        self.planner.follow(inputs)
        return self.planner.command(inputs)


def drawn():
    """Two arms, and their twins as an identification has them: the whole delay lies on the way out."""
    draw = RANGES.draw(np.random.default_rng(11), 2)
    whole = replace(draw.twin, delay=draw.command_delay + draw.readback_delay)
    return draw, Draw.of(whole)


def drive(draw, controller, dwell=2.5):
    return run(TwinRobot(ARM, draw, seed=0), controller, TARGETS, Schedule(dwell=dwell, keep_going=True))


def final_error(draw, controller):
    tail = tcp_position(ARM, drive(draw, controller).position[-20:])
    return np.linalg.norm(tail - TARGETS[:, 0], axis=-1).mean(axis=0)


def wrong_twins(twins, factor):
    twin = twins.twin
    return replace(twins, twin=replace(twin, stiffness=factor * twin.stiffness, offset=twin.offset + np.radians(1.0)))


@pytest.mark.parametrize("fed", [0.0, 0.9])
def test_with_the_right_model_the_plan_settles_at_the_target(fed):
    draw, twins = (replace(one, twin=replace(one.twin, compensation=fed + 0.0 * one.twin.offset)) for one in drawn())
    assert final_error(draw, PlanAlone(Planner(ARM, twins))).max() < 1.0e-3


def test_a_wrong_model_leaves_no_lasting_error(changed):
    draw, twins = drawn()
    wrong = wrong_twins(twins, 1.25)
    changed(OFFSET_RATE=4.0)  # no holder takes over here
    assert final_error(draw, PlanAlone(Planner(ARM, wrong))).max() < 1.5e-3
    changed(OFFSET_RATE=0.0)
    assert final_error(draw, PlanAlone(Planner(ARM, wrong))).max() > 3.0e-3


def test_the_shadow_of_the_right_model_is_the_arm(changed):
    changed(CORRECTION=0.0, OFFSET_RATE=0.0)
    draw, twins = drawn()
    none = 0.0 * draw.twin.coulomb
    draw = replace(draw, twin=replace(draw.twin, coulomb=none), gravity_scale=np.ones(2))
    twins = replace(twins, twin=replace(twins.twin, coulomb=none))
    robot = TwinRobot(ARM, draw, seed=0)
    planner = Planner(ARM, twins)
    missed = []

    def watch(cycle):
        if len(missed) > 0 or cycle.since_target[0] > 0.0:
            missed.append(np.abs(planner.shadow.twins.qpos - cycle.position).max())

    schedule = Schedule(dwell=1.0, keep_going=True, sent=robot.simulation.reference.position.copy())
    run(robot, PlanAlone(planner), TARGETS, schedule, on_cycle=watch)
    # Encoder counts, and another number of physics steps per cycle.
    assert np.max(missed) < np.radians(1.0)
    assert np.mean(missed) < np.radians(0.25)


class Spy:
    """Notes when it is left the arm, and what it said then."""

    name = "spy"

    def __init__(self, holder):
        self.holder, self.reset, self.taken, self.jump = holder, holder.reset, {}, []
        self._at = None

    def take_over(self, inputs, where):
        self.holder.take_over(inputs, where)
        self._at = where
        for i in np.flatnonzero(where):
            self.taken.setdefault(int(i), float(inputs.since_target[i]))

    def command(self, inputs):
        held = self.holder.command(inputs)
        if self._at is not None:
            self.jump.append(np.abs(held - inputs.sent)[self._at].max())
            self._at = None
        return held


@pytest.mark.parametrize("holder", [FeedforwardController, lambda arm: load_policy(shelf_path(arm.name), arm)])
def test_the_last_millimetres_are_left_to_another_without_a_jump(holder):
    draw, twins = drawn()
    spy = Spy(holder(ARM))
    error = final_error(draw, PredictiveController(ARM, twins, spy))
    assert error.max() < 2.5e-3
    assert set(spy.taken) == {0, 1}
    assert max(spy.taken.values()) < LATE + 0.05
    assert max(spy.jump) < np.radians(1.0)  # of a command that has led by some ten degrees


def test_a_plan_that_is_lost_is_left_at_once(changed):
    draw, twins = drawn()
    changed(AT_TARGET=0.0, LATE=np.inf)
    right, lost = Spy(FeedforwardController(ARM)), Spy(FeedforwardController(ARM))
    drive(draw, PredictiveController(ARM, twins, right), dwell=1.0)
    drive(draw, PredictiveController(ARM, wrong_twins(twins, 0.2), lost), dwell=1.0)
    assert not right.taken
    assert set(lost.taken) == {0, 1}
    assert max(lost.taken.values()) < 0.6
