"""The command law around the feed-forward controller: what it raises, remembers and forgets."""

from dataclasses import replace

import numpy as np
import pytest

from rejoint.arms import gravity_torque, mycobot280, position_kinematics, solve_position, tcp_position
from rejoint.arms.postures import find_postures
from rejoint.arms.workspace import heaviest_load
from rejoint.control.controllers.feedforward import Commander, CommandLaw
from rejoint.control.controllers.observation import look
from rejoint.system.errors import InputError
from standin import inputs_of, state_of

ARM = mycobot280()
STIFFNESS = (5.0, 6.0, 7.0, 4.0, 5.0, 6.0)
LAW = CommandLaw(loosen=0.0, anchor="goal", stiffness=STIFFNESS, authority_floor=0.002)
EVERY = np.ones(2, dtype=bool)
NOTHING = np.zeros((2, 6))
MOVES = np.array([1, 1, 1, 1, 1, 0])  # the last joint only turns the tool, and is left alone


def inputs(position, target, time=0.0):
    state = state_of(position, time)
    goal = find_postures(ARM, target, position, None)
    return inputs_of(state, target, goal, position)


def command(commander, now, action):
    return commander.commands(now, look(ARM, now.state.position, now.target, now.goal), action)


def begun(target=None, law=LAW):
    """A commander of two arms at rest, and what it was told."""
    rest = np.tile(ARM.rest, (2, 1))
    now = inputs(rest, tcp_position(ARM, rest) if target is None else target)
    commander = Commander(ARM, law)
    commander.reset(now, EVERY)
    return commander, now


def test_without_error_or_action_it_sends_the_goal_raised_by_its_sag():
    targets = ARM.targets.sample(np.random.default_rng(1), (2,))
    goal = solve_position(ARM, targets, np.tile(ARM.rest, (2, 1))).q
    commander, _ = begun(targets)
    now = inputs(goal, tcp_position(ARM, goal))
    expected = goal + gravity_torque(ARM, goal) / np.array(STIFFNESS)
    np.testing.assert_allclose(command(commander, now, NOTHING), expected, atol=1e-12)


def test_an_action_is_remembered_until_the_arm_is_exchanged():
    commander, now = begun()
    before = command(commander, now, NOTHING)
    pushed = command(commander, now, np.full((2, 6), 2.0))  # beyond 1 counts as 1
    np.testing.assert_allclose(pushed - before, [LAW.authority_floor * MOVES] * 2, atol=1e-12)
    np.testing.assert_allclose(command(commander, now, NOTHING), pushed, atol=1e-12)
    commander.reset_learned(now, np.array([True, False]))
    commander.reset(now, np.array([True, False]))
    after = command(commander, now, NOTHING)
    np.testing.assert_allclose(after[0], before[0], atol=1e-12)
    np.testing.assert_allclose(after[1], pushed[1], atol=1e-12)


def test_at_the_target_no_action_moves_the_arm():
    commander, now = begun(law=replace(LAW, authority_floor=0.0))
    before = command(commander, now, NOTHING)
    np.testing.assert_array_equal(command(commander, now, np.ones((2, 6))), before)


def learned_part(away: float) -> tuple[np.ndarray, np.ndarray]:
    """What a commander has learned (n,) [rad], and what is left of it at a new target ``away`` [m]."""
    (moved, now), (fresh, _) = begun(), begun()
    then = replace(now, target=now.target + np.array([0.0, 0.0, away]))
    before = command(moved, now, NOTHING)
    learned = command(moved, now, np.ones((2, 6))) - before
    for commander in (moved, fresh):
        commander.reset(then, EVERY)
    kept = command(moved, then, NOTHING) - command(fresh, then, NOTHING)
    return learned[0], kept[0]


def test_a_target_far_away_keeps_what_moves_the_tool_and_drops_the_rest() -> None:
    learned, kept = learned_part(away=0.05)
    jacobian = position_kinematics(ARM, ARM.rest)[1]
    assert np.linalg.norm(kept) < np.linalg.norm(learned)
    least = np.linalg.pinv(jacobian) @ (jacobian @ learned)  # the smallest motion with the same effect
    np.testing.assert_allclose(kept, least, atol=1e-6)


def test_a_corrected_aim_moves_no_joint_that_stands_for_the_tool() -> None:
    learned, kept = learned_part(away=0.001)
    np.testing.assert_allclose(kept, learned, atol=1e-12)


def test_what_is_learned_is_bounded():
    targets = ARM.targets.sample(np.random.default_rng(2), (2,))
    commander, now = begun(targets, replace(LAW, envelope_margin=10.0))
    first = command(commander, now, NOTHING)
    for cycle in range(300):
        last = command(commander, inputs(now.state.position, now.target, 0.02 * cycle), np.ones((2, 6)))
    assert np.abs(last - first).max() <= LAW.learning.learned_limit + 1e-9
    assert np.abs(last - first).max() > 0.9 * LAW.learning.learned_limit


def test_commands_stay_near_the_goal():
    """The null space holds a joint that turns the tool only: what is learned there may add up, but not for ever."""
    commander, now = begun()
    for _ in range(600):
        q = command(commander, now, np.ones((2, 6)))
    away = np.abs(q - ARM.rest).max(axis=0)
    assert (away <= LAW.envelope_margin + 1e-12).all()
    assert away.max() >= 0.9 * LAW.envelope_margin


def test_the_stiffness_of_every_servo_is_needed():
    with pytest.raises(InputError, match="stiffness of 6 servos, got"):
        Commander(ARM, CommandLaw(anchor="goal"))


@pytest.mark.parametrize(("distance", "near"), [(0.0003, 1.0 / 1.01), (0.003, 0.5), (0.09, 1.0 / 901.0)])
def test_near_the_target_the_heaviest_joint_is_spared(distance, near):
    rest = np.tile(ARM.rest, (2, 1))
    target = tcp_position(ARM, rest) + np.array([0.6, 0.0, 0.8]) * distance
    moved = {}
    for law in (LAW, replace(LAW, load_penalty=3.0)):
        commander, _ = begun(target, law)
        first, second = (command(commander, inputs(rest, target, t), NOTHING) for t in (0.0, 0.02))
        moved[law.load_penalty] = (second - first)[0]
    share = heaviest_load(ARM) / heaviest_load(ARM)[1]  # the shoulder's is the largest
    expected = moved[0.0] * (1.0 - near * (1.0 - 1.0 / (1.0 + 3.0 * share)))
    np.testing.assert_allclose(moved[3.0], expected, rtol=1e-6, atol=1e-12)
    assert abs(moved[0.0][1]) > 1e-6
