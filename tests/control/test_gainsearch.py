"""The search for better gains of the servos' own loops, in virtual time on the integer law of the firmware."""

from dataclasses import replace

import numpy as np
import pytest

from rejoint.control.controllers.classical import DefaultController
from rejoint.control.controllers.policy import PolicyContract
from rejoint.control.guard import GuardLimits
from rejoint.control.monitor import Bands
from rejoint.control.servogains import (
    SHAKES,
    _RoundWatch,
    geared,
    limits_under,
    require_gains,
    search,
    stiffness_under,
    under_gains,
)
from rejoint.robots.feetech import KIND
from rejoint.robots.knobs import LIMIT, steps
from rejoint.system.errors import ContractError, GuardTripError, InputError, NotReadyError, RobotError
from servorobot import ARM, ServoRobot
from standin import inputs_of, state_of


def targets(count=3):
    return np.random.default_rng(0).uniform(ARM.targets.lower, ARM.targets.upper, (count, 3))


def test_a_search_brings_every_joint_nearer_and_puts_the_gains_back():
    robot = ServoRobot("worn")
    before = robot.servo_gains()
    found = search(robot, targets(2))
    assert found.found == robot.servo_gains() == before
    assert sum(found.with_alone.error) <= sum(found.with_under.error) < 0.95 * sum(found.before.error)
    assert found.with_alone.tool < 0.6 * found.before.tool
    assert set(found.under["i"]) == {0}
    assert max(found.alone["i"]) > 0
    for values, limits in zip(zip(*found.alone.values(), strict=True), zip(*before.values(), strict=True), strict=True):
        tuned, was = dict(zip(found.alone, values, strict=True)), dict(zip(before, limits, strict=True))
        assert was["p"] <= tuned["p"] <= 64
        assert (tuned["i"] > 0) == (tuned[LIMIT] == 50)


def test_what_ends_a_search_leaves_the_gains_as_they_were():
    robot = ServoRobot()
    before, robot.frail = robot.servo_gains(), 40
    with pytest.raises(RobotError):
        search(robot, targets(1))
    assert max(gains["p"][1] for gains in robot.history) == 40
    assert robot.servo_gains() == before


def test_an_arm_that_tells_no_gains_is_refused_before_it_moves():
    robot = ServoRobot()
    robot.servo_gains = lambda: None
    with pytest.raises(InputError, match="no servo gains"):
        search(robot, targets(1))
    assert robot.read().time[0] == 0.0


def test_a_warm_arm_is_not_searched():
    robot = ServoRobot()
    robot.plant.servos["temperature"][0, 2] = 57.0
    with pytest.raises(NotReadyError):
        search(robot, targets(1))
    assert all(gains == robot.servo_gains() for gains in robot.history)


@pytest.mark.parametrize(
    "ill", [{"fault": np.eye(5, dtype=bool)[1:2]}, {"temperature": np.array([[30.0, 80.0, 30.0, 30.0, 30.0]])}], ids=str
)
def test_a_servo_that_suffers_ends_the_search_and_no_round_alone(ill):
    """Rounds that end at once, because a joint is warm, kept the guard from seeing that it was far too hot."""
    robot = ServoRobot()
    before, step = robot.servo_gains(), robot.step
    robot.step = lambda *given: replace(step(*given), **(ill if len(robot.history) > 1 else {}))
    with pytest.raises(GuardTripError, match="shoulder_lift"):
        search(robot, targets(1))
    assert robot.servo_gains() == before


def state(time, *, shift=0.0, **changes):
    return state_of(ARM.rest + shift * np.eye(5)[2], time, **changes)


@pytest.mark.parametrize(
    ("joint", "seen"),
    [
        (2, lambda t: state(t, shift=0.6 * SHAKES * np.sin(25 * t))),
        (1, lambda t: state(t, load=np.array([[0.0, 0.8, 0.0, 0.0, 0.0]]))),
        (3, lambda t: state(t, temperature=np.array([[30.0, 40.0, 50.0, 56.0, 30.0]]))),
        (None, lambda t: state(t, shift=0.4 * SHAKES * np.sin(25 * t), load=np.full((1, 5), 0.6))),
    ],
)
def test_a_joint_that_shakes_labours_or_gets_warm_ends_the_round(joint, seen):
    watch = _RoundWatch(ARM)
    ended = [
        bool(watch.bad(inputs_of(seen(t), np.zeros((1, 3)), ARM.rest[None], ARM.rest[None], t)))
        for t in np.arange(0.0, 2.5, 0.02)
    ]
    assert ended[-1] == (joint is not None)
    assert np.flatnonzero(watch.joints).tolist() == ([] if joint is None else [joint])


def test_a_controller_drives_under_its_gains_and_leaves_those_before():
    robot = ServoRobot()
    before, tuned = robot.servo_gains(), {"p": (40, 48, 48, 40, 32)}
    gearing = geared(DefaultController(ARM), tuned)
    assert gearing.name == "servo-gains"
    with under_gains(robot, gearing):
        assert robot.servo_gains() == before | tuned
    assert robot.servo_gains() == before
    with pytest.raises(KeyboardInterrupt), under_gains(robot, gearing):
        raise KeyboardInterrupt
    assert robot.servo_gains() == before
    told = len(robot.history)
    with under_gains(robot, geared(DefaultController(ARM), before)), under_gains(robot, DefaultController(ARM)):
        pass
    assert len(robot.history) == told


def test_under_stiffer_gains_a_joint_stands_in_its_band_as_it_sags_less():
    """Without that a joint with a dead encoder ran from stop to stop in an arm that was diagnosed."""
    robot = ServoRobot()
    bands = Bands(slope=np.full(5, 0.1), offset=np.zeros(5), reach=np.full(5, 0.3), width=np.full(5, 0.03))
    limits = replace(GuardLimits.of(ARM), bands=bands, gains=robot.servo_gains())
    p = robot.servo_gains()["p"][0]
    stiff = limits_under(limits, robot, geared(DefaultController(ARM), {"p": (2 * p,) * 5})).bands
    assert stiff.slope == pytest.approx(0.05)
    assert stiff.width == pytest.approx(bands.width)
    assert limits_under(limits, robot, geared(DefaultController(ARM), {"p": (p // 2,) * 5})).bands is None
    with_integral = {"p": (2 * p,) * 5, "i": (0, 0, 4, 0, 0)}
    assert limits_under(limits, robot, geared(DefaultController(ARM), with_integral)).bands is None


class Trained:
    name = "policy"

    def __init__(self, gains):
        self.contract = object.__new__(PolicyContract)
        object.__setattr__(self.contract, "servo_gains", gains)


def test_a_policy_is_refused_under_other_gains_than_it_was_trained_for():
    robot = ServoRobot()
    require_gains(robot, Trained(robot.servo_gains()))
    require_gains(robot, Trained(None))
    robot.tune({"p": (32, 32, 48, 32, 32)})
    with (
        pytest.raises(ContractError),
        under_gains(robot, Trained({"p": (32,) * 5})),
    ):
        pass


def test_stiffness_goes_with_p():
    stiffness = np.array([8.0, 4.0])
    twice = stiffness_under(stiffness, {"p": (32, 32), "i": (0, 0)}, {"p": (64, 16), "i": (2, 2)})
    assert twice.tolist() == [16.0, 2.0]
    assert stiffness_under(stiffness, None, {"p": (64, 16)}) is stiffness


def test_gains_go_in_small_steps_with_the_limit_before_the_i_part_and_after_it():
    before = KIND.for_all({"p": 32, "i": 0}, 2) | {LIMIT: (0, 0)}
    there = list(steps(before, KIND.for_all({"p": 40, "i": 2}, 2), KIND.strides))
    assert there[0] == (LIMIT, [50, 50])
    assert [row for name, row in there if name == "p"] == [[36, 36], [40, 40]]
    back = list(steps(KIND.for_all({"p": 40, "i": 2}, 2), before, KIND.strides))
    assert back[-1] == (LIMIT, [0, 0])
    assert [row for name, row in back if name == "i"] == [[1, 1], [0, 0]]
    assert list(steps(before, before, KIND.strides)) == []
    one, other = {LIMIT: (50, 0), "i": (1, 0)}, {LIMIT: (0, 50), "i": (0, 1)}
    assert list(steps(one, other, KIND.strides)) == [(LIMIT, [50, 50]), ("i", [0, 1]), (LIMIT, [0, 50])], (
        "0 is no limit at all"
    )
