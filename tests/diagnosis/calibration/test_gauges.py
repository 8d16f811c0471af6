"""Laws of what measures the tool: nothing is believed that was not said, and silence is noticed."""

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.diagnosis.calibration.procedure import SPAN, EmulatedGauge, Stop, TouchGauge, TrackerGauge, parse_point
from rejoint.system.errors import FileError, InputError

STOP = Stop(1, 2, np.zeros(3))


class Secretive:
    arm = mycobot280()

    def true_tcp(self):
        return np.full((1, 3), np.nan)


class Telling:
    def true_tcp(self):
        return np.array([[0.1, -0.02, 0.25]])


@pytest.mark.parametrize(
    ("text", "millimetres"),
    [
        ("171.5 -20 203\n", [171.5, -20, 203]),
        ("171.5, -20, 203", [171.5, -20, 203]),
        ("- - 203", [np.nan, np.nan, 203]),
        ("171,5; -20; 203,", [171.5, -20, 203]),
        ("171.5,-20,203", [171.5, -20, 203]),
        ("", [np.nan] * 3),
    ],
)
def test_what_people_type(text, millimetres):
    np.testing.assert_allclose(parse_point(text), 1e-3 * np.array(millimetres))


def test_a_slip_far_from_the_encoders_is_asked_for_once_more():
    """A missing minus turned the arm around, and an x of another row was only named at the end."""
    robot, stop = Secretive(), Stop(1, 1, np.array([0.15, -0.08, 0.2]))
    for told, points in (
        (["150 80 200", "150 -80 200"], [150, -80, 200]),
        (["150 80 200", "150 80 200"], [150, 80, 200]),
        (["- 80 200", "- 80 200"], [np.nan, 80, 200]),
        (["160 -70 190"], [160, -70, 190]),
    ):
        answers, asked = iter(told), []
        gauge = TouchGauge(ask=lambda stop, left=answers, asked=asked: asked.append(stop.question) or next(left))
        np.testing.assert_allclose(gauge.measure(robot, stop), 1e-3 * np.array(points, dtype=float))
        assert ["160 mm from where the encoders" in one for one in asked] == [False, *[True] * (len(told) - 1)]
    elsewhere = TouchGauge(ask=lambda stop: "" if stop.again else "900 0 0", frame="bench")
    np.testing.assert_allclose(elsewhere.measure(robot, stop), [0.9, 0, 0])


def test_an_emulated_arm_tells_with_noise_of_the_size_that_is_said():
    gauge = EmulatedGauge(sigma=2e-3, seed=4)
    told = np.array([gauge.measure(Telling(), STOP) for _ in range(2000)])
    np.testing.assert_allclose(told.mean(axis=0), Telling().true_tcp()[0], atol=2e-4)
    np.testing.assert_allclose(told.std(axis=0), 2e-3, rtol=0.1)
    again = EmulatedGauge(sigma=2e-3, seed=4)
    np.testing.assert_array_equal(again.measure(Telling(), STOP), told[0])


class Tracker:
    """Writes rows while the gauge waits."""

    def __init__(self, path, rate=50.0, head="time,x,y,z,q"):
        self.path, self.now, self.rate, self.on = path, 100.0, rate, True
        path.write_text(head + "\n")
        self.wait(1.0)

    def wait(self, seconds):
        if self.on:
            with self.path.open("a") as file:
                for _ in range(int(seconds * self.rate)):
                    self.now += 1.0 / self.rate
                    file.write(f"{self.now:.4f},{100 + (-1) ** int(self.now * self.rate)},-20,250,7\n")


@pytest.mark.parametrize(
    ("head", "unit", "scale"),
    [("time,x,y,z,q", "mm", 1e-3), ("Time,X,Y,Z", "m", 1.0), ("time_s,X [cm],y_cm,z_cm", "mm", 1e-2)],
)
def test_a_tracker_is_averaged_over_what_it_writes_from_now_on(tmp_path, head, unit, scale):
    tracker = Tracker(tmp_path / "t.csv", head=head)
    gauge = TrackerGauge(path=tracker.path, unit=unit, wait=tracker.wait)
    seen = gauge.measure(Secretive(), STOP)
    np.testing.assert_allclose(seen, scale * np.array([100, -20, 250]), atol=0.2 * scale)


def test_a_tracker_that_is_off_or_writes_something_else_is_named(tmp_path):
    tracker = Tracker(tmp_path / "t.csv")
    gauge = TrackerGauge(path=tracker.path, wait=tracker.wait)
    tracker.on = False
    with pytest.raises(FileError, match=r"no new rows for 5\.\d s"):
        gauge.measure(Secretive(), STOP)
    with pytest.raises(FileError, match="expected time, x, y, z"):
        TrackerGauge(path=Tracker(tmp_path / "u.csv", head="t,a,b,c,d").path)
    with pytest.raises(FileError, match="no such file"):
        TrackerGauge(path=tmp_path / "none.csv")
    with pytest.raises(InputError, match="or m"):
        TrackerGauge(path=tracker.path, unit="inch")
    assert SPAN < 5.0
