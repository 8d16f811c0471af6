"""Laws of following: an observer finds what pushes a joint, worn arms follow, and repetition takes out what repeats."""

from dataclasses import replace

import numpy as np
import pytest

from rejoint.arms import gravity_torque, mycobot280, so101
from rejoint.control.controllers.classical import DefaultController
from rejoint.control.loop import Schedule, run
from rejoint.control.moving.drive import along, judge, next_aim
from rejoint.control.moving.reference import PathReference, standard_path
from rejoint.control.moving.tracker import PathPostures, PushObserver, Tracker, command_for
from rejoint.control.robot import Servos
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.servo import Channel
from rejoint_lab.plant.wear import load_wear
from standin import inputs_of, state_of

ARM = mycobot280()


def worn_servos(count=1, arm=ARM):
    """What a twin of the worn profile would say, with its errors."""
    wear = load_wear("worn", arm)
    rows = {
        "stiffness": wear.position_gain,
        "damping": wear.damping_gain + wear.torque_limit / 5.0,
        "coulomb": 1.1 * wear.coulomb,
        "armature": 0.9 * wear.reflected_inertia,
        "torque_limit": wear.torque_limit,
        "offset": np.zeros(arm.joints),
    }
    return Servos(**{name: np.tile(row, (count, 1)) for name, row in rows.items()}, delay=np.full(count, 0.022))


def drive(controller, guides, seed=0, arm=ARM, **wire):
    start = PathPostures(arm, np.stack([guide.place[0] for guide in guides])).last
    robot = EmulatedRobot(arm, [load_wear("worn", arm)] * len(guides), seed=seed, start=start, **wire)
    dwell = 2.0 + max(guide.duration for guide in guides)
    servos = worn_servos(len(guides), arm)
    sent = command_for(arm, servos, np.stack([start] * 3))  # what holds it there
    return run(robot, controller, PathReference(arm, guides), Schedule(dwell=dwell, sent=sent))


def test_the_inverse_of_an_arm_at_rest_is_gravity_over_stiffness():
    servos = replace(worn_servos(2), offset=np.full((2, ARM.joints), 0.02))
    posture = np.stack([ARM.rest, ARM.rest + 0.1])
    expected = posture - 0.02 + gravity_torque(ARM, posture) / servos.stiffness
    assert np.allclose(command_for(ARM, servos, np.stack([posture] * 3)), expected)


def test_the_observer_finds_a_constant_push_and_foresees_what_was_sent():
    servos, period = worn_servos(), 0.025
    observer, time = PushObserver(ARM, servos), np.zeros(1)
    push = np.linspace(-0.03, 0.03, ARM.joints)[None]
    for _ in range(120):  # a joint at rest under a push stands off by just that
        time = time + period
        observer.see(time, np.full(1, period), push)
    assert np.allclose(observer.push, push, atol=2e-4)
    assert np.allclose(observer.after(time, servos.delay)[0], push, atol=2e-4)
    observer.sent(time - 0.02, -push)  # takes it away: the joint begins to move home
    later = observer.after(time, servos.delay)[0]
    assert (np.abs(later[np.abs(push) > 0.01]) < np.abs(push[np.abs(push) > 0.01])).all()


@pytest.mark.parametrize(("arm", "most"), [(ARM, 1.5e-3), (so101(), 2.5e-3)], ids=["mycobot280", "so101"])
def test_a_worn_arm_follows_a_circle_better_than_one_that_is_sent_it(arm, most):
    paths = [standard_path(name, arm) for name in ("circle-8s", "random-0.5hz")]
    guides = [replace(path, time=path.time[path.time < 9.0], place=path.place[path.time < 9.0]) for path in paths]
    tracked = drive(Tracker(arm, worn_servos(2, arm)), guides, arm=arm)
    sent = drive(DefaultController(arm), guides, arm=arm)
    for b, guide in enumerate(guides):
        assert judge(arm, tracked, guide, b).encoder.rms < most
        assert judge(arm, sent, guide, b).encoder.rms > 10e-3


def test_the_tool_follows_though_a_wrist_joint_is_stuck_far_from_where_it_should_be():
    guide, worn = standard_path("circle-8s", ARM), load_wear("worn", ARM)
    stuck = {name: np.where(np.arange(ARM.joints) == 3, 5.0, getattr(worn, name)) for name in ("coulomb", "stiction")}
    start = PathPostures(ARM, guide.place[:1]).last + np.radians([0.0, 0.0, 0.0, -60.0, 0.0, 0.0])
    robot = EmulatedRobot(ARM, [replace(worn, **stuck)], start=start)
    schedule = Schedule(dwell=2.0 + guide.duration, sent=start)
    seen = run(robot, Tracker(ARM, worn_servos()), PathReference(ARM, [guide], None), schedule)
    assert np.ptp(seen.position[:, 0, 3]) < np.radians(1.0)
    assert judge(ARM, seen, guide, 0).encoder.rms < 2e-3


@pytest.mark.parametrize(
    ("usual", "period", "most"),
    [(0.025, (0.050, 0.050), 2.0e-3), (0.05, (0.045, 0.055), 2.5e-3)],
    ids=["it grows slower, and the arm does not swing", "gains give way where a cycle is long"],
)
def test_an_arm_on_a_slow_wire_still_follows(usual, period, most):
    guide = standard_path("circle-8s", ARM)
    slower = drive(Tracker(ARM, worn_servos(), period=usual), [guide], channel=Channel(period=period))
    assert judge(ARM, slower, guide, 0).encoder.rms < most


def test_a_reset_on_the_way_forgets_nothing():
    servos, path = worn_servos(), standard_path("circle-4s", ARM)
    one, other = Tracker(ARM, servos), Tracker(ARM, servos)
    start = PathPostures(ARM, path.place[:1]).last
    for k in range(20):
        time = np.array([0.025 * k])
        state = state_of(start + 1e-3 * k, time)
        inputs = inputs_of(state, path.place[:1], start, start, time)
        if k == 0:
            one.reset(inputs, np.ones(1, dtype=bool))
        other.reset(inputs, np.ones(1, dtype=bool))
        assert np.array_equal(one.command(inputs), other.command(inputs))


def test_what_repeats_is_learned_and_a_lag_is_found():
    path = standard_path("circle-8s", ARM)
    time = np.arange(0.0, path.duration, 0.025)
    bias = 0.003 * np.stack([np.sin(time), np.cos(time), np.ones_like(time)], axis=-1)
    aim, seen = path, []
    for _ in range(8):  # an arm that misses every aim by the same
        aim = next_aim(path, seen, aim, time, path.at(time) - (aim.at(time) - bias))
    left = path.at(time) - (aim.at(time) - bias)
    assert np.abs(left[20:-20]).max() < 1e-4
    found = along(time, path.at(time - 0.06), time, path.at(time))
    assert found.lag == pytest.approx(0.06, abs=0.005)
    assert found.rms_after < 0.1 * found.rms


def test_what_differs_from_time_to_time_is_not_aimed_at():
    path, rng = standard_path("circle-20s", ARM), np.random.default_rng(0)
    time = np.arange(0.0, path.duration, 0.02)
    bias = 0.002 * np.sin(0.6 * time)[:, None] * np.ones(3)
    aim, seen, noise = path, [], 0.8e-3
    for _ in range(10):
        aim = next_aim(
            path, seen, aim, time, path.at(time) - (aim.at(time) - bias) + noise * rng.normal(size=bias.shape)
        )
    shift = aim.at(time) - path.at(time)
    wrong = np.sqrt(((shift - bias) ** 2).mean())
    assert wrong < 0.08 * noise, "the mean of ten times alone, below 3 Hz, is wrong by 0.11 of it"
    spectrum = np.abs(np.fft.rfft(shift[:, 0]))
    assert spectrum[int(1.5 * path.duration) :].max() < 0.01 * spectrum.max(), "nothing repeats at 1.5 Hz"
