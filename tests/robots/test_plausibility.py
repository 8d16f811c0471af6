"""What a myCobot can possibly answer, and what the client makes of what it is given."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rejoint.arms import mycobot280
from rejoint.robots.busrobot import Continuity, judge
from rejoint.robots.mycobot.bus import HIGHEST_DEG, LOWEST_DEG, read_angles, wire_angles
from rejoint.system.errors import ImpossibleReplyError, StaleReplyError

ARM = mycobot280()


@given(st.lists(st.floats(-4.0, 4.0), min_size=6, max_size=6))
def test_the_clients_truncation_becomes_rounding(position):
    sent = wire_angles(np.array(position))
    wanted = np.clip(np.round(np.degrees(position) * 100), np.array(LOWEST_DEG) * 100, np.array(HIGHEST_DEG) * 100)
    assert [int(value * 100) for value in sent] == wanted.tolist()  # int(): what the client does
    assert all(low <= value <= high for low, value, high in zip(LOWEST_DEG, sent, HIGHEST_DEG, strict=True))


@pytest.mark.parametrize(
    "reply", [-1, None, 0, [], [0.0] * 5, [0.0] * 12, [0.0] * 5 + [None], [float("nan")] * 6, [0, 0, 0, 0, 0, 180.08],
              [174.0, 0, 0, 0, 0, 0], ["0"] * 6, (0.0,) * 6],
)  # fmt: skip
def test_impossible_angles(reply):
    with pytest.raises(ImpossibleReplyError):
        judge(read_angles(reply), ARM)


HOME, FAR = np.zeros(6), np.radians([0, 40.0, 0, 0, 0, 0])


def moving(*accepted):
    """Return what has seen the arm at home, once or more often."""
    continuity = Continuity(ARM)
    for time in accepted:
        continuity.check(time, HOME)
        continuity.accept(time, HOME, None)
    return continuity


def test_a_jump_depends_on_the_time_between_answers():
    continuity = moving(-0.05, 0.0)
    for time in (0.05, 0.2, 0.3):  # it stays impossible, however often it is asked for
        with pytest.raises(ImpossibleReplyError):
            continuity.check(time, FAR)
    continuity.check(0.06, HOME)
    near = np.radians([0, 15.0, 0, 0, 0, 0])
    continuity.check(0.06, near)


def test_after_a_jump_that_was_believed_motion_is_ordinary():
    continuity = moving(0.0)
    with pytest.raises(ImpossibleReplyError):
        continuity.check(0.05, FAR)
    continuity.check(0.1, FAR)
    continuity.accept(0.1, FAR, None)
    continuity.check(0.15, FAR + np.radians(6.0))


def test_after_a_pause_two_answers_have_to_agree():
    continuity = moving(0.0, 0.05)
    with pytest.raises(ImpossibleReplyError):
        continuity.check(0.55, FAR)
    continuity.check(0.56, HOME)  # it was a wrong byte
    continuity.accept(0.56, HOME, None)
    with pytest.raises(ImpossibleReplyError):
        continuity.check(1.1, FAR)
    continuity.check(1.11, FAR + np.radians(1.0))  # it was not
    continuity.accept(1.11, FAR, None)
    continuity.check(1.16, FAR)


def test_two_answers_that_agree_overrule_the_very_first_one():
    continuity = moving(0.0)
    with pytest.raises(ImpossibleReplyError):
        continuity.check(0.05, FAR)
    with pytest.raises(ImpossibleReplyError):
        continuity.check(0.06, -FAR)
    continuity.check(0.07, -FAR)


def test_two_answers_that_agree_overrule_one_that_was_wrong_by_no_more_than_a_joint_can_go():
    """Bit 11 of an angle is 20.48 degrees; of a joint that moves the right way, what it does can be believed."""
    continuity = moving(-0.05, 0.0)
    wrong, right = np.radians([0, 0, 19.0, 0, 0, 0]), np.radians([0, 0, -3.0, 0, 0, 0])
    continuity.check(0.05, wrong)
    continuity.accept(0.05, wrong, None)
    with pytest.raises(ImpossibleReplyError):
        continuity.check(0.10, right)
    continuity.check(0.12, right)
    continuity.accept(0.12, right, None)
    continuity.check(0.17, right)


def run(continuity, readings, commands, period=0.05):
    return [
        continuity.accept(period * k, np.asarray(r, float), np.asarray(c, float))
        for k, (r, c) in enumerate(zip(readings, commands, strict=True))
    ]


def test_a_stuck_joint_that_is_pushed_a_little_is_fresh():
    pushed = [[0.1 + np.radians(8) * min(k / 50, 1)] * 6 for k in range(200)]
    assert max(run(Continuity(ARM), [[0.1] * 6] * 200, pushed)) == 0.0


def test_one_stuck_joint_is_not_taken_for_old_answers():
    """A diagnosis moves joints one by one, and a joint too weak to follow must be found out, not refused."""
    sent_away = [[0.1, 0.1, 0.1, 0.1 + np.radians(20), 0.1, 0.1]] * 199
    assert max(run(Continuity(ARM), [[0.1] * 6] * 200, [[0.1] * 6, *sent_away])) == 0.0


def test_answers_that_do_not_follow_a_large_command_age_and_are_refused():
    continuity = Continuity(ARM)
    ages = run(continuity, [[0.1] * 6] * 30, [[0.1] * 6] + [[0.5] * 6] * 29)
    assert ages[5] == 0.0
    assert ages[20] == pytest.approx(0.95)
    assert np.all(np.diff(ages[8:]) > 0)
    assert continuity.accept(1.5, np.full(6, 0.1), np.full(6, 0.5)) == pytest.approx(1.45)
    with pytest.raises(StaleReplyError):
        continuity.accept(1.6, np.full(6, 0.1), np.full(6, 0.5))


def test_one_encoder_step_makes_answers_fresh_again():
    continuity = Continuity(ARM)
    run(continuity, [[0.1] * 6] * 20, [[0.1] * 6] + [[0.5] * 6] * 19)
    assert continuity.accept(1.0, np.full(6, 0.1015), np.full(6, 0.5)) == 0.0
