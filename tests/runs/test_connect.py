"""An arm of a run that is sent to points from Python."""

import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import rejoint
from rejoint.arms import mycobot280, tcp_position
from rejoint.robots.lab.plant.wear import load_wear
from rejoint.runs.run import Run
from rejoint.runs.stages.known import twin_in_force
from rejoint.twin.parameters import nominal_parameters, prior
from rejoint.twin.twin import HeldOut, PredictionError, Twin

ARM = mycobot280()
TIME = np.linspace(0.0, 4.0, 100)
WAVE = np.array([0.17, 0.0, 0.2]) + 0.02 * np.sin(np.pi * TIME / 4.0)[:, None] * np.array([0.0, 1.0, 1.0])


def a_twin() -> Twin:
    """What an identification would find, with its errors."""
    wear, belief = load_wear("worn", ARM), prior(ARM)
    error = PredictionError(joints=np.full(6, 0.01), joint=0.01, tcp=1e-3)
    known = replace(
        nominal_parameters(ARM), stiffness=wear.position_gain, damping=wear.damping_gain + wear.torque_limit / 5.0,
        coulomb=1.1 * wear.coulomb, armature=0.9 * wear.reflected_inertia, torque_limit=wear.torque_limit,
        offset=np.zeros(6), delay=np.array(0.022),
    )  # fmt: skip
    return Twin(
        arm=ARM.name, joint_names=ARM.joint_names, parameters=known, covariance=np.diag((0.1 * belief.sigma) ** 2),
        lower=belief.lower, upper=belief.upper, narrowing=np.full(len(belief.mean), 0.1),
        identified=np.ones(len(belief.mean), dtype=bool),
        held_out=HeldOut(seconds=30.0, no_twin=error, healthy_twin=error, twin=error), fit_seconds=1.0, notes=(),
    )  # fmt: skip


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return Run.create(tmp_path / "run", "emulated:worn", ARM, 0).path


def test_an_arm_goes_to_points_and_leaves_one_log(run: Path) -> None:
    with rejoint.connect("emulated:worn", run=run) as arm:
        assert arm.controller == "feedforward", "nothing better is there yet"
        before = arm.state
        assert before.target_m is None
        assert not before.moving
        end = arm.move_to([0.18, 0.03, 0.21], within_m=0.003)
        assert end is not None
        assert end.error_m is not None
        assert end.error_m < 0.004
        np.testing.assert_allclose(end.tool_m, tcp_position(ARM, end.joints_rad))
        assert arm.move_to([0.17, 0.0, 0.2], within_m=0.003, wait=False) is None
        with pytest.raises(rejoint.NotReadyError, match="still on its way"):
            arm.move_to([0.18, 0.03, 0.21])
        assert arm.wait().error_m < 0.004
        arm.move_to([0.18, 0.03, 0.21], wait=False)
        arm.stop()
        assert not arm.state.moving
    (name, log), = Run.open(run).logs.items()  # fmt: skip
    assert name.startswith("move-")
    assert {tuple(np.round(place, 3)) for place in log.target} == {(0.18, 0.03, 0.21), (0.17, 0.0, 0.2)}
    assert (np.diff(log.time) > 0.0).all()


def test_what_cannot_be_reached_is_an_error_with_a_name_and_the_arm_goes_on(run: Path) -> None:
    with rejoint.connect("emulated:worn", run=run, controller="default") as arm:
        with pytest.raises(rejoint.NotReachedError, match=r"did not come within 0\.1 mm .* still .* mm off; it holds"):
            arm.move_to([0.18, 0.03, 0.21], within_m=1e-4, timeout_s=1.0)
        with pytest.raises(rejoint.InputError, match="out of reach"):
            arm.move_to([0.5, 0.0, 0.2])
        with pytest.raises(rejoint.InputError, match="expected a point"):
            arm.move_to([0.2, 0.0])
        with pytest.raises(rejoint.InputError, match="positive"):
            arm.move_to([0.18, 0.03, 0.21], timeout_s=0.0)
        with pytest.raises(rejoint.InputError, match=r"within a positive distance in metres, at most 0\.1, .* got 2"):
            arm.move_to([0.18, 0.03, 0.21], within_m=2)
        for wrong in ("home", None, [[0.18, 0.03, 0.21]], [0.18, "y", 0.2]):
            with pytest.raises(rejoint.InputError, match="expected a point"):
                arm.move_to(wrong)
        for wrong in (None, "10 s", np.inf):
            with pytest.raises(rejoint.InputError, match="positive"):
                arm.move_to([0.18, 0.03, 0.21], timeout_s=wrong)
        with pytest.raises(
            rejoint.InputError, match=r"expected a Path, a file, or points .* found a generator; .* a rejoint\.Stream"
        ):
            arm.follow([0.1 * k, 0.18, 0.0, 0.2] for k in range(9))
        assert arm.move_to([0.18, 0.03, 0.21], within_m=0.05) is not None
    assert issubclass(rejoint.NotReachedError, TimeoutError)


def test_what_ended_a_motion_that_nobody_waited_for_is_told(run: Path) -> None:
    def fail(arm: rejoint.DrivenArm) -> None:
        arm.move_to([0.18, 0.03, 0.21], within_m=1e-5, timeout_s=0.2, wait=False)
        while arm.state.moving:
            time.sleep(0.01)

    arm = rejoint.connect("emulated:worn", run=run)
    fail(arm)
    with pytest.raises(rejoint.NotReachedError, match=r"within 0\.01 mm of \(180, 30, 210\)"):
        arm.move_to([0.17, 0.0, 0.2])
    arm.move_to([0.17, 0.0, 0.2], within_m=0.01)
    fail(arm)
    arm.stop()
    arm.move_to([0.17, 0.0, 0.2], within_m=0.01)
    fail(arm)
    with pytest.raises(rejoint.NotReachedError):
        arm.close()
    arm.close()


def test_the_error_of_a_block_goes_before_that_of_its_last_motion(run: Path) -> None:
    arm = rejoint.connect("emulated:worn", run=run)
    arm.move_to([0.18, 0.03, 0.21], within_m=1e-5, timeout_s=0.2, wait=False)
    while arm.state.moving:
        time.sleep(0.01)
    with pytest.raises(ZeroDivisionError), arm:
        raise ZeroDivisionError


def test_while_an_arm_moves_its_motion_alone_asks_the_robot(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with rejoint.connect("emulated:worn", run=run) as arm:
        robot, asked = arm._drive.robot, list[str]()
        monkeypatch.setattr(
            robot, "read", lambda read=robot.read: asked.append(threading.current_thread().name) or read()
        )
        arm.move_to([0.18, 0.03, 0.21], within_m=0.01, wait=False)
        while arm.state.moving:
            assert "MainThread" not in asked
        assert "MainThread" in asked, "the state at the end is read"


def test_what_is_done_with_a_state_changes_no_log(run: Path) -> None:
    with rejoint.connect("emulated:worn", run=run) as arm:
        arm.move_to([0.17, 0.0, 0.2], within_m=0.01).target_m[:] = 5.0
        np.testing.assert_array_equal(arm.state.target_m, [0.17, 0.0, 0.2])


def test_an_arm_that_is_closed_takes_no_orders(run: Path) -> None:
    with rejoint.connect("emulated:worn", run=run) as arm:
        before = arm.state.joints_rad
    for order in (
        lambda: arm.move_to([0.18, 0.03, 0.21]),
        lambda: arm.follow("circle-8s"),
        lambda: arm.state,
        arm.wait,
    ):
        with pytest.raises(rejoint.NotReadyError, match="the arm is closed"):
            order()
    arm.stop()
    arm.close()
    with rejoint.connect("emulated:worn", run=run) as again:
        np.testing.assert_allclose(again.state.joints_rad, before)


def test_of_two_threads_one_drives_the_arm(run: Path) -> None:
    both, refused = threading.Barrier(2), list[Exception]()

    def go(place: list[float]) -> None:
        both.wait()
        try:
            arm.move_to(place, within_m=0.05)
        except rejoint.NotReadyError as error:
            refused.append(error)

    with rejoint.connect("emulated:worn", run=run, controller="default") as arm:
        slow = arm._require_free
        arm._require_free = lambda: (slow(), time.sleep(0.05))  # both threads look before either starts
        threads = [threading.Thread(target=go, args=([0.18, y, 0.2],)) for y in (0.03, -0.03)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert len(refused) == 1
    assert "still on its way" in str(refused[0])


def test_the_state_of_a_motion_never_tells_the_target_of_the_one_before(run: Path) -> None:
    """Whoever waited for a small error was told that the arm is there before it had moved."""
    with rejoint.connect("emulated:worn", run=run) as arm:
        before = arm.move_to([0.18, 0.03, 0.21], within_m=0.003).time_s
        held, drive = threading.Event(), arm._drive.to_target
        arm._drive.to_target = lambda *given: (held.wait(10.0), drive(*given))  # its first cycle takes a while
        arm.move_to([0.17, 0.0, 0.2], within_m=0.003, wait=False)
        state = arm.state
        assert state.moving
        assert (state.target_m, state.error_m) == (None, None)
        assert state.time_s >= before
        held.set()
        np.testing.assert_array_equal(arm.wait().target_m, [0.17, 0.0, 0.2])


def test_what_looks_at_the_arm_and_what_orders_ask_one_after_the_other(run: Path) -> None:
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

    with rejoint.connect("emulated:worn", run=run, controller="default") as arm:
        for name in ("read", "step", "stop"):
            alone(arm._drive.robot, name)
        looks = threading.Thread(target=look)
        looks.start()
        for number in range(10):
            arm.move_to([0.18, 0.01 * (number % 2), 0.2], within_m=0.05, wait=bool(number % 3))
            arm.stop()
        over.set()
        looks.join()
    assert not mixed


def test_arguments_that_do_not_go_together_are_refused(run: Path) -> None:
    with pytest.raises(rejoint.InputError, match="need a run"):
        rejoint.connect("emulated:worn", controller="default")
    with pytest.raises(rejoint.InputError, match="leave arm and count out"):
        rejoint.connect("emulated:worn", run=run, count=2)
    with rejoint.connect("emulated:worn", run=run), pytest.raises(rejoint.FileError, match="this program is working"):
        rejoint.connect("emulated:worn", run=run)


def test_an_arm_follows_paths_and_streams_between_points_and_leaves_one_log(run: Path) -> None:
    a_twin().save(run / "twin.toml")
    path = rejoint.Path(time=TIME, place=WAVE, name="wave")
    with rejoint.connect("emulated:worn", run=run) as arm:
        arm.move_to(WAVE[0], within_m=0.004)
        done = arm.follow(path)
        assert done is arm.followed
        assert done.passes[-1].encoder.rms < 2e-3, "an arm that is sent this path is 20 mm off"
        stream = rejoint.Stream()
        for moment, place in zip(TIME[:50], WAVE[:50], strict=True):
            stream.put(place, time=moment)
        assert arm.follow(stream, duration_s=3.0, wait=False) is None
        assert arm.followed is None, "the last path is another one"
        with pytest.raises(rejoint.NotReadyError, match="still on its way"):
            arm.follow(path)
        end = arm.wait()
        assert np.linalg.norm(end.tool_m - WAVE[49]) < 4e-3
        assert arm.followed is not None
        with pytest.raises(rejoint.InputError, match="this stream was followed already"):
            arm.follow(stream, duration_s=3.0)
    (name, log), = Run.open(run).logs.items()  # fmt: skip
    assert name.startswith("move-")
    assert (np.diff(log.time) > 0.0).all()
    assert np.nanmin(np.abs(log.target - WAVE[49]).max(axis=-1)) < 1e-3
    assert log.extra["controller"] == "feedforward, tracker"


def test_a_path_is_stopped_on_its_way_and_what_cannot_be_followed_is_refused(run: Path) -> None:
    with rejoint.connect("emulated:worn", run=run) as arm, pytest.raises(rejoint.InputError, match="needs a twin"):
        arm.follow("circle-8s")
    a_twin().save(run / "twin.toml")
    with rejoint.connect("emulated:worn", run=run) as arm:
        with pytest.raises(rejoint.InputError, match="out of reach"):
            arm.follow(rejoint.Path(time=TIME, place=WAVE + 0.4))
        with pytest.raises(rejoint.InputError, match="needs a duration"):
            arm.follow(rejoint.Stream())
        with pytest.raises(rejoint.InputError, match="repeated"):
            arm.follow("circle-8s", repeat=2, rate_hz=30.0)
        arm.follow("circle-20s", repeat=10, wait=False)
        arm.stop()
        assert not arm.state.moving
        assert arm.followed is None
        end = arm.move_to(WAVE[0], within_m=0.004)
        assert end is not None
        assert end.time_s < 200.0, "ten times along a circle take longer"


def test_a_twin_is_as_stiff_as_the_servos_are_now(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    a_twin().save(run / "twin.toml")
    monkeypatch.setattr(Run, "diagnosis", SimpleNamespace(servo_gains={"p": (16,) * 6}))
    for gains, factor in ((None, 1.0), ({"p": (32,) * 6}, 2.0)):
        found = twin_in_force(Run.open(run), SimpleNamespace(servo_gains=lambda gains=gains: gains))
        assert found is not None
        np.testing.assert_allclose(found.parameters.stiffness, factor * a_twin().parameters.stiffness, rtol=1e-6)


def test_an_arm_goes_to_poses_and_follows_a_path_that_turns_the_tool(run: Path) -> None:
    a_twin().save(run / "twin.toml")
    down = np.broadcast_to([0.0, 0.1, -1.0], (len(TIME), 3))
    with rejoint.connect("emulated:worn?seed=10001", run=run, controller="shelf") as arm:
        end = arm.move_to(rejoint.Pose(place_m=WAVE[0], direction=down[0]), within_m=0.004, within_rad=np.radians(2.0))
        assert end is not None
        assert end.turned_rad is not None
        assert end.turned_rad < np.radians(2.0)
        done = arm.follow(rejoint.Path(time=TIME, place=WAVE, direction=down))
        assert done.passes[-1].turned is not None
        assert done.passes[-1].turned < np.radians(3.0)
        point = arm.move_to(WAVE[0], within_m=0.004)
        assert point is not None
        assert point.turned_rad is None, "a point says nothing of orientation"
        with pytest.raises(rejoint.InputError, match="the tool cannot have direction"):
            arm.move_to(rejoint.Pose(place_m=[0.229, 0.099, 0.249], direction=[-1.0, -1.0, 0.3]))
        stream = rejoint.Stream()
        for moment, place in zip(TIME[:50], WAVE[:50], strict=True):
            stream.put(rejoint.Pose(place_m=place, direction=down[0]), time=moment)
        behind = arm.follow(stream, duration_s=3.0)
        told = arm.follow(rejoint.Path(time=TIME[:50], place=WAVE[:50], direction=down[:50]), rate_hz=30.0)
        for one in (behind, told):
            assert one.passes[-1].encoder.rms_after < 5e-3, "it sets off at full speed"
            assert one.passes[-1].turned is not None, "places say nothing of orientation"
            assert one.passes[-1].turned < np.radians(3.0)
        with pytest.raises(rejoint.NotReachedError, match=r"mm and 0\.01 deg of .* mm and .* deg off"):
            arm.move_to(rejoint.Pose(place_m=WAVE[60], direction=down[0]), within_rad=np.radians(0.01), timeout_s=0.5)
