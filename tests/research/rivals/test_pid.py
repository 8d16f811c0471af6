"""The paper's PID: equation 27 by hand, and its integral."""

import numpy as np
import pytest

from control.test_classical import ALL, ARM, REST, TARGETS, inputs
from rejoint.arms import solve_position
from rejoint_lab.research.rivals import PidController


@pytest.mark.parametrize("literal", [False, True])
def test_pid_by_hand(literal):
    """Two cycles of equation 27 worked out from its text: Kp .4, Ki .01, Kd .005, dt .02."""
    controller = PidController(literal=literal)
    controller.reset(inputs(REST), ALL)
    goal = solve_position(ARM, TARGETS[:, 0], REST).q
    e0, e1 = goal - REST, goal - (REST + 0.01)
    dt = 0.02 if literal else 1.0
    first = controller.command(inputs(REST))
    np.testing.assert_allclose(first, REST + 0.4 * e0 + 0.01 * e0 * dt, atol=1e-12)
    second = controller.command(inputs(REST + 0.01))
    expected = REST + 0.01 + 0.4 * e1 + 0.01 * (e0 + e1) * dt + 0.005 * (e1 - e0) / 0.02
    np.testing.assert_allclose(second, expected, atol=1e-12)
    assert controller.name == ("pid-literal" if literal else "pid-sum")


def test_pid_forgets_its_integral_only_where_it_is_reset():
    controller = PidController(literal=False)
    controller.reset(inputs(REST), ALL)
    for _ in range(5):
        controller.command(inputs(REST))
    some = np.array([True, False, False])
    controller.reset(inputs(REST), some)
    fresh = PidController(literal=False)
    fresh.reset(inputs(REST), ALL)
    ours, new = controller.command(inputs(REST)), fresh.command(inputs(REST))
    np.testing.assert_allclose(ours[0], new[0], atol=1e-12)
    assert np.abs(ours[1:] - new[1:]).max() > 1e-4
