import numpy as np
import pytest

from rejoint.control.servoreference import Latency


def test_commands_are_in_force_after_their_delay():
    latency = Latency(count=2, joints=1, substeps=6)
    latency.command_delay[:] = [0.010, 0.040]
    latency.clear(np.array([True, True]), np.zeros((2, 1)), np.zeros((2, 1)))
    for k in range(4):
        latency.send(np.full((2, 1), k + 1.0), np.full(2, 0.020 * k))  # at 0, 20, 40, 60 ms
    at = np.array([[0.0605, 0.0695, 0.0705], [0.0605, 0.0795, 0.0805]])
    forced = latency.in_force(at)[0][..., 0]
    np.testing.assert_array_equal(forced, [[3.0, 3.0, 4.0], [2.0, 2.0, 3.0]])


@pytest.mark.parametrize("delay", [0.040, 0.197])
def test_the_longest_delay_fits_at_the_shortest_period(delay):
    latency = Latency(count=1, joints=1, substeps=6)
    latency.command_delay[:] = delay
    latency.clear(np.array([True]), np.zeros((1, 1)), np.zeros((1, 1)))
    for k in range(20):
        latency.send(np.array([[float(k)]]), np.array([0.018 * k]))
        now = 0.018 * k + np.linspace(0.0, 0.0179, 6)[None]
        newest = np.floor((now - delay) / 0.018 + 1e-9)  # number of the last command that has arrived
        np.testing.assert_array_equal(latency.in_force(now)[0][..., 0], np.maximum(newest, 0.0))


def test_positions_are_as_old_as_the_delay_says():
    latency = Latency(count=3, joints=2, substeps=6)
    latency.readback_delay[:] = [0.0, 0.0071, 0.030]
    speed = np.array([0.5, -2.0])
    start = np.zeros((3, 2))
    latency.clear(np.ones(3, dtype=bool), start, start)
    time = np.zeros(3)
    for k in range(5):
        period = np.array([0.018, 0.030, 0.020]) + 0.001 * k
        passed = time[:, None] + period[:, None] * np.arange(1, 7) / 6
        latency.record(passed, passed[..., None] * speed)  # every joint moves evenly from time 0
        time = time + period
        then = np.maximum(time - latency.readback_delay, 0.0)
        np.testing.assert_allclose(latency.read(time), then[:, None] * speed, atol=1e-12)
