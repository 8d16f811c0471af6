"""The camera that watches an emulated arm: its noise, rate and delay, and deployments by it."""

import re
from dataclasses import replace

import numpy as np

import rejoint
from rejoint_lab.emulated import DEVIATION, LATE, RATE, EmulatedEye

TARGETS = np.array([[0.17, 0.0, 0.2], [0.18, 0.03, 0.21]])


class Still:
    """An arm that stands."""

    count, address, place = 1, "test:still", np.array([[0.1, 0.2, 0.3]])

    def true_tcp(self):
        return self.place


def sightings():
    found, eye = {}, EmulatedEye(Still(), seed=3)
    for now in np.arange(0.0, 100.0, 0.025):
        one = eye.sighting(now)
        if one is not None:
            assert one.time <= now - LATE
            found[one.time] = one.place
    return np.array(list(found)), np.stack(list(found.values()))


def test_noise_rate_and_delay_are_those_of_the_camera_and_seeds_repeat():
    times, places = sightings()
    assert np.diff(times).min() > 1.0 / RATE - 0.025 - 1e-9  # at the next control cycle
    assert abs(len(times) - 100.0 * RATE) < 20
    np.testing.assert_allclose(places.std(axis=0), DEVIATION, rtol=0.1)
    np.testing.assert_allclose(places.mean(axis=0), Still.place[0], atol=5e-5)
    np.testing.assert_array_equal(places, sightings()[1])


class Moved(EmulatedEye):
    """A camera that was pushed after it had been calibrated: all that it sees is off to one side."""

    def sighting(self, now):
        seen = super().sighting(now)
        return seen and replace(seen, place=seen.place + np.array([0.0, 5e-3, 0.0]))


def test_a_camera_that_was_moved_is_named(caplog):
    targets = np.array([*TARGETS, [0.16, -0.03, 0.19]])
    found = rejoint.calibrate("emulated:worn?seed=3", count=5).calibration
    for eye in ("emulated", lambda robot: Moved(robot, 0)):
        assert "camera or board moved" not in caplog.text
        settings = rejoint.Settings(controller="integrator", calibration=found, eye=eye)
        rejoint.deploy("emulated:worn?seed=3", targets, settings=settings)
    said = re.search(r"sees the tool (\S+) mm to one side .* were camera or board moved", caplog.text)
    assert said is not None
    assert 4.0 < float(said[1]) < 7.0
