"""What the stages are given: nearly right values are refused with their name, not taken for something else."""

from decimal import Decimal

import numpy as np
import pytest

import rejoint
from rejoint.arms import mycobot280
from rejoint.arms.loaded import loaded
from rejoint.robots import open_robot
from rejoint.runs.given import as_targets
from rejoint.runs.stages.controllers import listed
from rejoint.system.errors import InputError
from rejoint.system.numbers import as_floats, as_seed

WORN = "emulated:worn"
TARGET = [[0.17, 0.0, 0.2]]
TIME, MOTION = np.arange(50) * 0.03, np.zeros((50, 6))


@pytest.mark.parametrize("seed", [-1, 1.5, "3", float("nan")])
@pytest.mark.parametrize("stage", [rejoint.connect, rejoint.diagnose, rejoint.deploy, rejoint.compare])
def test_a_seed_is_a_whole_number_from_zero_on(stage, seed) -> None:
    with pytest.raises(InputError, match="expected a whole number from 0 on"):
        stage(WORN, seed=seed)


@pytest.mark.parametrize("seed", [-1, "3"])
def test_the_seed_of_an_identification_from_any_motion_is_one_too(seed) -> None:
    log = rejoint.RunLog.of(TIME, MOTION, MOTION, arm="mycobot280", label="mine")
    with pytest.raises(InputError, match="expected a whole number from 0 on"):
        rejoint.identify(log, seed=seed, quick=True)


def test_no_seed_is_seed_zero_and_any_kind_of_integer_will_do() -> None:
    assert [as_seed(given) for given in (None, 7, np.int32(7), 2**70)] == [0, 7, 7, 2**70]
    states = []
    for seed in (None, 0, np.uint8(0)):
        robot = open_robot(WORN, seed=seed)
        states.append(robot.step(robot.read().position).position)
        robot.close()
    np.testing.assert_array_equal(states[0], states[1])
    np.testing.assert_array_equal(states[0], states[2])


@pytest.mark.parametrize("period", [0.03, (0.03,), (20, 30), (0.05, 0.02), (0, 0), (np.nan, 1), "30", ("a", "b")])
def test_a_period_is_two_times_in_seconds(period) -> None:
    with pytest.raises(InputError, match="period"):
        open_robot(WORN, period=period)
    with pytest.raises(InputError, match="period"):
        rejoint.deploy(WORN, "default", TARGET, period=period)


def test_a_period_may_be_an_array() -> None:
    open_robot(WORN, period=np.array([0.02, 0.03])).close()


@pytest.mark.parametrize("how_many", [{"sets": 0}, {"sets": -1}, {"repetitions": 0}])
def test_none_of_something_is_not_the_usual_number_of_it(how_many) -> None:
    with pytest.raises(InputError, match=r"expected 1|at least 1"):
        rejoint.compare(WORN, ["default"], **how_many)


@pytest.mark.parametrize(
    ("targets", "said"),
    [
        ([["a", "b", "c"]], r"targets: expected \(targets, 3\) or .* in metres, found text"),
        ([[0.1, 0.0, 0.2], [0.1]], "in metres, found rows of different length"),
        ([rejoint.Pose(place_m=TARGET[0]), TARGET[0]], "some are poses and some are points"),
    ],
)
def test_targets_that_are_none_are_named(targets, said) -> None:
    with pytest.raises(InputError, match=said):
        rejoint.deploy(WORN, "default", targets)


def test_targets_that_come_one_by_one_are_all_taken() -> None:
    places = ((0.17, 0.0, 0.2), (0.18, 0.03, 0.21))
    wanted, _ = as_targets(places, mycobot280(), sets=1, seed=0)
    for given in (iter(places), (rejoint.Pose(place_m=place) for place in places)):
        np.testing.assert_array_equal(as_targets(given, mycobot280(), sets=1, seed=0)[0], wanted)
    with pytest.raises(rejoint.InputError, match=r"expected .* in metres"):
        as_targets(5, mycobot280(), sets=1, seed=0)


def test_one_controller_needs_no_list() -> None:
    assert listed("default") == ("default",)
    with pytest.raises(InputError, match="no controller is called 'nope'"):
        rejoint.compare(WORN, "nope", TARGET)


def test_a_payload_may_be_any_number() -> None:
    masses = [loaded(mycobot280(), kilograms).mass for kilograms in (0.25, np.float32(0.25), np.float64(0.25))]
    np.testing.assert_array_equal(masses[0], masses[1])
    np.testing.assert_array_equal(masses[0], masses[2])
    with pytest.raises(InputError, match=r"tool: expected x, y, z of at most 0.5 m, found text"):
        loaded(mycobot280(), tool=["0", "0", "0.1"])


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"time": np.datetime64("2026-01-01") + np.arange(50).astype("m8[ms]")}, "time: expected numbers, found dates"),
        ({"time": np.arange(50).astype("m8[ms]")}, "time: expected numbers, found spans of time"),
        ({"time": ["a"] * 50}, "time: expected numbers, found text"),
        ({"time": 3.0}, r"time has shape \(\), expected \(1,\)"),
        ({"position": MOTION + 0j}, "position: expected numbers, found complex numbers"),
        ({"command": [[1.0, 2.0], [1.0]]}, "command: expected numbers, found rows of different length"),
        ({"position": MOTION[:, :5]}, r"position has shape \(50, 5\), expected \(50, 6\)"),
    ],
)
def test_a_log_is_made_of_numbers(changed, said) -> None:
    given = {"time": TIME, "command": MOTION, "position": MOTION} | changed
    with pytest.raises(InputError, match=said):
        rejoint.RunLog.of(**given, arm="mycobot280")


@pytest.mark.parametrize(("factor", "said"), [(1e3, "30 s apart"), (1e9, r"3e\+07 s apart")])
def test_times_of_another_unit_are_refused(factor: float, said: str) -> None:
    log = rejoint.RunLog.of(factor * TIME, MOTION, MOTION, arm="mycobot280")
    with pytest.raises(InputError, match=f"its rows are {said}; give times in seconds"):
        rejoint.diagnose(log)


def test_a_log_copies_what_it_is_given() -> None:
    position = MOTION.copy()
    log = rejoint.RunLog.of(TIME, MOTION.tolist(), position, arm="mycobot280")
    position[:] = 1.0
    assert not log.position.any()
    np.testing.assert_array_equal(as_floats("numbers", [Decimal("0.5"), 1]), [0.5, 1.0])
