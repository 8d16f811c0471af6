import numpy as np
import pytest

from rejoint.arms import mycobot280, solve_position
from rejoint.arms.postures import find_postures
from rejoint.control.controllers.classical import NOMINAL_PERIOD, dls_step
from rejoint.system.errors import InputError
from rejoint.training.ranges import BroadRanges
from rejoint_lab.research import look_up
from rejoint_lab.research.evaluation.evaluate import classical
from rejoint_lab.research.rivals import RIVALS, Gain, Rival, ScheduledController, tune
from standin import inputs_of, state_of

ARM = mycobot280()
RANGES = BroadRanges(arm=ARM)
REST = np.tile(ARM.rest, (2, 1))
TARGET = np.array([[0.18, 0.02, 0.20], [0.2, -0.05, 0.18]])

PLAIN = {
    "far_rate": 4.0,
    "near_rate": 4.0,
    "schedule": 1.0,
    "deadband": 0.0,
    "proportional": 0.0,
    "damping": 0.0,
    "prediction": 0.0,
    "moving": 1e9,
    "speed": 1e9,
    "lead": np.radians(15.0),
    "feedforward": 0.0,
    "ramp": 0.0,
    "carry": 0.0,
}


def inputs(position, sent, time=0.0):
    state = state_of(position, time)
    goal = find_postures(ARM, TARGET, REST, None)
    return inputs_of(state, TARGET, goal, sent, time)


def begun(law, posture):
    law.reset(inputs(posture, posture), np.ones(2, dtype=bool))
    return law


def test_without_its_extras_the_schedule_integrates_the_joint_step():
    # No time since the target, so no ramp; one rate everywhere: what is left is the integral of the step.
    posture = solve_position(ARM, TARGET + 0.004, REST).q
    mine = begun(ScheduledController(ARM, PLAIN), posture)
    sent = mine.command(inputs(posture, posture))
    step = dls_step(ARM, posture, TARGET).step
    np.testing.assert_allclose(sent - posture, NOMINAL_PERIOD * PLAIN["far_rate"] * step, rtol=1e-9)


def test_gains_of_a_batch_act_arm_by_arm():
    both = {**PLAIN, "far_rate": np.array([[2.0], [6.0]]), "near_rate": np.array([[2.0], [6.0]])}
    moved = begun(ScheduledController(ARM, both), REST).command(inputs(REST, REST))
    for i, rate in enumerate((2.0, 6.0)):
        alone = begun(ScheduledController(ARM, {**PLAIN, "far_rate": rate, "near_rate": rate}), REST)
        np.testing.assert_array_equal(alone.command(inputs(REST, REST))[i], moved[i])


def test_the_tuning_finds_the_bottom_of_a_known_valley(monkeypatch):
    # The search itself, without arms: the cost is a bowl around one gain per decade.
    def bowl(arm, ranges, rival, gains, draw):
        return (np.log(gains["a"] / 0.5)) ** 2 + (np.log(gains["b"] / 20.0)) ** 2

    monkeypatch.setattr("rejoint_lab.research.rivals.candidate_costs", bowl)
    gains, seen = {"a": Gain(0.01, 10.0, 1.0), "b": Gain(1.0, 100.0, 1.0)}, []
    found = tune(ARM, RANGES, Rival(None, gains), lambda *report: seen.append(report), generations=30)
    assert found["a"] == pytest.approx(0.5, rel=0.03)
    assert found["b"] == pytest.approx(20.0, rel=0.03)
    assert [report[0] for report in seen] == [k / 30 for k in range(1, 31)]


def test_gains_must_be_those_of_the_rival():
    for gains in ({"tuned-feedforward": {"rate": 1.0}}, {}):  # of a file that lacks this rival
        with pytest.raises(InputError, match="expected"):
            classical("tuned-feedforward", gains)
    with pytest.raises(InputError, match="tuned-feedforward"):
        look_up(RIVALS, ["nobody"])
