"""Bringing joints to postures: on the emulated worn arm, and by the parts of the law."""

from dataclasses import replace

import numpy as np
import pytest

from rejoint.arms import mycobot280, tcp_position
from rejoint.control.controllers import posture as posture_control
from rejoint.control.controllers.feedforward import FeedforwardController
from rejoint.control.controllers.posture import PostureController, _without
from rejoint.control.guard import GuardLimits
from rejoint.control.loop import Schedule, run
from rejoint.control.reference import Reference, ToolAtGoals
from rejoint.control.robot import Stillness
from rejoint.control.start import move
from rejoint.robots import open_robot
from rejoint.twin.parameters import nominal_parameters
from rejoint_lab.plant.wear import load_wear
from standin import inputs_of, state_of

ARM = mycobot280()
DWELL, SPEED = 6.0, np.radians(60.0)


class Ways(Reference):
    """Each arm goes from rest to its postures (B, K, n), one after the other."""

    def __init__(self, postures):
        self.postures, self.count = postures, len(postures)
        self.reference = np.repeat(ARM.rest[None], len(postures), axis=0)
        self.began: np.ndarray | None = None

    def advance(self, now):
        state = now.state
        if self.began is None:
            self.began = self.last = state.time.copy()
        k = np.minimum((state.time - self.began) // DWELL, self.postures.shape[1] - 1).astype(int)
        goal = self.postures[np.arange(len(k)), k]
        reach = SPEED * (state.time - self.last)[:, None]
        self.reference = self.reference + np.clip(goal - self.reference, -reach, reach)
        self.last = state.time.copy()
        return replace(now, goal=self.reference.copy(), arrived=(self.reference == goal).all(axis=1))


def test_stillness_by_hand():
    still, step, stood = Stillness(1.5), np.array([[1.0, 0.0]]), [0, 1, 2, 3, 0, 0.5]
    times, moved = [5.0, 6.0, 7.0, 8.0, 9.0, 9.5], [0, 0, 1, -1, 2, 3]  # an encoder flickers, then the joint moves
    found = [still.look(np.array([time]), k * step)[0] for time, k in zip(times, moved, strict=True)]
    np.testing.assert_array_equal(np.transpose(found), [stood, [0, 1, 2, 3, 4, 4.5]])


def test_a_worn_arm_comes_to_postures_and_stays():
    rng = np.random.default_rng(7)
    count = 6
    postures = ARM.rest + rng.uniform(-1, 1, (count, 3, 6)) * np.radians([30, 12, 15, 10, 15, 40])
    stiffness = np.asarray(load_wear("worn", ARM).position_gain)
    controller = PostureController(ARM, replace(nominal_parameters(ARM), stiffness=stiffness, offset=np.zeros(6)))
    robot = open_robot("emulated:worn", seed=1, count=count, period=(0.05, 0.05))
    start = move(robot, ARM.rest)
    schedule = Schedule(dwell=3 * DWELL, sent=start.command[-1])
    found = run(robot, controller, Ways(postures), schedule, limits=GuardLimits.of(ARM))
    assert not found.tripped.any()
    since, errors = found.time - found.time[0], []
    for b, k in np.ndindex(count, 3):
        rows = (since[:, b] > (k + 1) * DWELL - 0.8) & (since[:, b] < (k + 1) * DWELL)
        place = tcp_position(ARM, postures[b, k])
        errors.append(np.linalg.norm(tcp_position(ARM, found.position[rows, b]) - place, axis=-1).mean())
    assert np.median(errors) < 0.6e-3
    assert np.mean(errors) < 1e-3


def test_a_controller_to_points_brings_the_tool_where_joints_are_to_bring_it():
    postures = ARM.rest + np.radians([[[20.0, 8.0, -10.0, 5.0, 8.0, 20.0], [-20.0, -8.0, 10.0, -5.0, 0.0, 0.0]]])
    robot = open_robot("emulated:worn", seed=1, period=(0.05, 0.05))
    start = move(robot, ARM.rest)
    reference, schedule = ToolAtGoals(ARM, Ways(postures)), Schedule(dwell=1.8 * DWELL, sent=start.command[-1])
    found = run(robot, FeedforwardController(ARM), reference, schedule)
    tool = tcp_position(ARM, found.position[:, 0])
    assert np.linalg.norm(tool - tcp_position(ARM, postures[0, 0]), axis=-1).min() < 1e-3
    assert np.linalg.norm(tool[-1] - tcp_position(ARM, postures[0, 1])) < 1e-3


def test_other_joints_bring_the_tool_to_its_place_where_one_is_weak():
    rng = np.random.default_rng(2)
    posture = ARM.rest + rng.uniform(-0.3, 0.3, (20, 6))
    weak = np.zeros((20, 6), dtype=bool)
    weak[:, 3] = True
    position = posture - weak * np.radians(10.0)
    goal = _without(ARM, posture, position, weak)
    np.testing.assert_array_equal(goal[:, 3], position[:, 3])
    away = np.linalg.norm(tcp_position(ARM, goal) - tcp_position(ARM, posture), axis=-1)
    assert away.max() < 1e-4
    nothing = _without(ARM, posture, posture, np.zeros_like(weak))
    np.testing.assert_allclose(nothing, posture, atol=1e-9)


def told(position, sent, time=0.0):
    state = state_of(position, time)
    return inputs_of(state, np.full((1, 3), np.nan), sent, sent, time)


@pytest.mark.parametrize("offset", [0.0, 0.02])
def test_it_begins_with_the_command_in_force(offset, monkeypatch):
    sent = ARM.rest[None] + 0.05
    monkeypatch.setattr(posture_control, "PUSH", 0.0)
    controller = PostureController(ARM, replace(nominal_parameters(ARM), offset=np.full(6, offset)))
    np.testing.assert_allclose(controller.command(told(ARM.rest, sent)), sent, atol=1e-12)


def test_nothing_winds_up_in_an_arm_that_rests():
    controller, step = PostureController(ARM), 0.05
    position = ARM.rest - np.radians([0.0, 0.0, 0.0, 0.0, 0.0, 0.3])  # joint 6 turns the tool and hardly moves it
    before = sent = ARM.rest[None]
    for cycle in range(1200):  # a minute
        before, sent = sent, controller.command(told(position, sent, cycle * step))
    np.testing.assert_array_equal(sent, before, "it rests")
    position = position + np.radians([1.0, 0.0, 0.0, 0.0, 0.0, 0.09])  # something moves the tool, and joint 6 a count
    after = controller.command(told(position, sent, 1200 * step))
    assert np.abs(after - sent)[0, 1:].max() < np.radians(1.0), np.degrees(after - sent).round(1)
