"""A joint that does not follow: dead encoders are noticed by name and in time, stuck joints are let be."""

from dataclasses import replace

import numpy as np
import pytest

from modelfiles import resized
from rejoint.arms import mycobot280, position_kinematics
from rejoint.control import compiled
from rejoint.control.controllers.catalogue import make_controller
from rejoint.control.guard import GuardLimits, Reason
from rejoint.control.loop import RELEASE_CYCLES, Schedule, run
from rejoint.control.monitor import EXCUSED, Bands, Following
from rejoint.control.recording import recording_of
from rejoint.control.start import play
from rejoint.system.errors import GuardTripError
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear
from standin import state_of

ARM = mycobot280()
REST = ARM.rest
LIMITS = GuardLimits.of(ARM)


class Breaking(EmulatedRobot):
    """Emulated arms whose ``joint`` (B,) goes frozen or blind at the clock ``at`` (B,)."""

    def break_at(self, at, joint, *, blind):
        self.at, self.blind = np.asarray(at, dtype=float), blind
        self.broken = np.arange(ARM.joints) == np.asarray(joint)[:, None]
        return self

    def step(self, command, active=None):
        due = self.broken & (self.plant.time >= self.at)[:, None]
        if due.any():
            (self.plant.blind if self.blind else self.plant.freeze)(due)
        return super().step(command, active)


def worn(count, first=0, kind="worn"):
    return [load_wear(f"{kind}?seed={first + i}", ARM) for i in range(count)]


def stuck(wear, joint, lead_deg):
    friction = wear.position_gain[joint] * np.radians(lead_deg)
    coulomb, stiction = wear.coulomb.copy(), wear.stiction.copy()
    coulomb[joint], stiction[joint] = friction, 1.1 * friction
    return replace(wear, coulomb=coulomb, stiction=stiction)


def known(wears):
    """Limits with the bands that a diagnosis would give."""
    names = "position_gain", "stiction", "torque_limit"
    gain, friction, most = (np.array([getattr(wear, name) for wear in wears]) for name in names)
    bands = Bands(slope=1.0 / gain, offset=0.0 * gain, reach=most / gain, width=2.0 * friction / gain)
    return replace(LIMITS, bands=bands)


def targets(count, seed=5):
    return ARM.targets.sample(np.random.default_rng(seed), (count, 2))


DWELL = Schedule(dwell=2.0, keep_going=True)


@pytest.mark.parametrize("kind", ["worn", "healthy", "play-in-loop", "stuck"])
@pytest.mark.parametrize("controller", ["default", "feedforward"])
def test_arms_that_are_only_worn_or_stuck_do_not_trip(kind, controller):
    count = 16
    wears = worn(count, 90, "worn" if kind == "stuck" else kind)
    if kind == "stuck":
        wears = [stuck(wear, i % 4, (5.0, 10.0, 15.0, 1000.0)[i // 4]) for i, wear in enumerate(wears)]
    robot = EmulatedRobot(ARM, wears, seed=8)
    recording = run(robot, make_controller(controller, ARM), targets(count, seed=6), DWELL, limits=known(wears))
    assert (recording.tripped == 0).all()


def test_the_error_names_joint_and_cause_and_the_joint_goes_back_to_its_balance():
    wears = worn(1)
    robot = Breaking(ARM, wears, seed=1).break_at([0.5], [1], blind=True)
    with pytest.raises(
        GuardTripError, match=r"not following.*joint2: the command moved .* the reading 0.* at a push"
    ) as caught:
        run(robot, make_controller("integrator", ARM), targets(1), Schedule(dwell=5.0), limits=known(wears))
    assert caught.value.exit_code == 3
    recording = recording_of(caught.value)
    trip = np.flatnonzero(recording.reasons[:, 0] & Reason.NOT_FOLLOWING)[0]
    assert len(recording.time) == trip + 1 + RELEASE_CYCLES, "the log ends with the last sample"
    stood = np.flatnonzero(np.diff(recording.position[:, 0, 1]))[-1] + 1
    balance = recording.command[: stood + 1, 0, 1]
    assert np.abs(balance - recording.command[-1, 0, 1]).min() < 1e-12, "a command from before its reading stood"
    np.testing.assert_array_equal(
        recording.command[-1, 0, [0, 2, 3, 4, 5]], recording.command[trip, 0, [0, 2, 3, 4, 5]]
    )


class Standing(EmulatedRobot):
    """An arm whose joint 2 stands, by what it tells, from each of ``times`` [s] until it is led back, or for ever."""

    times, alive, flicker, told, sent = (), True, 0.0, None, 0.0

    def step(self, command, active=None):
        state, back = super().step(command, active), command[0, 1] - self.sent
        self.sent = command[0, 1]
        if self.told is None and self.times and state.time[0] >= self.times[0]:
            self.told, self.times = state.position[0, 1], self.times[1:]
        if self.told is not None and self.alive and back > np.radians(1.0):
            self.told = None  # it had broken loose just before
        position = state.position.copy()
        if self.told is not None:
            position[0, 1] = self.told + self.flicker * (round(state.time[0] / 0.1) % 2)
        return replace(state, position=position, load=None)


BANDS = Bands(slope=np.zeros(6), offset=np.zeros(6), reach=np.full(6, 1.0), width=np.full(6, np.radians(1.0)))


def away(time):
    return REST + np.minimum(0.5 * time, 3.0)[:, None] * np.array([0.0, -0.2, 0.0, 0.0, 0.0, 0.0])


def stood(*times, alive=True, flicker=0.0):
    robot = Standing(ARM, [load_wear("healthy", ARM)], seed=1)
    robot.times, robot.alive, robot.flicker = times, alive, flicker
    return play(robot, away, 8.0, limits=replace(LIMITS, bands=BANDS))


def test_a_joint_that_broke_loose_while_it_was_led_back_goes_on():
    recording = stood(1.0)
    assert (recording.tripped == 0).all()
    doubted = np.flatnonzero(recording.reasons[:, 0] & Reason.NOT_FOLLOWING)
    gone_on = np.flatnonzero(recording.reasons[:, 0] & Reason.GAP)
    assert len(gone_on) == 1
    assert doubted[0] < gone_on[0]
    assert (np.diff(recording.time[:, 0]) > 0.0).all()
    after = recording.command[gone_on[0] + 1 :, 0, 1]
    speed = np.abs(np.diff(after)) / np.diff(recording.time[gone_on[0] + 1 :, 0])
    assert speed.max() < 0.3 * ARM.max_speed[1], "slowly, and nothing is caught up with"
    assert after[-1] < recording.command[doubted[0], 0, 1] - np.radians(2.0), "it goes on where it was going"


def test_while_a_joint_is_led_back_the_motion_waits_and_answers_come():
    recording = stood(1.0)
    assert not recording.gaps().any()
    passed = recording.time[-1, 0] - recording.time[0, 0]
    waited = recording.waits()[:, 1].sum()
    assert waited > 0.2
    assert recording.since_target[-1, 0] + waited == pytest.approx(passed, abs=1e-6)


def test_a_reading_that_stays_or_flickers_or_stands_again_and_again_is_not_believed():
    for flicker in (0.0, ARM.encoder_step):
        with pytest.raises(GuardTripError, match="not following"):
            stood(1.0, alive=False, flicker=flicker)
    with pytest.raises(GuardTripError, match="not following") as caught:
        stood(1.0, 3.0, 5.0)
    recording = recording_of(caught.value)
    assert np.count_nonzero(recording.reasons[:, 0] & Reason.GAP) == 2


def test_without_load_a_frozen_encoder_that_never_moved_carries_the_tool_no_farther_than_its_bound():
    count = 10
    robot = Breaking(ARM, worn(count, kind="healthy"), seed=2, tells_load=False)
    robot.break_at(np.zeros(count), np.arange(count) % 4, blind=False)
    start = robot.plant.link_position()
    reached = []

    def measure(cycle):
        lever = np.linalg.norm(position_kinematics(ARM, cycle.position)[1], axis=-2)
        reached.append((np.abs(robot.plant.link_position() - start) * lever)[robot.broken])

    run(robot, make_controller("integrator", ARM), targets(count), DWELL, on_cycle=measure)
    assert 0.005 < np.max(reached) < 0.030


def test_a_motor_too_weak_for_its_load_is_no_dead_encoder():
    """It holds the joint and does not raise it, whatever it is sent: only the way back shows that the reading lives."""
    wear = load_wear("worn?seed=410002", ARM)
    weak = replace(wear, torque_limit=np.where(np.arange(6) == 1, 0.7, 1.0) * wear.torque_limit)
    friction = wear.stiction / wear.position_gain
    bands = Bands(slope=1.0 / wear.position_gain, offset=np.zeros(6), reach=np.full(6, 1.0), width=1.2 * friction)
    robot = EmulatedRobot(ARM, [weak], seed=1, tells_load=False)

    def down_and_up(time):
        return REST + np.interp(time, [0.0, 4.0, 8.0], [0.0, 1.0, 0.0])[:, None] * np.radians([0, -40, 0, 0, 0, 0])

    recording = play(robot, down_and_up, 10.0, limits=replace(LIMITS, bands=bands))
    assert (recording.tripped == 0).all()
    assert np.count_nonzero(recording.reasons & Reason.GAP) == 1, "doubted once, and then its motor is known"
    assert np.degrees(recording.command[-1, 0, 1] - recording.position[-1, 0, 1]) > 15.0


def test_a_joint_that_falls_ends_any_motion():
    wear = load_wear("healthy", ARM)
    robot = EmulatedRobot(ARM, [replace(wear, torque_limit=np.where(np.arange(6) == 1, 0.02, 1.0) * wear.torque_limit)])
    schedule = Schedule(dwell=6.0, keep_going=True)
    recording = run(robot, make_controller("default", ARM), np.array([[[0.2, 0.0, 0.2]]]), schedule, limits=LIMITS)
    assert recording.tripped[0] == Reason.NOT_FOLLOWING


def test_a_joint_that_follows_its_command_away_from_its_goal_does_not_fall():
    state = state_of(REST[None])
    watch, goal, none = Following(ARM, state, state.position), REST[None] + np.radians(40.0), np.zeros(1, dtype=bool)
    for behind, falls in ((1.0, False), (8.0, True)):
        for k in range(1, 60):
            away = REST[None] - np.radians(1.0 * k) * (np.arange(6) == 1)
            now = replace(state, time=np.full(1, 0.025 * k), position=away)
            watch.check(now, away + np.radians(behind), none, goal)
        assert watch.falling.any() == falls


def test_a_joint_without_a_band_is_judged_as_one_without_a_diagnosis():
    state, aimed, endless = state_of(REST[None]), np.ones(1, dtype=bool), np.full(6, np.inf)
    bands = Bands(slope=np.zeros(6), offset=np.zeros(6), reach=endless, width=endless)
    watches = [Following(ARM, state, state.position, each) for each in (None, bands)]
    flagged = []
    for k in range(1, 240):
        sent = REST[None] + np.radians(20.0) * np.sin(0.05 * k) * (np.arange(6) == 0)
        read = np.where(np.arange(6) == 0, REST[0] + np.radians(20.0) * np.sin(0.05 * min(k - 1, 120)), sent)
        now = replace(state, time=np.full(1, 0.025 * k), position=read)
        flagged.append([watch.check(now, sent, aimed) for watch in watches])
    without, unknown = np.swapaxes(flagged, 0, 1)
    assert (without == unknown).all()
    assert without[:, 0, 0].any(), "a frozen reading of a joint that moved is noticed"


def swing(time):
    """Two joints to and fro, farther than a monitor of travel would allow."""
    wave = np.radians(14.0) * np.sin(2.0 * np.pi * time / 3.0)
    return REST + wave[:, None] * np.array([1.0, 0.0, 1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("tells_load", [True, False])
def test_an_excitation_finds_stuck_joints_and_is_not_ended_by_them(tells_load):
    wears = [stuck(wear, 0, 1000.0) for wear in worn(3)]
    recording = play(EmulatedRobot(ARM, wears, seed=4, tells_load=tells_load), swing, 6.0)
    assert (recording.tripped == 0).all()
    assert (np.ptp(recording.position[:, :, 0], axis=0) < np.radians(1.0)).all()


def test_without_load_a_joint_that_hardly_ever_moved_is_bounded_and_not_judged():
    """The command of joint 1 is raised by 0.1 deg a cycle over a reading that stands."""
    wanted, state = REST[None] + 0.3, state_of(REST)
    watch = Following(ARM, state, state.position)
    for k in range(1, 120):
        sent = REST[None] + np.radians(0.1 * (k - 1)) * np.eye(6)[0]
        assert not watch.check(replace(state, time=np.full(1, 0.025 * k)), sent, np.full(1, True)).any()
    assert 0.03 < watch.bound(wanted, REST[None], np.full(1, True))[0, 0] - REST[0] < 0.115
    assert (watch.bound(wanted, REST[None], np.full(1, False)) == wanted).all(), "no bound on a trajectory"
    sticky = Following(ARM, state_of(REST[None]), REST[None], Bands(stood=np.full(6, 0.08)))
    assert sticky.bound(wanted, REST[None], np.full(1, True))[0, 0] - REST[0] == pytest.approx(0.127, abs=1e-3)


def test_friction_holds_the_joints_of_a_longer_arm_over_the_same_angles():
    reach = []
    for arm in (ARM, resized(ARM, 4.0)):
        state = state_of(REST)
        watch = Following(arm, state, REST[None])
        reach.append(watch.bound(REST[None] + 0.3, REST[None], np.ones(1, dtype=bool)) - REST)
    np.testing.assert_allclose(*reach, rtol=1e-9)


def test_an_arm_that_is_at_once_where_it_is_sent_and_stands_there_is_never_judged():
    sent, clock = np.tile(REST, (1, 1)), 0.0
    watcher, away = Following(ARM, state_of(sent, clock), sent), sent + np.radians(30.0)
    for goal in (away, sent) * 3:
        for _ in range(100):
            clock += 0.02
            assert not watcher.check(state_of(sent, clock), sent, np.array([True])).any()
            sent = sent + np.clip(goal - sent, -np.radians(8.0), np.radians(8.0))


def bands_of(width_deg, **changes):
    flat = {"slope": np.zeros(6), "offset": np.zeros(6), "reach": np.full(6, np.inf)}
    return Bands(**{**flat, **changes}, width=np.full(6, np.radians(width_deg)))


def pushed(lead_deg, bands, *, period=0.025, moves=()):
    """When [s] a joint is overdue that leads by so much from 0.5 s on, and stands but for the cycles ``moves``."""
    state = state_of(REST)
    third, position = np.arange(6) == 2, REST.copy()
    watch = Following(ARM, state, REST[None], bands)
    for k in range(1, 200):
        position = position + ARM.encoder_step * (k in moves) * third
        sent = position + np.radians(lead_deg) * ((k - 1) * period >= 0.5) * third
        now = state_of(position, k * period)
        bad = watch.check(now, sent[None], np.zeros(1, dtype=bool))
        if bad.any():
            assert bad.tolist() == [[False, False, True, False, False, False]]
            return k * period - 0.5, watch.describe(0, 2)
    return np.inf, ""


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("period", [0.02, 0.05])
def test_a_joint_that_stands_is_overdue_the_sooner_the_harder_it_is_pushed(sign, period):
    allowed = np.degrees(compiled.MOST * np.radians(1.0) + compiled.AND)
    assert pushed(sign * (allowed - 0.01), bands_of(1.0), period=period)[0] == np.inf
    times = [pushed(sign * (allowed + more), bands_of(1.0), period=period)[0] for more in (0.1, 0.5, 2.0, 10.0)]
    assert np.isfinite(times).all()
    assert (np.diff(times) <= 0.0).all()
    assert times[0] > times[-1]
    # Twice the integral of an excess of 0.5 over a band of 1 is 0.05^2 after 0.1 s, and the command has to arrive.
    late, arrived = np.sqrt(2.0 * compiled.PATIENCE**2 / 0.5), max(compiled.SETTLE, (compiled.AFTER + 1) * period)
    assert arrived + late <= times[1] + 1e-9
    assert times[1] <= arrived + late + 2.0 * period + 1e-9


@pytest.mark.parametrize("period", [0.02, 0.025, 0.05])
@pytest.mark.parametrize("stall", [0.0, 0.05, 0.1, 0.2])
def test_a_whole_joint_whose_command_was_acknowledged_late_is_believed(period, stall):
    """The wire stalls: a command is acknowledged when the next reading is due, and its joint sets off 20 ms later."""
    third, way, stalled = np.arange(6) == 2, np.radians(10.0), 20
    clocks = period * np.arange(40) + stall * (np.arange(40) > stalled)
    arrives = clocks[stalled + 1] if stall else clocks[stalled] + 0.013
    state = state_of(REST)
    watch, gone = Following(ARM, state, REST[None], bands_of(1.0)), 0.0
    for k, clock in enumerate(clocks[1:], 1):
        gone = np.clip((clock - 0.013 - arrives - 0.02) * np.radians(100.0), 0.0, way)
        now = replace(state, time=np.full(1, clock), position=(REST + gone * third)[None])
        sent = REST + way * third * (k > stalled)
        assert not watch.check(now, sent[None], np.zeros(1, dtype=bool)).any(), f"at {clock:.3f} s"
    assert gone == way


def test_readings_that_change_and_joints_of_which_nothing_is_known_are_never_overdue():
    assert pushed(10.0, bands_of(1.0), moves=range(0, 200, 2))[0] == np.inf
    assert pushed(10.0, bands_of(np.inf))[0] == np.inf
    assert pushed(10.0, bands_of(1.0, reach=np.full(6, np.radians(1.5))))[0] == np.inf, (
        "no servo pushes beyond its reach"
    )


def stands_after_a_step(joints, late):
    """Verdicts (12, n) after ``joints`` (n,) are sent 25 deg on at once, of which those ``late`` (n,) stand."""
    swings = [REST + np.radians(3.0) * np.sin(0.5 * min(k, 55)) for k in range(61)]  # so all are known to move
    wanted = np.array([*swings, *[swings[-1] + np.radians(25.0) * joints] * 12])
    read = np.array([wanted[0], *wanted[:-1]])  # a cycle later
    read[62:, late] = wanted[60, late]
    watch, found = Following(ARM, state_of(read[:1], 0.0), wanted[:1]), []
    for k in range(1, len(wanted)):
        bad = watch.check(state_of(read[k][None], 0.05 * k), wanted[k - 1][None], np.ones(1, dtype=bool))
        found.append(bad[0])
    assert not np.any(found[:60])
    return np.array(found[60:])


def test_two_encoders_hardly_die_at_once_but_an_arm_may_be_late():
    first_three, third = np.arange(6) < 3, np.arange(6) == 2
    alone = stands_after_a_step(first_three, third)
    together = stands_after_a_step(first_three, first_three)
    dead = [np.flatnonzero(seen.any(axis=-1))[0] for seen in (alone, together)]
    assert (alone[dead[0]] == third).all()
    assert 0.05 * (dead[1] - dead[0]) == pytest.approx(EXCUSED, abs=0.051), "bounded, and then both are named"
    assert together[dead[1]].sum() >= 2
