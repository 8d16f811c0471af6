"""The emulator as its judge sees it: the vendor's unmodified client, over TCP and a terminal, on the worn arm."""

import time

import numpy as np
import pytest

from emulatedservers import serve_pty, serve_tcp
from rejoint.arms import mycobot280, tcp_pose
from rejoint.robots.mycobot.bus import MyCobot280, MyCobot280Socket
from rejoint_lab.emulator.firmware import Firmware
from waiting import until

ARM = mycobot280()
QUICK = {"state": 0.002, "acknowledgement": 0.001, "pace": 4.0}
REST = [20.0, 0.0, -85.0, -5.0, 0.0, 0.0]
GOAL = [50.0, 10.0, -95.0, 0.0, 5.0, 10.0]
pytestmark = [pytest.mark.realtime, pytest.mark.filterwarnings("ignore:.*getdefaultlocale.*:DeprecationWarning")]


@pytest.fixture(scope="module", params=["tcp", "pty"])
def client(request):
    """One client per transport: its constructor sleeps for 1.5 s."""
    firmware = Firmware.build(ARM, "worn")
    with (serve_tcp if request.param == "tcp" else serve_pty)(firmware, timing=QUICK) as running:
        if request.param == "tcp":
            vendor = MyCobot280Socket("127.0.0.1", int(running.address.rsplit(":", 1)[1]))
        else:
            vendor = MyCobot280(running.address.removeprefix("serial://").partition("?")[0], 1_000_000)
        yield vendor
        vendor.close()


@pytest.fixture
def arm(client):
    """The client, the arm back in its rest posture with its default settings."""
    assert client.power_on() == 1
    assert client.clear_error_information() == 1
    assert client.set_joint_min(1, -168) == 1
    assert client.set_joint_max(1, 168) == 1
    assert client.set_fresh_mode(1) == 1
    assert client.send_angles(REST, 100) == 1
    settle(client)
    return client


def settle(client):
    until(lambda: client.is_moving() == 0)


def rings_no_more(client):
    """A worn arm rings after it has stopped."""
    before = client.get_angles()
    time.sleep(0.05)
    return np.abs(np.subtract(client.get_angles(), before)).max() < 0.1


def near(angles, wanted, margin=8.0):
    """A worn arm sags by degrees."""
    return np.abs(np.array(angles) - wanted).max() < margin


QUESTIONS = [
    ("get_modify_version", (), 1),
    ("get_system_version", (), 7.3),
    ("check_async_or_sync", (), 1),
    ("is_power_on", (), 1),
    ("is_controller_connected", (), 1),
    ("read_next_error", (), [0] * 7),
    ("get_fresh_mode", (), 1),
    ("is_paused", (), 0),
    ("get_joint_min_angle", (5,), -155.0),
    ("get_joint_max_angle", (5,), 160.0),
    ("is_servo_enable", (3,), 1),
    ("get_servo_voltages", (), [12.0] * 6),
    ("get_servo_status", (), [0] * 6),
    ("get_reboot_count", (), 1),
    ("get_encoder", (7,), -1),
    ("set_color", (1, 2, 3), 1),
]


@pytest.mark.parametrize(("method", "arguments", "expected"), QUESTIONS)
def test_questions(client, method, arguments, expected):
    client.power_on()
    client.set_fresh_mode(1)
    settle(client)
    assert getattr(client, method)(*arguments) == expected


def test_positions_agree_with_one_another(arm):
    until(lambda: rings_no_more(arm))
    angles, coords = arm.get_angles(), arm.get_coords()
    assert near(angles, REST)
    pose = tcp_pose(ARM, np.radians(angles))
    np.testing.assert_allclose(coords[:3], 1e3 * pose[:3, 3], atol=1.0)
    assert arm.get_angles_coords()[:6] == pytest.approx(angles, abs=0.1)
    assert arm.get_angles_coords()[6:9] == pytest.approx(coords[:3], abs=0.5)
    np.testing.assert_allclose(arm.angles_to_coords(angles)[:3], coords[:3], atol=0.5)
    np.testing.assert_allclose(arm.get_radians(), np.radians(angles), atol=2e-3)
    counts = np.array(arm.get_encoders())
    np.testing.assert_allclose((counts - 2048) * 360 / 4096, angles, atol=0.1)
    assert arm.get_encoder(3) == pytest.approx(counts[2], abs=1)
    np.testing.assert_allclose(arm.get_angles_plan(), REST, atol=0.02)
    upright = arm.angles_to_coords([0.0] * 6)
    assert upright[:3] == [45.6, -63.4, 412.6]


def test_measured_quantities_are_plausible(arm):
    assert all(20 <= value <= 60 for value in arm.get_servo_temps())
    currents = arm._mesg(0xE2, has_reply=True)  # the client has the id but no method
    assert len(currents) == 6
    assert 100 < currents[1] + currents[2] < 3250  # two joints carry the arm
    arm.send_angle(1, 60.0, 100)
    fastest = []
    until(lambda: fastest.append(arm.get_servo_speeds()[0]) or max(fastest) > 800)
    assert max(fastest) < 3000  # 120 deg/s = 1365 step/s, and some overshoot


@pytest.mark.parametrize(
    ("method", "goal"),
    [
        ("send_angles", GOAL),
        ("send_radians", [float(np.radians(v)) for v in GOAL]),
        ("set_encoders", [2048 + round(v / 360 * 4096) for v in GOAL]),
    ],
)
def test_joint_moves(arm, method, goal):
    assert getattr(arm, method)(goal, 100) == 1
    settle(arm)
    np.testing.assert_allclose(arm.get_angles_plan(), GOAL, atol=0.1)
    assert near(arm.get_angles(), GOAL)


@pytest.mark.parametrize(
    ("method", "arguments", "joint", "angle"),
    [
        ("send_angle", (5, 12.5, 100), 4, 12.5),
        ("set_encoder", (1, 2048 + 512, 100), 0, 45.0),
        ("jog_increment_angle", (1, -10.0, 100), 0, 10.0),
        ("jog_increment", (6, 30.0, 100), 5, 30.0),
    ],
)
def test_single_joint_moves(arm, method, arguments, joint, angle):
    assert getattr(arm, method)(*arguments) == 1
    settle(arm)
    assert arm.get_angles_plan()[joint] == pytest.approx(angle, abs=0.05)
    assert arm.get_angles()[joint] == pytest.approx(angle, abs=5.0)


@pytest.mark.parametrize("mode", [None, 0, 1])
def test_tool_moves(arm, mode):
    start = arm.get_coords_plan()
    wanted = [start[0] - 15, start[1] + 30, start[2] + 10, *start[3:]]
    assert arm.send_coords(wanted, 100, mode) == 1
    until(lambda: np.abs(np.array(arm.get_coords_plan()[:3]) - wanted[:3]).max() < 0.5)
    settle(arm)
    assert np.linalg.norm(np.array(arm.get_coords()[:3]) - wanted[:3]) < 35  # worn
    assert arm.is_in_position(arm.get_coords(), 1) == 1
    assert arm.is_in_position(arm.get_angles(), 0) == 1
    assert arm.is_in_position([0.0] * 6, 0) == 0


def test_single_coordinates(arm):
    start = arm.get_coords_plan()
    assert arm.send_coord(3, start[2] - 20, 100) == 1
    settle(arm)
    assert arm.get_coords_plan()[2] == pytest.approx(start[2] - 20, abs=0.5)
    assert arm.jog_increment_coord(3, 20.0, 100) == 1
    settle(arm)
    np.testing.assert_allclose(arm.get_coords_plan()[:3], start[:3], atol=0.5)


def test_inverse_kinematics(arm):
    coords = arm.angles_to_coords(REST)
    angles = arm.solve_inv_kinematics(coords, REST)
    np.testing.assert_allclose(arm.angles_to_coords(angles)[:3], coords[:3], atol=0.5)


def test_jogs_run_until_stopped(arm):
    for method, arguments in (("jog_angle", (1, 1, 50)), ("jog_coord", (2, 0, 50)), ("jog_rpy", (3, 0, 50))):
        before = arm.get_angles_plan()
        assert getattr(arm, method)(*arguments) == 1
        assert arm.is_moving() == 1
        until(lambda before=before: np.abs(np.array(arm.get_angles_plan()) - before).max() > 3)
        assert arm.stop() == 1
        settle(arm)
        held = arm.get_angles_plan()
        assert arm.get_angles_plan() == held


def test_pause_resume_stop_and_brake(arm):
    arm.set_fresh_mode(0)
    arm.send_angles([80.0, *REST[1:]], 20)
    until(lambda: arm.get_angles_plan()[0] > 25)
    assert arm.pause() == 1
    assert arm.is_paused() == 1
    settle(arm)
    there = arm.get_angles_plan()
    assert arm.get_angles_plan() == there
    assert arm.resume() == 1
    until(lambda: arm.get_angles_plan()[0] > there[0] + 5)
    assert arm.joint_brake(1) == 1
    settle(arm)
    assert arm.get_angles_plan()[0] < 79


def test_the_newest_command_wins_in_fresh_mode_and_queues_without(arm):
    arm.send_angle(1, 160.0, 50)
    arm.send_angle(1, 0.0, 50)
    highest = []
    until(lambda: highest.append(arm.get_angles()[0]) or highest[-1] < 10)
    assert max(highest) < 120
    assert arm.set_fresh_mode(0) == 1
    assert arm.get_fresh_mode() == 0
    for angle in (30.0, -10.0):
        assert arm.send_angle(1, angle, 100) == 1
    seen = []
    until(lambda: seen.append(arm.get_angles_plan()[0]) or seen[-1] < -9.9)
    assert max(seen) > 15, "it went on its way to the first, and not to the newest at once"
    settle(arm)
    arm.send_angle(1, 60.0, 20)
    arm.send_angle(1, 0.0, 20)
    assert arm.clear_queue() == 1
    settle(arm)
    assert arm.get_angles_plan()[0] == pytest.approx(60.0, abs=0.05)


def test_limits_are_kept_where_the_client_does_not_check(arm):
    assert arm.send_radians([4.0, 0.0, 0.0, 0.0, 0.0, 0.0], 50) == 0
    assert arm.get_error_information() == 1
    assert arm.clear_error_information() == 1
    assert arm.get_error_information() == 0
    assert arm.set_joint_max(1, 30) == 1
    assert arm.get_joint_max_angle(1) == 30.0
    assert arm.send_angle(1, 40.0, 100) == 0
    assert arm.set_joint_min(1, -20) == 1
    assert arm.get_joint_min_angle(1) == -20.0
    assert arm.send_angle(1, -30.0, 100) == 0
    assert near(arm.get_angles(), REST)


def test_power_and_servos(arm):
    assert arm.release_servo(6) == 1
    assert arm.is_servo_enable(6) == 0
    assert arm.is_all_servo_enable() == 0
    assert arm.focus_servo(6) == 1
    assert arm.is_all_servo_enable() == 1
    assert arm.set_free_mode(1) == 1
    assert arm.is_free_mode() == 1
    assert arm.set_free_mode(0) == 1
    assert arm.is_free_mode() == 0
    before = arm.get_coords()[2]
    assert arm.power_off() == 1
    assert arm.is_power_on() == 0
    until(lambda: arm.get_coords()[2] < before - 15)  # it falls
    assert arm.send_angles(REST, 50) == 0
    assert arm.power_on() == 1
    assert arm.release_all_servos() == 1
    assert arm.is_all_servo_enable() == 0
    assert arm.focus_all_servos() == 1
    assert arm.is_all_servo_enable() == 1
    arm.send_angles([20.0, 0.0, 0.0, 0.0, 0.0, 0.0], 100)
    settle(arm)


def test_go_home_and_calibrate(arm):
    assert arm.go_home() == 1  # at a tenth of the speed
    until(lambda: arm.get_angles_plan()[2] > REST[2] + 2)
    assert arm.stop() == 1
    settle(arm)
    offset = arm.get_angles()[5]
    assert arm.set_servo_calibration(6) == 1
    assert arm.get_angles()[5] == pytest.approx(0.0, abs=0.2)
    arm.send_angle(6, -offset if abs(offset) > 0.1 else 0.0, 100)
    settle(arm)
