import numpy as np
import pytest

from rejoint.arms import gravity_torque, mycobot280, solve_position, tcp_position
from rejoint.control.controller import ControlInput
from rejoint.control.integrator import IntegratorController
from rejoint.control.loop import Schedule, run
from rejoint.control.robot import JointState, Robot
from rejoint.research.rivals.adaptive import AdaptiveController, AdaptiveGains
from rejoint.research.rivals.catalogue import RIVALS, make_rival
from rejoint.research.rivals.scheduled import ScheduledController, ScheduledGains
from rejoint.research.rivals.tuning import TuningSettings, candidate_costs, tune
from rejoint.research.rivals.twinrobot import TwinRobot
from rejoint.system.errors import InputError
from rejoint.training.ranges import BroadRanges
from rejoint.training.task import ReachTask, TaskSettings

ARM = mycobot280()
RANGES = BroadRanges(arm=ARM)
TARGET = np.array([[0.18, 0.02, 0.20], [0.2, -0.05, 0.18]])

PLAIN = ScheduledGains(
    far_rate=4.0, near_rate=4.0, schedule=1.0, deadband=0.0, proportional=0.0, damping=0.0, prediction=0.0, moving=1e9,
    speed=1e9, lead=np.radians(15.0),
)  # fmt: skip


def inputs(position: np.ndarray, sent: np.ndarray, time: float = 0.0) -> ControlInput:
    state = JointState(time=np.full(len(sent), time), position=position, age=np.zeros(len(sent)))
    return ControlInput(state=state, target=TARGET, sent=sent, since_target=np.full(len(sent), time))


def test_without_its_extras_the_schedule_is_the_integrator():
    # Inside the distance at which the plain one pulls to rest, and with its fade undone, both are the same law.
    posture = solve_position(ARM, TARGET + 0.004, np.tile(ARM.rest, (2, 1))).q
    mine = ScheduledController(ARM, "mine", PLAIN, anchored=False)
    mine.reset(inputs(posture, posture), np.ones(2, dtype=bool))
    sent = mine.command(inputs(posture, posture))
    plain = IntegratorController(ARM).command(inputs(posture, posture))
    error = np.linalg.norm(TARGET - tcp_position(ARM, posture), axis=-1, keepdims=True)
    np.testing.assert_allclose((plain - posture) * (error + 0.004) / error, sent - posture, rtol=1e-9)


def test_gains_of_a_batch_act_arm_by_arm():
    posture = np.tile(ARM.rest, (2, 1))
    both = {**PLAIN.__dict__, "far_rate": np.array([[2.0], [6.0]]), "near_rate": np.array([[2.0], [6.0]])}
    together = ScheduledController(ARM, "both", ScheduledGains(**both), anchored=False)
    together.reset(inputs(posture, posture), np.ones(2, dtype=bool))
    moved = together.command(inputs(posture, posture))
    for i, rate in enumerate((2.0, 6.0)):
        gains = ScheduledGains(**{**PLAIN.__dict__, "far_rate": rate, "near_rate": rate})
        alone = ScheduledController(ARM, "one", gains, anchored=False)
        alone.reset(inputs(posture, posture), np.ones(2, dtype=bool))
        np.testing.assert_array_equal(alone.command(inputs(posture, posture))[i], moved[i])


def test_the_feedforward_starts_with_the_sag_of_the_goal():
    gains = ScheduledGains(**{**PLAIN.__dict__, "far_rate": 0.0, "near_rate": 0.0, "feedforward": 1.5})
    law = ScheduledController(ARM, "ff", gains, anchored=True)
    start = np.tile(ARM.rest, (2, 1))
    law.reset(inputs(start, start), np.ones(2, dtype=bool))
    command = law.command(inputs(start, start, time=1.0))
    goal = solve_position(ARM, TARGET, start).q
    np.testing.assert_allclose(command, goal + 1.5 * gravity_torque(ARM, goal) / 6.0, atol=1e-12)


def test_the_adaptive_law_learns_what_its_regressor_spans():
    # A joint that is softer than believed: at rest its error is what the compensation lacks.
    gains = AdaptiveGains(
        softness_rate=20.0, load_rate=1e-3, offset_rate=1e-3, scale=1.0, damping=0.0, dead_zone=0.0, proportional=0.0,
        derivative=0.0, prior=0.5,
    )  # fmt: skip
    law, start = AdaptiveController(ARM, "adaptive", gains), np.tile(ARM.rest, (2, 1))
    law.reset(inputs(start, start), np.ones(2, dtype=bool))
    goal = solve_position(ARM, TARGET, start).q
    load = gravity_torque(ARM, goal)
    truth, position = 1.4 * load / 6.0, start
    for k in range(4000):
        position = law.command(inputs(position, position, time=0.025 * (k + 1))) - truth
    loaded = np.abs(load) > 0.1
    assert loaded.sum() >= 2
    np.testing.assert_allclose(position[loaded], goal[loaded], atol=1e-4)
    raised = law.command(inputs(position, position, time=0.025 * 4000)) - goal  # no time passes: as at the end
    np.testing.assert_allclose(raised[loaded] / (load / 6.0)[loaded], 1.4, atol=0.02)


def test_a_robot_of_twins_steps_the_simulation_of_the_training():
    task = ReachTask(ARM, RANGES, 4, TaskSettings(hold_steps=10**6), seed=3)
    robot = TwinRobot(ARM, RANGES.draw(np.random.default_rng(1), 4), seed=0)
    assert isinstance(robot, Robot)
    assert type(robot.simulation) is type(task.simulation)
    before = robot.read()
    after = robot.step(robot.simulation.reference.position.copy(), np.array([True, False, True, True]))
    assert (after.time > before.time).all()
    np.testing.assert_array_equal(after.position[1], before.position[1])


def test_twins_rest_where_their_first_command_holds_them():
    draw = RANGES.draw(np.random.default_rng(2), 8)
    strong = TwinRobot(ARM, draw, seed=0)
    for _ in range(40):
        strong.step(strong.simulation.reference.position.copy())
    able = (draw.twin.torque_limit > 1.2 * np.abs(gravity_torque(ARM, ARM.rest))).all(axis=1)
    assert able.any()
    assert np.abs(strong.read().position - ARM.rest)[able].max() < np.radians(0.5)


def test_candidates_meet_the_same_arms():
    settings = TuningSettings(arms=3, targets=1, hold=1.5)
    rates = {name: np.full(3, value) for name, value in PLAIN.__dict__.items() if not isinstance(value, int)}
    rates |= {"feedforward": np.zeros(3), "ramp": np.full(3, 9.0), "carry": np.ones(3)}
    rates["far_rate"] = rates["near_rate"] = np.array([4.0, 1.0, 4.0])
    costs = candidate_costs(ARM, RANGES, rates, RIVALS["tuned-feedforward"].make, settings, 0)
    assert costs[0] == costs[2] != costs[1]


def test_the_tuning_finds_the_bottom_of_a_known_valley(monkeypatch):
    # The search itself, without arms: the cost is a bowl around one gain per decade.
    def bowl(arm, ranges, gains, make, settings, draw_seed):
        return (np.log(gains["a"] / 0.5)) ** 2 + (np.log(gains["b"] / 20.0)) ** 2

    monkeypatch.setattr("rejoint.research.rivals.tuning.candidate_costs", bowl)
    intervals, seen = {"a": (0.01, 10.0), "b": (1.0, 100.0)}, []
    settings = TuningSettings(generations=30)
    found = tune(ARM, RANGES, intervals, None, settings, lambda *report: seen.append(report))
    assert found["a"] == pytest.approx(0.5, rel=0.03)
    assert found["b"] == pytest.approx(20.0, rel=0.03)
    assert [report[0] for report in seen] == list(range(1, 31))


@pytest.mark.parametrize("name", list(RIVALS))
def test_tuned_rivals_reach_targets_on_a_twin(name):
    draw = RANGES.draw(np.random.default_rng(6), 4)
    twin = type(draw.twin)(**{**draw.twin.__dict__, "torque_limit": np.full((4, 6), 3.0)})
    robot = TwinRobot(ARM, type(draw)(**{**draw.__dict__, "twin": twin}), seed=0)
    targets = ARM.targets.sample(np.random.default_rng(7), (4, 1))
    recording = run(robot, make_rival(name, ARM), targets, Schedule(dwell=4.0, keep_going=True))
    error = np.linalg.norm(targets[:, 0] - tcp_position(ARM, recording.position[-1]), axis=-1)
    assert np.median(error) < 0.003


def test_gains_must_be_those_of_the_rival():
    with pytest.raises(InputError, match="expected"):
        make_rival("adaptive", ARM, {"rate": 1.0})
    with pytest.raises(InputError, match="tuned-integrator"):
        make_rival("nobody", ARM)
