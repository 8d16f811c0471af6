"""Laws of what is known ahead: a path knows its future, a stream guesses for a fifth of a second and then holds."""

from dataclasses import replace

import numpy as np
import pytest

from orientations import angles
from rejoint.arms import Displacement, mycobot280, tcp_position
from rejoint.arms.rotations import quaternion_of, tool_axis, turned
from rejoint.control.correction import Modelled
from rejoint.control.moving.drive import corrected
from rejoint.control.moving.reference import (
    EXTRAPOLATED,
    LAG,
    Path,
    PathReference,
    Stream,
    standard_path,
)
from rejoint.control.moving.tracker import PathPostures
from rejoint.control.targets import Pose
from rejoint.system.errors import InputError
from rejoint_lab.research.evaluation.evaluate import played
from standin import now_at

ARM = mycobot280()
CIRCLE = standard_path("circle-4s", ARM)
VELOCITY = np.array([0.05, -0.02, 0.01])


def going(times):
    stream = Stream()
    for time in times:
        stream.put(np.array([0.18, 0.0, 0.2]) + time * VELOCITY, time)
    return stream


def test_a_path_is_known_ahead():
    later = np.array([0.0, 0.5, 3.0])
    assert np.array_equal(CIRCLE.ahead(4.0, later)[0], CIRCLE.at(2.0 + later))
    assert np.array_equal(CIRCLE.target(1.0), CIRCLE.place[0])


def test_a_stream_knows_nothing_of_what_has_not_come():
    stream = played(CIRCLE, 30.0)
    short = Stream()
    for time, target in zip(stream.time, stream.rows, strict=True):
        if time <= 5.0:
            short.put(target, time)
    later = np.linspace(0.0, 1.0, 7)
    assert np.array_equal(stream.ahead(5.0, later)[0], short.ahead(5.0, later)[0])


def test_a_stream_with_jitter_is_interpolated_behind_its_last_target():
    rng = np.random.default_rng(1)
    stream = going(np.cumsum(rng.uniform(0.02, 0.05, 60)))
    now = stream.time[-1]
    later = np.linspace(-0.5, LAG, 20)
    expected = np.array([0.18, 0.0, 0.2]) + (now + later - LAG)[:, None] * VELOCITY
    assert np.allclose(stream.ahead(now, later)[0], expected, atol=1e-12)


def test_a_gap_is_bridged_for_a_fifth_of_a_second_and_then_held():
    stream = going(np.arange(0.0, 1.01, 0.1))
    last = stream.time[-1]
    ahead = stream.ahead(last + LAG, np.array([0.1, EXTRAPOLATED, 0.5, 5.0]))[0]
    assert np.allclose(ahead[0], stream.rows[-1] + 0.1 * VELOCITY)
    assert np.allclose(ahead[1:], stream.rows[-1] + EXTRAPOLATED * VELOCITY)


def test_a_stream_of_poses_turns_the_tool_on_the_way_between_them_and_then_holds():
    stream, axis = Stream(axis=tool_axis(ARM)), np.array([0.0, 0.6, 0.8])
    for k in range(11):
        turn = quaternion_of(turned(0.04 * k * axis))
        sign = 1.0 if k % 2 else -1.0  # both mean the same
        stream.put(Pose(place_m=[0.18, 0.0, 0.2], quaternion=sign * turn, weight_m=0.03), 0.1 * k)
    later = np.array([-0.5, -0.05, LAG, LAG + 0.1, LAG + EXTRAPOLATED, LAG + 2.0])
    places, turns = stream.ahead(1.0, later)
    expected = 0.4 * (1.0 + np.minimum(later - LAG, EXTRAPOLATED))
    for k, angle in enumerate(expected):
        assert angles(turns[k], turned(angle * axis)) < np.radians(0.02)
    assert turns.whole.all()
    assert np.allclose(turns.weight, 0.03)
    assert places.shape == (6, 3)


def test_what_is_no_target_or_comes_late_is_refused():
    stream = Stream()
    with pytest.raises(InputError, match="nothing has come yet"):
        stream.target(0.0)
    with pytest.raises(InputError, match="expected a point"):
        stream.put([0.1, np.nan, 0.2], 0.0)
    with pytest.raises(InputError, match="millimetres"):
        stream.put([180, 0, 200], 0.0)
    stream.put([0.18, 0.0, 0.2], 1.0)
    with pytest.raises(InputError, match="came after"):
        stream.put([0.18, 0.0, 0.2], 0.5)
    assert np.array_equal(stream.ahead(1.0, np.array([0.0, 1.0]))[0], np.tile([0.18, 0.0, 0.2], (2, 1)))


def test_courses_keep_arms_apart():
    other = standard_path("random-0.2hz", ARM)
    both = PathReference(ARM, [CIRCLE, other])
    now, later = np.array([3.0, 4.0]), np.array([[0.0, 0.1], [0.2, 0.3]])
    aims = both.poses(now, later)[0]
    assert aims.shape == (2, 2, 3)
    assert np.array_equal(aims[1, 0], CIRCLE.at(1.2))
    assert np.array_equal(aims[0, 1], other.at(2.1))
    wanted = both.advance(now_at(np.zeros((2, ARM.joints)), now))
    assert np.array_equal(wanted.place[1], other.at(2.0))
    np.testing.assert_allclose(tcp_position(ARM, wanted.goal), wanted.target, atol=1e-3)


def test_a_corrected_stream_is_judged_by_the_postures_of_its_own_way():
    none, stream, times = Displacement.none(ARM), Stream(), np.arange(0.0, 10.0, 0.05)
    correction = Modelled(ARM, replace(none, compliance=none.compliance + 0.01, play=none.play + 0.005))
    places = np.stack([0.2 * np.cos(0.3 * times), 0.2 * np.sin(0.3 * times), 0.2 + 0.0 * times], axis=-1)
    for time, place in zip(times, places, strict=True):
        stream.put(place, time)
    corrected(ARM, stream, correction)
    for time in times:  # as an arm follows it
        stream.ahead(time, np.zeros(1))
    way = PathPostures(ARM, places[:1]).along(places[:, None])[:, 0]
    np.testing.assert_allclose(stream.route().aim, places - correction.shift(way), atol=1e-5)


@pytest.mark.parametrize(
    ("ahead", "out", "back"),
    [
        (lambda away: 0.18 + 0.1 * max(3.0 - away, 0.0), 1.8, 2.3),  # beyond its reach, or through its own base
        (lambda away: 0.1 * min(away, 2.0), 0.6, 0.9),
    ],
)
def test_where_a_stream_asks_for_the_impossible_its_arm_holds_and_comes_back(ahead, out, back):
    stream, heard, times = Stream(lag=0.0), [], np.arange(0.0, 8.0, 0.05)
    for time in times:
        stream.put([ahead(abs(time - 4.0)), 0.0, 0.2], time)
    reference = PathReference(ARM, [stream], message=heard.append)
    goals = [reference.advance(now_at(np.zeros((1, ARM.joints)), np.array([time]))) for time in times]
    tool = np.array([tcp_position(ARM, one.goal)[0] for one in goals])
    away = np.abs(times - 4.0)
    np.testing.assert_allclose(tool[away > back], np.array(stream.rows)[away > back], atol=1e-3)
    assert np.ptp(tool[away < out], axis=0).max() == 0.0
    np.testing.assert_allclose(goals[80].target[0], tool[80])
    assert len(heard) == 1


def test_only_what_is_known_ahead_waits_for_its_arm():
    straight = Path(time=np.array([0.0, 2.0]), place=np.array([[0.2, 0.0, 0.2], [0.2, 0.1, 0.2]]))
    assert PathReference(ARM, [straight, played(straight, 30.0)]).waits.tolist() == [True, False]
