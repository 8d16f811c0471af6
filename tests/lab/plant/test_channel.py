import numpy as np

from rejoint_lab.plant.servo import Channel, stream_keys

KEYS = stream_keys(3, 4)


def draw(cycles=4000):
    return np.array([Channel().draw(KEYS, np.full(4, cycle)) for cycle in range(cycles)])


def test_delays_are_uniform_in_their_intervals():
    drawn = draw()
    for k, (low, high) in enumerate([(0.008, 0.013), (0.006, 0.013), (0.020, 0.030)]):
        values = drawn[:, k]
        assert low <= values.min() < values.max() < high
        edges = np.histogram(values, bins=10, range=(low, high))[0]
        assert (np.abs(edges - 1600) < 5 * np.sqrt(1600)).all()


def test_arms_cycles_and_kinds_are_independent():
    flat = draw().reshape(4000, 12)
    away = np.corrcoef(np.concatenate([flat[1:], flat[:-1]], axis=1).T) - np.eye(24)
    assert np.abs(away).max() < 0.08


def test_a_draw_is_a_pure_function_of_seed_arm_and_cycle():
    full = Channel().draw(KEYS, np.array([5, 6, 7, 8]))
    alone = Channel().draw(stream_keys(3, 1, first=2), np.array([7]))
    assert [delay[0] for delay in alone] == [delay[2] for delay in full]
