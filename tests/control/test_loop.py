"""Laws of the control loop: order of events, independence of arms, and nothing lost when it ends early."""

import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from commandline import python
from rejoint.arms import mycobot280, tcp_position
from rejoint.control.controllers.classical import IntegratorController
from rejoint.control.guard import RAMP, GuardLimits, Reason
from rejoint.control.loop import Schedule, run
from rejoint.control.recording import recording_of
from rejoint.control.start import move, play
from rejoint.system.errors import GuardTripError, NoReplyError
from rejoint.system.stopping import Interrupted
from standin import StandIn

ARM = mycobot280()
TARGETS = ARM.targets.sample(np.random.default_rng(3), (4, 2))


class LaggingRobot(StandIn):
    """Arms that go a fixed share of the way to the command in each period and sag by a constant."""

    def __init__(self, *periods, sag=0.0, start=None):
        super().__init__(len(periods), period=periods, start=start)
        self.sag, self.time = sag, np.arange(self.count, dtype=float)  # clocks do not agree
        self.temperature, self.steps = np.full((self.count, ARM.joints), 30.0), np.zeros(self.count, int)
        self.fail_at, self.heat_at, self.received = np.inf, {}, []

    def read(self):
        return super().read(temperature=self.temperature)

    def step(self, command, active):
        self.received.append(command.copy())
        self.steps += active
        if self.steps.max() >= self.fail_at:
            raise NoReplyError("the arm did not answer within 0.3 s, check the cable")
        for b, at in self.heat_at.items():
            if self.steps[b] >= at:
                self.temperature[b, 2] = 90.0
        kept, state = self.position, super().step(command, active)
        kept[:] = self.position  # in place: the loop must not keep views of the robot's own arrays
        self.position = kept
        return replace(state, position=kept)

    def moved(self, command):
        return self.position + 0.3 * (command - self.sag - self.position)


class Straight:
    """Commands the measured position and remembers when it was asked what."""

    name = "straight"

    def __init__(self):
        self.resets, self.since = [], []

    def reset(self, inputs, where):
        self.resets.append((where.copy(), inputs.target.copy(), inputs.since_target.copy()))

    def command(self, inputs):
        self.since.append(inputs.since_target.copy())
        return inputs.state.position.copy()


def straight(robot, **options):
    return run(robot, Straight(), TARGETS[:1], Schedule(dwell=1.0), **options)


def test_no_control_cycle_waits_for_compiled_loops():
    code = (
        "import sys\n"
        "sys.path[:0] = sys.argv[1:]\n"
        "from test_loop import ARM, LaggingRobot, move\n"
        "class Robot(LaggingRobot):\n"
        "    def step(self, command, active):\n"
        "        assert {'rejoint.arms.compiled', 'rejoint.control.compiled'} <= before, before\n"
        "        return super().step(command, active)\n"
        "    def read(self):\n"
        "        before.update(sys.modules)\n"
        "        return super().read()\n"
        "before, robot = set(), Robot(0.02)\n"
        "assert 'numba' not in sys.modules\n"
        "move(robot, ARM.rest + 0.1, sent=ARM.rest[None], settle=0.1)\n"
    )
    here = Path(__file__).parent
    python("-c", code, here, here.parent)


def test_every_arm_keeps_its_own_time_and_number_of_cycles():
    robot = LaggingRobot(0.02, 0.04)
    rec = run(robot, Straight(), TARGETS[:2], Schedule(dwell=0.39))
    assert rec.active.sum(axis=0).tolist() == [41, 21]  # 2 targets x 20 or 10 periods, and the first reading
    for b, period in enumerate([0.02, 0.04]):
        rows = rec.active[:, b]
        np.testing.assert_allclose(np.diff(rec.time[rows, b]), period)
        assert (np.bincount(rec.target_index[rows, b]) == [rows.sum() // 2 + 1, rows.sum() // 2]).all()
    assert (robot.steps == [40, 20]).all()


def test_a_batch_is_many_single_runs():
    periods, schedule = [0.02, 0.025, 0.03], Schedule(dwell=3.0, stop_below=0.01)
    batch = run(LaggingRobot(*periods, sag=0.05), IntegratorController(ARM), TARGETS[:3], schedule)
    for b, period in enumerate(periods):
        alone = run(LaggingRobot(period, sag=0.05), IntegratorController(ARM), TARGETS[b : b + 1], schedule)
        ours, theirs = batch.log(b, "x"), alone.log(0, "x")
        np.testing.assert_allclose(ours.position, theirs.position, atol=1e-12)
        np.testing.assert_allclose(ours.command, theirs.command, atol=1e-12)
        assert (ours.target == theirs.target).all()


def test_the_next_target_comes_at_the_first_crossing():
    rec = run(LaggingRobot(0.025), IntegratorController(ARM), TARGETS[:1], Schedule(dwell=20.0, stop_below=0.01))
    error = np.linalg.norm(tcp_position(ARM, rec.position[:, 0]) - rec.target[:, 0], axis=-1)
    for k in range(2):
        segment = error[rec.target_index[:, 0] == k]
        assert (segment[:-1] >= 0.01).all()
        assert segment[-1] < 0.01
    second = np.flatnonzero(rec.target_index[:, 0] == 1)[0]
    np.testing.assert_allclose(rec.since_target[second, 0], 0.025)  # set when the first was crossed


def test_resets_come_with_the_new_target_and_a_fresh_clock():
    controller = Straight()
    run(LaggingRobot(0.02, 0.04), controller, TARGETS[:2], Schedule(dwell=0.1))
    where, target, since = zip(*controller.resets, strict=True)
    assert where[0].all()
    assert (target[0] == TARGETS[:2, 0]).all()
    for w, t, s in zip(where[1:], target[1:], since[1:], strict=True):
        assert (t[w] == TARGETS[:2, 1][w]).all()
        assert (s[w] == 0.0).all()
    assert np.sum(where[1:]) == 2


def test_row_k_holds_the_state_and_the_command_sent_right_after():
    robot = LaggingRobot(0.02)
    rec = run(robot, IntegratorController(ARM), TARGETS[:1], Schedule(dwell=0.5))
    sent = np.array(robot.received)[:, 0]
    assert (rec.command[:-1, 0] == sent).all()
    assert (rec.command[-1, 0] == sent[-1]).all()
    np.testing.assert_allclose(np.diff(rec.position[:, 0], axis=0), 0.3 * (sent - rec.position[:-1, 0]), atol=1e-12)
    assert (np.abs(rec.command[0] - rec.position[0]) <= ARM.max_speed * 0.02 + 1e-12).all()


def test_commands_keep_the_guards_limits_through_the_loop_which_remembers_their_speed():
    class Violent(Straight):
        def command(self, inputs):
            return inputs.sent + np.where(inputs.since_target % 0.08 < 0.04, 1.0, -1.0)[:, None]

    rec = run(LaggingRobot(0.02), Violent(), TARGETS[:1], Schedule(dwell=1.0))
    speed = np.diff(rec.command[:-1, 0], axis=0) / 0.02
    assert (np.abs(speed) <= ARM.max_speed + 1e-9).all()
    assert (rec.command <= GuardLimits.of(ARM).upper).all()
    assert (rec.reasons[:-1, 0] & Reason.STEP).any()
    assert (np.abs(np.diff(speed, axis=0)) <= ARM.max_speed / RAMP * 0.02 + 1e-9).all()
    assert (rec.reasons[:, 0] & Reason.ACCELERATION).any()
    assert (np.sign(speed[:-1]) == -np.sign(speed[1:])).any()  # it does turn round, in its own time


def test_a_controller_cannot_write_where_the_guard_reads():
    class InPlace(Straight):
        def command(self, inputs):
            inputs.sent[:] += 1.0
            return inputs.sent

    robot = LaggingRobot(0.02)
    with pytest.raises(ValueError, match="read-only"):
        run(robot, InPlace(), TARGETS[:1], Schedule(dwell=1.0))
    assert not robot.received


def test_a_trip_stops_the_robot_and_keeps_the_recording():
    robot = LaggingRobot(0.02)
    robot.heat_at = {0: 5}
    with pytest.raises(GuardTripError, match=r"temperature.*joint3 is at 90 deg C, limit 65") as caught:
        straight(robot)
    rec = recording_of(caught.value)
    assert robot.stops == 1
    assert robot.steps[0] == 5
    assert len(rec.time) == 6
    assert rec.tripped[0] == Reason.TEMPERATURE
    assert (rec.command[-1] == rec.command[-2]).all()
    assert caught.value.exit_code == 3


def test_a_trip_of_one_arm_can_leave_the_others_running():
    robot = LaggingRobot(0.02, 0.02)
    robot.heat_at = {1: 5}
    rec = run(robot, Straight(), TARGETS[:2], Schedule(dwell=0.5, keep_going=True))
    assert robot.steps[1] == 5
    assert robot.steps[0] > 40
    assert rec.tripped.tolist() == [0, Reason.TEMPERATURE]
    assert len(rec.log(1, "hot")) == 6


@pytest.mark.parametrize("stop_fails", [False, True])
def test_an_error_of_the_robot_loses_nothing(stop_fails):
    robot = LaggingRobot(0.02)
    robot.fail_at = 7
    if stop_fails:
        robot.stop = lambda: (_ for _ in ()).throw(NoReplyError("still nothing"))
    with pytest.raises(NoReplyError) as caught:
        straight(robot)
    assert len(recording_of(caught.value).log(0, "part")) == 7
    assert stop_fails or robot.stops == 1


def test_ctrl_c_stops_the_robot():
    robot, seen = LaggingRobot(0.02), []

    def interrupt(cycle):
        seen.append(cycle)
        if len(seen) == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as caught:
        straight(robot, on_cycle=interrupt)
    assert robot.stops == 1
    assert len(recording_of(caught.value).time) == 4


def test_what_brakes_an_interrupted_arm_has_its_own_row_in_recording_and_log():
    robot, seen, weak = LaggingRobot(0.02), [], ARM.rest + 0.5
    robot.moved = lambda _: robot.position
    step = robot.step

    def interrupted(command, active=None):
        state = step(command, np.ones(1, dtype=bool))
        if len(robot.received) == 12:
            raise Interrupted(signal.SIGINT)
        return state

    robot.step = interrupted
    with pytest.raises(Interrupted) as caught:
        play(robot, lambda _: weak[None], 1.0, on_cycle=seen.append)
    recording = recording_of(caught.value)
    np.testing.assert_array_equal(recording.command[:, 0], np.concatenate(robot.received), "all that was sent")
    assert np.degrees(np.abs(recording.command[-2:, 0] - recording.position[-2:, 0]).max(axis=1)) == pytest.approx(
        [20, 3]
    )
    np.testing.assert_array_equal([cycle.command for cycle in seen], recording.command)
    assert len(recording.log(0, "stopped")) == 13


def test_a_joint_that_never_moved_is_held_near_its_reading_and_the_recording_says_so():
    robot = LaggingRobot(0.02)
    robot.moved = lambda _: robot.position
    recording = run(robot, IntegratorController(ARM), TARGETS[:1, :1], Schedule(dwell=2.0))
    assert (recording.reasons[-10:-1, 0] == Reason.LEAD).all()


def test_an_error_before_the_first_state_leaves_no_recording():
    robot = LaggingRobot(0.02)
    robot.read = lambda: (_ for _ in ()).throw(NoReplyError("nothing there"))
    with pytest.raises(NoReplyError) as caught:
        straight(robot)
    assert recording_of(caught.value) is None
    assert robot.stops == 1


def test_play_follows_the_clock_and_has_no_target():
    def wave(time):
        return ARM.rest + 0.1 * np.sin(time)[:, None] * np.ones(ARM.joints)

    rec = play(LaggingRobot(0.02, 0.03), wave, 1.0)
    assert np.isnan(rec.target).all()
    for b in range(2):
        log = rec.log(b, "excitation")
        elapsed = log.time - log.time[0]
        np.testing.assert_allclose(log.command[:-1], wave(elapsed[:-1]), atol=1e-12)
        assert log.extra["controller"] == "playback"


def test_move_arrives_slowly():
    away = ARM.rest + np.radians(30.0)
    robot = LaggingRobot(0.02, 0.04, start=away)
    rec = move(robot, ARM.rest)
    np.testing.assert_allclose(robot.position, np.tile(ARM.rest, (2, 1)), atol=1e-3)
    steps = np.diff(rec.command, axis=0) / np.array([0.02, 0.04])[:, None]
    assert np.abs(steps).max() < 0.5 + 1e-9
    assert (rec.reasons == 0).all()


def test_the_command_in_force_before_the_run_carries_over():
    held = np.tile(ARM.rest + 0.05, (2, 1))

    class Nothing(Straight):
        def command(self, inputs):
            return inputs.sent

    rec = run(LaggingRobot(0.02, 0.03), Nothing(), TARGETS[:2], Schedule(dwell=0.1, sent=held))
    assert (rec.command == held).all()
    robot = LaggingRobot(0.02, 0.03)
    assert (move(robot, held[0] + 0.2, sent=held).command[0] == held).all()


def test_log_drops_repeated_answers():
    robot = LaggingRobot(0.02)
    step, calls = robot.step, []

    def stutter(command, active):
        calls.append(0)
        return robot.read() if len(calls) % 3 == 0 else step(command, active)

    robot.step = stutter
    log = run(robot, Straight(), TARGETS[:1], Schedule(dwell=0.2)).log(0, "stutter")
    assert (np.diff(log.time) > 0).all()
    assert len(log) == robot.steps[0] + 1


class PausingRobot(LaggingRobot):
    """Answers stay away for ``pause`` [s] at step ``at``; meanwhile the arm goes to its command, or ``elsewhere``."""

    def __init__(self, *, at, pause, elsewhere=None):
        super().__init__(0.05)
        self.at, self.pause, self.elsewhere = at, pause, elsewhere

    def step(self, command, active):
        state = super().step(command, active)
        if self.steps[0] != self.at:
            return state
        self.time = self.time + self.pause
        self.position[:] = command if self.elsewhere is None else self.elsewhere
        return self.read()


NOWHERE = np.full((1, 1, 3), np.nan)


class Eager:
    """Wants to be far away at once."""

    name = "eager"

    def __init__(self):
        self.resets = []

    def reset(self, inputs, where):
        assert where.all()
        self.resets.append(float(inputs.state.time[0]))

    def command(self, inputs):
        return inputs.sent + 1.0


def test_after_a_gap_an_arm_goes_on_from_where_it_is_as_from_a_start():
    robot, eager = PausingRobot(at=5, pause=3.0), Eager()
    rec = run(robot, eager, NOWHERE, Schedule(dwell=6.0))
    gaps = np.flatnonzero(rec.reasons[:, 0] & np.uint16(Reason.GAP.value))
    assert gaps.tolist() == [5]
    assert eager.resets == [0.0, rec.time[5, 0]]
    steps = np.abs(np.diff(rec.command[:, 0], axis=0)).max(axis=1)
    first = np.abs(rec.command[0, 0] - ARM.rest).max()
    assert 0.0 < steps[4] <= 0.2 * first + 1e-9, "the first step after a gap is smaller than that of a start"
    eased = rec.time[1:, 0] < rec.time[5, 0] + 1.0
    assert steps[4:][eased[4:]].max() <= 0.2 * 0.05 * ARM.max_speed.max() + 1e-9
    assert steps[np.argmin(eased[4:]) + 5] > 0.2 * 0.05 * ARM.max_speed.max()


@pytest.mark.parametrize(("way", "most"), [(0.6, 0.2), (np.radians([12.0, -12.0] * 3), np.radians(2.0))])
def test_an_arm_that_was_moved_during_a_gap_is_not_sent_back_at_once(way, most):
    """Not by less than a command may lead either: switched off and on, it stands where it sank to."""
    rec = run(PausingRobot(at=5, pause=3.0, elsewhere=ARM.rest + way), Straight(), NOWHERE, Schedule(dwell=6.0))
    assert np.abs(rec.command[5:, 0] - ARM.rest - way).max() < most


class MovedRobot(LaggingRobot):
    """An arm that stands elsewhere than its last command left it, and says so until it gets another one."""

    def read(self):
        return replace(super().read(), elsewhere=np.array([not self.steps[0]]))


@pytest.mark.parametrize("far", [0.2, 0.6])
def test_an_arm_that_was_moved_before_a_motion_goes_on_slowly_from_where_it_is(far):
    motions = {
        "run": lambda robot: run(robot, Back(), NOWHERE, Schedule(dwell=4.0, sent=ARM.rest[None])),
        "move": lambda robot: move(robot, ARM.rest, sent=ARM.rest[None], settle=3.0),
    }
    for motion in motions.values():
        rec = motion(MovedRobot(0.05, start=ARM.rest + far))
        assert np.abs(rec.command[0, 0] - ARM.rest - far).max() < np.radians(1.0)
        speed = np.abs(np.diff(rec.command[:, 0], axis=0)).max() / 0.05
        assert speed <= 0.2 * ARM.max_speed.max() + 1e-9
        assert rec.command[-1, 0] == pytest.approx(ARM.rest), "and it still arrives"


class Back(Eager):
    """Wants to be at rest at once."""

    def command(self, inputs):
        return np.tile(ARM.rest, (len(inputs.sent), 1))


def test_a_cycle_that_is_merely_late_allows_no_longer_step_than_usual():
    rec = run(PausingRobot(at=5, pause=0.3), Eager(), NOWHERE, Schedule(dwell=1.0))
    assert not (rec.reasons & np.uint16(Reason.GAP.value)).any()
    steps = np.abs(np.diff(rec.command[:, 0], axis=0)).max(axis=1)
    assert steps.max() <= 0.05 * ARM.max_speed.max() + 1e-9


def test_a_slow_motion_that_was_interrupted_by_a_gap_goes_on_as_slowly():
    way = np.array([1.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    robot = PausingRobot(at=10, pause=4.0)
    rec = move(robot, ARM.rest + way, speed=0.5)
    assert np.count_nonzero(rec.gaps()) == 1
    speed = np.abs(np.diff(rec.command[:, 0, 0])) / 0.05
    assert speed.max() < 1.3 * 0.5, "what the clock says is caught up with at full speed"
    assert rec.command[-1, 0] == pytest.approx(ARM.rest + way), "and it still arrives"
    assert rec.since_target[-1, 0] == pytest.approx(4.0, abs=0.1)
    ((at, waited),) = rec.waits()
    assert at == pytest.approx(0.5, abs=0.06)
    assert waited == pytest.approx(4.0, abs=0.06)


def test_a_target_does_not_lose_its_time_to_a_gap():
    rec = run(PausingRobot(at=5, pause=3.0), Straight(), np.tile(TARGETS[:1, :1], (1, 2, 1)), Schedule(dwell=1.0))
    for k in range(2):
        assert np.count_nonzero(rec.target_index == k) == pytest.approx(21, abs=1)
