"""Laws of what is known ahead: a path knows its future, a stream guesses for a fifth of a second and then holds."""

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.control.moving.routes import EXTRAPOLATED, LAG, Ahead, Routes, Stream, played
from rejoint.control.moving.standard import standard_path
from rejoint.system.errors import InputError

ARM = mycobot280()
CIRCLE = standard_path("circle-4s", ARM)
VELOCITY = np.array([0.05, -0.02, 0.01])


def going(times):
    stream = Stream()
    for time in times:
        stream.put(np.array([0.18, 0.0, 0.2]) + time * VELOCITY, time)
    return stream


def test_a_path_is_known_ahead():
    guide = Ahead(path=CIRCLE, lead_in=2.0)
    later = np.array([0.0, 0.5, 3.0])
    assert np.array_equal(guide.aims(4.0, later), CIRCLE.at(2.0 + later))
    assert np.array_equal(guide.place(1.0), CIRCLE.place[0])


def test_a_stream_knows_nothing_of_what_has_not_come():
    stream = played(CIRCLE, 30.0)
    short = Stream()
    for time, target in zip(stream.time, stream.targets, strict=True):
        if time <= 5.0:
            short.put(target, time)
    later = np.linspace(0.0, 1.0, 7)
    assert np.array_equal(stream.aims(5.0, later), short.aims(5.0, later))


def test_a_stream_with_jitter_is_interpolated_behind_its_last_target():
    rng = np.random.default_rng(1)
    stream = going(np.cumsum(rng.uniform(0.02, 0.05, 60)))
    now = stream.time[-1]
    later = np.linspace(-0.5, LAG, 20)
    expected = np.array([0.18, 0.0, 0.2]) + (now + later - LAG)[:, None] * VELOCITY
    assert np.allclose(stream.aims(now, later), expected, atol=1e-12)


def test_a_gap_is_bridged_for_a_fifth_of_a_second_and_then_held():
    stream = going(np.arange(0.0, 1.01, 0.1))
    last = stream.time[-1]
    ahead = stream.aims(last + LAG, np.array([0.1, EXTRAPOLATED, 0.5, 5.0]))
    assert np.allclose(ahead[0], stream.targets[-1] + 0.1 * VELOCITY)
    assert np.allclose(ahead[1:], stream.targets[-1] + EXTRAPOLATED * VELOCITY)


def test_what_is_no_target_or_comes_late_is_refused():
    stream = Stream()
    with pytest.raises(InputError, match="nothing has come yet"):
        stream.place(0.0)
    with pytest.raises(InputError, match="three finite numbers"):
        stream.put([0.1, np.nan, 0.2], 0.0)
    stream.put([0.18, 0.0, 0.2], 1.0)
    with pytest.raises(InputError, match="came after"):
        stream.put([0.18, 0.0, 0.2], 0.5)
    assert np.array_equal(stream.aims(1.0, np.array([0.0, 1.0])), np.tile([0.18, 0.0, 0.2], (2, 1)))


def test_courses_keep_arms_apart():
    other = standard_path("random-0.2hz", ARM)
    routes = Routes([Ahead(path=CIRCLE), Ahead(path=other)])
    now, later = np.array([3.0, 4.0]), np.array([[0.0, 0.1], [0.2, 0.3]])
    aims = routes.aims(now, later)
    assert aims.shape == (2, 2, 3)
    assert np.array_equal(aims[1, 0], CIRCLE.at(1.2))
    assert np.array_equal(aims[0, 1], other.at(2.1))
    assert np.array_equal(routes.place(now)[1], other.at(2.0))
