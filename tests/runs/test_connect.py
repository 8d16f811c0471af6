"""An arm of a run that is sent to points from Python."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rejoint
from hearing import Hears
from madetwin import made_calibration, made_twin
from rejoint.arms import Box, Displacement, clearances, mycobot280, plan, tcp_position
from rejoint.control.controllers.posture import PlannedWay, Unloading
from rejoint.control.correction import Modelled
from rejoint.control.loop import BRAKE
from rejoint.control.reference import Reference
from rejoint.control.robot import ControlInput
from rejoint.runs.run import Run
from rejoint.session.driver import GoalStream
from rejoint.twin.parameters import nominal_parameters
from rejoint.twin.twin import Twin
from rejoint_lab.plant.wear import load_wear
from standin import now_at

ARM = mycobot280()
HERE, THERE = [0.18, 0.03, 0.21], [0.17, 0.0, 0.2]
WALL = Box(lower=np.array([0.15, -0.15, 0.0]), upper=np.array([0.3, -0.08, 0.3]))
TIME = np.linspace(0.0, 4.0, 100)
WAVE = np.array(THERE) + 0.02 * np.sin(np.pi * TIME / 4.0)[:, None] * np.array([0.0, 1.0, 1.0])


def a_twin() -> Twin:
    """What an identification would find, with its errors."""
    wear = load_wear("worn", ARM)
    known = replace(
        nominal_parameters(ARM),
        stiffness=wear.position_gain,
        damping=wear.damping_gain + wear.torque_limit / 5.0,
        coulomb=1.1 * wear.coulomb,
        armature=0.9 * wear.reflected_inertia,
        torque_limit=wear.torque_limit,
        offset=np.zeros(6),
        delay=np.array(0.022),
    )
    return made_twin(ARM, known)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return Run.create(tmp_path, "emulated:worn", ARM).path


def connected(run: Path | None = None, **settings: object) -> rejoint.Session:
    return rejoint.connect("emulated:worn", run=run, settings=rejoint.Settings(**settings))


@contextmanager
def held(arm: rejoint.Session) -> Iterator[None]:
    """Let no cycle of a motion end before the block does, however slow the machine is."""
    robot, over = arm.robot, threading.Event()
    step = robot.step
    robot.step = lambda *given: over.wait() and step(*given)
    try:
        yield
    finally:
        over.set()
        robot.step = step


def test_an_arm_goes_to_points_and_leaves_one_log(run):
    with connected(run) as arm:
        assert arm.controller == "shelf", "nothing better is there yet"
        before = arm.state
        assert before.target_m is None
        assert not before.moving
        end = arm.move_to(HERE, within_m=0.003)
        assert end.error_m < 0.004
        np.testing.assert_allclose(end.tool_m, tcp_position(ARM, end.joints_rad))
        with held(arm):
            assert arm.move_to(THERE, within_m=0.003, wait=False) is None
            with pytest.raises(rejoint.NotReadyError, match="still on its way"):
                arm.move_to(HERE)
        assert arm.wait().error_m < 0.004
        arm.move_to(HERE, wait=False)
        arm.stop()
        assert not arm.state.moving
    ((name, log),) = Run.open(run).logs.items()
    assert name.startswith("move-")
    assert {tuple(np.round(place, 3)) for place in log.target} == {(0.18, 0.03, 0.21), (0.17, 0.0, 0.2)}
    assert (np.diff(log.time) > 0.0).all()


def test_the_tool_is_where_the_calibration_puts_it():
    displacement = replace(Displacement.none(ARM), offset=np.radians([0.0, 2.0, 0.0, 0.0, 0.0, 0.0]))
    settings = rejoint.Settings(calibration=made_calibration(ARM, displacement))
    with rejoint.connect("emulated:healthy", settings=settings) as arm:
        there = arm.move_to(HERE, within_m=0.002)
        np.testing.assert_allclose(there.tool_m, displacement.tool(ARM, there.joints_rad), atol=1e-9)
        np.testing.assert_allclose(there.tool_m, HERE, atol=3e-3)
        seen = tcp_position(ARM, there.joints_rad)
        assert np.linalg.norm(there.tool_m - seen) > 5e-3
        arm.move_to(THERE, within_m=0.003)
        back = arm.move_to(there.tool_m, within_m=0.002)
        np.testing.assert_allclose(tcp_position(ARM, back.joints_rad), seen, atol=4e-3)


def test_an_arm_that_keeps_close_to_its_way_has_not_reached_its_target_yet():
    with rejoint.connect("emulated:healthy") as arm:
        end = arm.move_to([0.0, -0.2, 0.15], within_m=0.03)
    assert end.error_m < 0.03


def test_what_cannot_be_reached_is_an_error_with_a_name_and_the_arm_goes_on(run):
    with connected(run, controller="default") as arm:
        with pytest.raises(rejoint.NotReachedError, match=r"did not come within 0\.1 mm .* still .* mm off; it holds"):
            arm.move_to(HERE, within_m=1e-4, timeout_s=1.0)
        with pytest.raises(rejoint.InputError, match="out of reach"):
            arm.move_to([0.5, 0.0, 0.2])
        with pytest.raises(rejoint.InputError, match="positive"):
            arm.move_to(HERE, within_m=2)
        for wrong in ([0.2, 0.0], "home", None, [HERE], [0.18, "y", 0.2]):
            with pytest.raises(rejoint.InputError, match="expected a point"):
                arm.move_to(wrong)
        for wrong in (0.0, None, "10 s", np.inf):
            with pytest.raises(rejoint.InputError, match="positive"):
                arm.move_to(HERE, timeout_s=wrong)
        with pytest.raises(rejoint.InputError, match="expected a Path, a file, or points"):
            arm.follow([0.1 * k, 0.18, 0.0, 0.2] for k in range(9))
        assert arm.move_to(HERE, within_m=0.05) is not None
    assert issubclass(rejoint.NotReachedError, TimeoutError)


def test_an_arm_that_is_kept_from_its_goal_rests_there():
    kept = pytest.raises(rejoint.NotReachedError)
    with rejoint.connect("emulated:worn?payload=0.25") as arm, arm.recording("kept") as taken, kept:
        arm.move_to([0.26, 0.0, 0.1], timeout_s=6.0)
    lead = np.abs(taken.log.command - taken.log.position).max(axis=1)
    assert lead[-1] < 1.01 * BRAKE < 0.4 * lead.max()


def test_what_ended_a_motion_that_nobody_waited_for_is_told(run):
    def fail(arm: rejoint.Session) -> None:
        arm.move_to(HERE, within_m=1e-5, timeout_s=0.2, wait=False)
        while arm.state.moving:
            time.sleep(0.01)

    arm = connected(run)
    fail(arm)
    with pytest.raises(rejoint.NotReachedError, match=r"within 0\.01 mm of \(180, 30, 210\)"):
        arm.move_to(THERE)
    arm.move_to(THERE, within_m=0.01)
    fail(arm)
    arm.stop()
    arm.move_to(THERE, within_m=0.01)
    fail(arm)
    with pytest.raises(rejoint.NotReachedError):
        arm.close()
    arm.close()


def test_while_an_arm_moves_its_motion_alone_asks_the_robot(run, monkeypatch):
    with connected(run) as arm:
        robot, asked = arm.robot, list[str]()
        monkeypatch.setattr(
            robot, "read", lambda read=robot.read: asked.append(threading.current_thread().name) or read()
        )
        arm.move_to(HERE, within_m=0.01, wait=False)
        while arm.state.moving:
            assert "MainThread" not in asked
        assert "MainThread" in asked, "the state at the end is read"


def test_an_arm_that_is_closed_takes_no_orders(run):
    with connected(run) as arm:
        before = arm.state.joints_rad
    for order in (
        lambda: arm.move_to(HERE),
        lambda: arm.follow("circle-8s"),
        lambda: arm.state,
        arm.wait,
    ):
        with pytest.raises(rejoint.NotReadyError, match="the arm is closed"):
            order()
    arm.stop()
    arm.close()
    with connected(run) as again:
        np.testing.assert_allclose(again.state.joints_rad, before)


def test_an_observer_may_end_the_motion_that_it_sees():
    with rejoint.connect("emulated:worn", observer=Hears(cycle=lambda _: arm.stop())) as arm:
        arm.move_to(WAVE[0])
        assert arm.state.time_s < 5.0


def test_of_two_threads_one_drives_the_arm(run, monkeypatch):
    refused, other = list[Exception](), threading.Event()

    def go(place: list[float]) -> None:
        try:
            arm.move_to(place, within_m=0.05)
        except rejoint.NotReadyError as error:
            refused.append(error)
            other.set()  # the one that moves waits for it

    with connected(run, controller="default") as arm:
        step = arm.robot.step
        monkeypatch.setattr(arm.robot, "step", lambda *given: other.wait() and step(*given))
        threads = [threading.Thread(target=go, args=([0.18, y, 0.2],)) for y in (0.03, -0.03)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert len(refused) == 1
    assert "still on its way" in str(refused[0])


def test_what_looks_at_the_arm_and_what_orders_ask_one_after_the_other(run):
    """Questions of two threads on one wire had their answers mixed up, and the connection was made anew."""
    over, asking, mixed = threading.Event(), list[tuple[int, str]](), list[str]()

    def alone(robot: rejoint.Robot, name: str) -> None:
        ask = getattr(robot, name)

        def question(*given: object) -> object:
            me = threading.get_ident()
            mixed.extend(f"{name} during {other}" for thread, other in tuple(asking) if thread != me)
            asking.append((me, name))
            time.sleep(0.001)
            try:
                return ask(*given)
            finally:
                asking.remove((me, name))

        setattr(robot, name, question)

    def look() -> None:
        while not over.is_set():
            arm.state  # noqa: B018

    with connected(run, controller="default") as arm:
        for name in ("read", "step", "stop"):
            alone(arm.robot, name)
        looks = threading.Thread(target=look)
        looks.start()
        for number in range(10):
            arm.move_to([0.18, 0.01 * (number % 2), 0.2], within_m=0.05, wait=bool(number % 3))
            arm.stop()
        over.set()
        looks.join()
    assert not mixed


def test_joint_positions_are_reached_round_a_declared_box():
    goal = ARM.rest + np.radians([-100.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    places, watches = [], Hears(cycle=lambda cycle: places.append(cycle.position[0]))
    with rejoint.connect("emulated:worn?seed=1", settings=rejoint.Settings(keep_out=[WALL]), observer=watches) as arm:
        end = arm.move_joints(goal)
    np.testing.assert_allclose(end.joints_rad, goal, atol=np.radians(0.5))
    assert (clearances(replace(ARM, keep_out=(WALL,)), np.array(places)) > 0.0).all()


def test_a_joint_that_sticks_under_its_load_comes_to_its_goal_over_another_posture():
    with connected() as arm:
        for degrees in ([85, -13, -33, 111, -52, 17], [25, -42, -23, -131, -27, 117]):
            end = arm.move_joints(np.radians(degrees), within_rad=np.radians(3.0), timeout_s=60.0)
    np.testing.assert_allclose(np.degrees(end.joints_rad), degrees, atol=3.0)


def test_an_arm_that_has_come_to_rest_does_not_swing_when_it_is_pushed_away():
    class Stays(Reference):
        def advance(self, now: ControlInput) -> ControlInput:
            return replace(now, goal=ARM.rest[None])

    way = Unloading(ARM, way=Stays())
    for now in np.arange(0.0, 6.0, 0.05):
        wanted = way.advance(now_at(ARM.rest + (0.2 if now > 2.0 else 0.0), now))
        np.testing.assert_array_equal(wanted.goal[0], ARM.rest)


def test_a_stream_of_a_hand_that_rests_and_jitters_comes_to_rest():
    stream, rng, at = GoalStream(Modelled(ARM, Displacement.none(ARM)), ARM.rest), np.random.default_rng(0), ARM.rest
    for now in np.arange(0.0, 3.0, 0.02):
        stream.goal = ARM.rest + np.radians(10.0 + rng.uniform(-0.1, 0.1, 6))
        wanted = stream.advance(now_at(at, now))
        at = wanted.goal[0]
    assert wanted.arrived.all()
    np.testing.assert_allclose(np.degrees(at - ARM.rest), 10.0, atol=0.1)


def test_a_way_waits_for_a_joint_that_lags_and_not_for_ever():
    line = plan(ARM, ARM.rest, ARM.rest + 0.5)
    stuck, follows = PlannedWay(ARM, line), PlannedWay(ARM, line)
    at = ARM.rest
    for now in np.arange(0.0, 2.0 * line.duration, 0.02):
        there = follows.advance(now_at(at, now))
        at = there.goal[0]
        waits = stuck.advance(now_at(ARM.rest, now))
    assert there.arrived.all()
    assert not waits.arrived.any()
    assert np.radians(12.0) < np.abs(waits.goal[0] - ARM.rest).max() < 0.5
    for now in np.arange(2.0, 30.0, 0.02) * line.duration:
        waits = stuck.advance(now_at(ARM.rest, now))
    assert waits.arrived.all()


def test_an_arm_without_a_run_is_guarded_and_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with connected() as arm:
        end = arm.move_to(HERE)
        assert end.error_m < 0.0025
    assert not list(tmp_path.iterdir())


def test_joints_go_where_they_are_sent_and_what_no_joint_can_do_is_refused(run):
    a_twin().save(run / "twin.toml")
    goal = ARM.rest + np.radians([20.0, 5.0, -8.0, 0.0, 10.0, -15.0])  # joint4 of this arm is too weak for small steps
    with connected(run) as arm:
        start = arm.state.joints_rad
        end = arm.move_joints(goal, within_rad=np.radians(0.6))
        assert np.abs(end.joints_rad - goal).max() < np.radians(0.7)
        outside, touching = np.where(np.arange(6) == 1, ARM.upper[1] + 0.1, goal), np.radians([0, 130, 0, 0, 0, 0])
        for wrong in (goal[:3], np.full(6, np.nan), np.full(6, 90.0), outside, touching):
            with pytest.raises(rejoint.InputError):
                arm.move_joints(wrong)
        with pytest.raises(rejoint.NotReachedError, match=r"did not come within 0.001 deg .* still .* deg at joint"):
            arm.move_joints(start, within_rad=np.radians(0.001), timeout_s=0.3)
    assert any(name.startswith("joints-") for name in Run.open(run).logs)


def test_a_stream_of_joint_positions_is_followed_until_it_stops_and_gives_way_to_a_motion(run):
    a_twin().save(run / "twin.toml")
    with connected(run) as arm:
        start = arm.state.joints_rad
        goal = start + np.radians([20.0, 5.0, -8.0, 0.0, 10.0, -15.0])
        np.testing.assert_array_equal(arm.send_joints(start + 0.5 * (goal - start)), start + 0.5 * (goal - start))
        np.testing.assert_array_equal(arm.send_joints(goal), goal)
        assert arm.state.moving
        assert np.abs(arm.wait().joints_rad - goal).max() < np.radians(1.5)
        assert not arm.state.moving, "it rests where the stream stopped"
        sent = arm.send_joints(np.radians([0.0, 130.0, 0.0, 0.0, 0.0, 0.0]))
        assert tcp_position(ARM, sent)[2] > -1e-3, "no farther than to the ground"
        with pytest.raises(rejoint.InputError, match="expected 6 joint positions"):
            arm.send_joints([0.0])
        arm.move_to(HERE, within_m=0.004)
        assert not arm.state.moving
    assert len(list((run / "logs").glob("joints*.parquet"))) == 1, "one log, with the command that brakes"


def test_boxes_are_kept_out_of_and_one_that_holds_the_arm_is_refused(run):
    wall = Box(lower=np.array([0.05, 0.12, 0.0]), upper=np.array([0.4, 0.4, 0.5]))
    with connected(run, keep_out=[wall]) as arm:
        with pytest.raises(rejoint.InputError, match="the nearest place that works"):
            arm.move_to([0.15, 0.16, 0.2])
        arm.move_to([0.17, -0.05, 0.2], within_m=0.004)
    inside = Box(lower=np.array([-0.1, -0.1, 0.05]), upper=np.array([0.1, 0.1, 0.3]))
    with pytest.raises(rejoint.InputError, match="a part of the arm in its rest posture is inside a box"):
        connected(run, keep_out=[inside])


def test_a_dry_run_moves_nothing_writes_nothing_and_says_how_far(run):
    said = list[str]()
    robot = rejoint.open_robot("emulated:worn")
    before, files = robot.read(), sorted(run.glob("[a-z]*"))
    settings = rejoint.Settings(dry_run=True)
    with rejoint.connect(robot, run=run, settings=settings, observer=Hears(message=said.append)) as arm:
        arm.move_to(HERE, within_m=0.004)
    after = robot.read()
    np.testing.assert_array_equal(after.time, before.time)
    np.testing.assert_array_equal(after.position, before.position)
    assert sorted(run.glob("[a-z]*")) == files
    assert "Dry run, nothing moved" in said[-1]


def test_an_arm_follows_paths_and_streams_between_points_and_leaves_one_log(run):
    a_twin().save(run / "twin.toml")
    path = rejoint.Path(time=TIME, place=WAVE, name="wave")
    with connected(run) as arm:
        arm.move_to(WAVE[0], within_m=0.004)
        done = arm.follow(path)
        assert done is arm.followed
        assert done.passes[-1].encoder.rms < 2e-3, "an arm that is sent this path is 20 mm off"
        stream = rejoint.Stream()
        for moment, place in zip(TIME[:50], WAVE[:50], strict=True):
            stream.put(place, time=moment)
        with held(arm):
            assert arm.follow(stream, duration_s=3.0, wait=False) is None
            assert arm.followed is None, "the last path is another one"
            with pytest.raises(rejoint.NotReadyError, match="still on its way"):
                arm.follow(path)
        end = arm.wait()
        assert np.linalg.norm(end.tool_m - WAVE[49]) < 4e-3
        assert arm.followed is not None
        with pytest.raises(rejoint.InputError, match="this stream was followed already"):
            arm.follow(stream, duration_s=3.0)
    logs = Run.open(run).logs
    assert sorted(name.split("-")[0] for name in logs) == ["follow", "follow", "move"]
    assert all((np.diff(log.time) > 0.0).all() for log in logs.values())
    assert any(np.nanmin(np.abs(log.target - WAVE[49]).max(axis=-1)) < 1e-3 for log in logs.values())
    assert {log.extra["controller"] for log in logs.values()} == {"shelf", "tracker"}


def test_a_path_is_stopped_on_its_way_and_what_cannot_be_followed_is_refused(run):
    with pytest.raises(rejoint.InputError, match="needs a twin"):
        rejoint.follow("emulated:worn", "circle-8s", run=run, settings=rejoint.Settings(controller="tracker"))
    a_twin().save(run / "twin.toml")
    with connected(run) as arm:
        with pytest.raises(rejoint.InputError, match="out of reach"):
            arm.follow(rejoint.Path(time=TIME, place=WAVE + 0.4))
        with pytest.raises(rejoint.InputError, match="duration in seconds"):
            arm.follow(rejoint.Stream())
        with pytest.raises(rejoint.InputError, match="whole number"):
            arm.follow("circle-8s", repeat=0)
        arm.follow("circle-20s", repeat=10, wait=False)
        arm.stop()
        assert not arm.state.moving
        assert arm.followed is None
        end = arm.move_to(WAVE[0], within_m=0.004)
        assert end.time_s < 200.0, "ten times along a circle take longer"


def test_a_robot_makes_one_motion_at_a_time():
    robot = rejoint.open_robot("emulated:healthy")
    with rejoint.connect(robot) as arm:
        arm.hold()
        with pytest.raises(rejoint.NotReadyError):
            rejoint.deploy(robot, [HERE])
