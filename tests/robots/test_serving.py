"""Programs of the vendor's client drive a worn arm through `rejoint serve`: its unmodified client is the judge."""

import dataclasses
import json
import os
import socket
import threading
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from benchmarks.serve import ARM, attack, check_log, connected, holds, play, read_times, served

from madetwin import made_twin
from rejoint.arms import Displacement, Motors, gravity_torque, tcp_pose, tcp_position
from rejoint.control.correction import Modelled
from rejoint.control.guard import GuardLimits, clear_by
from rejoint.robots.mycobot.bus import MyCobot280
from rejoint.robots.mycobot.wire import COLLISION, FORMAT, Frame, encode, pack_angles, pack_coords
from rejoint.robots.serving import PATIENCE, REFUSED, Clients, MoveEnd, OrderLog, ServedArm
from rejoint.robots.wireserver import Finder
from rejoint.runs.run import Run
from rejoint.session.inputs import Settings
from rejoint.system.errors import NoReplyError
from rejoint.twin.parameters import nominal_parameters
from rejoint_lab.plant.wear import load_wear
from standin import now_at

pytestmark = pytest.mark.filterwarnings("ignore:.*getdefaultlocale.*:DeprecationWarning")
PLAIN = Modelled(ARM, Displacement.none(ARM))
PACE = 6.0
"""times as fast as real; the arm is an emulated one of this process"""


@pytest.fixture
def run(tmp_path):
    return Run.create(tmp_path, "emulated:worn", ARM).path


@pytest.fixture(scope="module")
def twin():
    known = dataclasses.replace(nominal_parameters(ARM), stiffness=load_wear("worn", ARM).position_gain)
    return made_twin(ARM, known)


@pytest.mark.realtime
def test_a_program_hits_and_nothing_a_client_does_ends_the_serving(run, twin):
    said: list[str] = []
    options = {"listen": "127.0.0.1:0", "settings": Settings(twin=twin), "pace": PACE, "said": said}
    with served("emulated:worn", run, **options) as (address, ends):
        with connected(address) as client:
            outcomes = play(client, PACE, steps=5)
            assert np.mean([outcome.error for outcome in outcomes]) < 1.0, outcomes  # the bare arm: 20
            assert np.median(read_times(client, 50)) < 5.0
            assert client.is_in_position([float(x) for x in client.get_coords()], 1) == 1
            with closing(socket.create_connection(address.removeprefix("tcp://").rsplit(":", 1), 2.0)) as second:
                assert second.recv(10) == b"", "one client at a time"
            assert client.send_coords([270.0, 270.0, 400.0, 0.0, 0.0, 0.0], 50) == 0
            assert client.get_error_information() == 32
            assert client.power_off() == 0
            assert client.is_power_on() == client.is_all_servo_enable() == 1
            assert client.jog_angle(1, 1, 20) == 1
            time.sleep(0.5)
            before = client.get_angles()[0]
        with connected(address) as client:  # the client alone takes 1.5 s, in which the joint would run to its limit
            assert client.get_angles()[0] < before + 30.0 < 168.0
            assert client.get_error_information() == 0, "that was another client's"
        attack(address, 2.0)
        time.sleep(0.3)
        with connected(address) as client:
            assert holds(client, PACE)
    assert check_log(Path(ends[0].log)) == ends[0].orders >= 10
    assert any("Refused a second client" in line for line in said)
    assert any(line.startswith("Refused power_off: the arm would fall") for line in said)
    log = Run.open(run).logs
    (name,) = (name for name in log if name.startswith("serve-"))
    assert np.isfinite(log[name].target).all()


@pytest.mark.realtime
def test_a_serial_line_is_served_and_the_arm_holds_when_it_is_closed(run, twin):
    said: list[str] = []
    with served("emulated:worn", run, pty=True, settings=Settings(twin=twin), pace=PACE, said=said) as (address, ends):
        device = address.removeprefix("serial://").partition("?")[0]
        for _ in range(2):  # the second finds the line as the first
            client = MyCobot280(device, 1_000_000)
            goal = [float(x) for x in np.degrees(ARM.rest + 0.1)]
            assert client.sync_send_angles(goal, 80, timeout=5) == 1
            place = 1e3 * tcp_position(ARM, np.radians(goal))
            assert np.linalg.norm(np.array(client.get_coords()[:3]) - place) < 3.0  # [mm]
            client._serial_port.close()
            time.sleep(0.3)
    assert sum("closed; the arm holds" in line for line in said) == 2
    assert ends[0].orders == 2


def resting():
    return ServedArm(ARM, ARM.rest, apparent=PLAIN)


def advance(served, clock, position):
    return served.advance(now_at(position, clock))


def answering(served, passes=None, listener=None):
    said: list[str] = []
    log = OrderLog(Path(os.devnull), say=said.append)
    log.close()
    return Clients(served, log, passes, said.append, listener), said


def answered(answers, command, payload=b""):
    """What the answer to an order carries, which is one to that order."""
    code, told = answers.answer(Frame(command, payload))
    assert code == command
    return told


def test_a_move_has_ended_once_the_tool_stays_near_or_comes_no_nearer():
    for off, expected in ((0.0, 0.3), (0.05, PATIENCE)):
        served, ends = resting(), list[MoveEnd]()
        served.on_arrival = ends.append
        goal = ARM.rest + 0.1
        assert served.move_joints(goal, 1.0)
        assert served.moving
        clock, wanted = 0.0, None
        while not ends and clock < 20.0:
            wanted = advance(served, clock, ARM.rest if wanted is None else wanted.goal[0] + off)
            clock += 0.05
        assert not served.moving
        assert ends[0].after == pytest.approx(expected, abs=0.11)
        np.testing.assert_allclose(wanted.goal[0], goal)
        distance = np.linalg.norm(tcp_position(ARM, goal) - tcp_position(ARM, goal + off))
        assert ends[0].error == pytest.approx(distance, abs=1e-9)
        assert served.is_at(goal) == (off == 0.0)


def test_a_stopped_arm_is_held_where_it_stands():
    served, ends = resting(), list[MoveEnd]()
    served.on_arrival = ends.append
    answers, _ = answering(served)
    clock = 0.0
    for lag in (0.02, 0.2):  # a worn arm is behind its reference
        assert served.move_joints(served.destination + 0.4, 1.0)
        position = served.angles
        for _ in range(8):
            clock += 0.05
            position = advance(served, clock, position).goal[0] - lag
        answers.answer(Frame(0x29))
        stopped = clock
        while served.moving:
            clock += 0.05
            wanted = advance(served, clock, position)
        assert clock - stopped < 0.6
        np.testing.assert_allclose(wanted.goal[0], position, atol=1e-9)
        np.testing.assert_allclose(served.destination, position, atol=1e-9)
    assert not ends, "it was sent nowhere"


@pytest.mark.parametrize("end", [lambda one: one.left("the client is gone"), lambda one: one.answer(Frame(0x26))])
def test_an_arm_that_is_left_or_paused_is_brought_to_the_end_of_its_way_and_no_farther(end):
    served = resting()
    answers, _ = answering(served)
    goal = ARM.rest + 0.1 * np.eye(6)[1]
    assert served.move_joints(goal, 1.0)
    clock = 0.0
    while served.motion.moving:
        clock += 0.05
        advance(served, clock, ARM.rest)
    assert served.moving, "its joints are not there yet"
    end(answers)
    for later in np.arange(clock, clock + 5.0, 0.05):
        wanted = advance(served, later, ARM.rest)
    np.testing.assert_allclose(wanted.goal[0], goal, atol=1e-9)


def test_an_order_into_the_ground_is_refused_with_the_code_of_a_collision():
    served = ServedArm(ARM, ARM.rest, apparent=PLAIN, limits=GuardLimits.of(ARM))
    answers, said = answering(served)
    low = tcp_pose(ARM, ARM.rest)
    low[2, 3] = -0.02
    for straight in (b"\x00", b"\x01"):
        assert answered(answers, 0x25, pack_coords(low) + b"\x32" + straight) == b"\x00"
        assert answered(answers, 0x07) == bytes([COLLISION])
        assert not served.motion.moving
    assert said == [
        "Refused send_coords: the guard keeps the arm from there: it would touch the ground, a box or itself (error 16)"
    ]
    assert answered(answers, 0x22, pack_angles(ARM.rest + 0.1) + b"\x32") == b"\x01"


@pytest.mark.parametrize(("order", "axis"), [(0x32, 3), (0x30, 2)])
def test_a_jog_ends_before_what_the_guard_keeps_the_arm_from(order, axis):
    limits = GuardLimits.of(ARM)
    served = ServedArm(ARM, ARM.rest, apparent=PLAIN, limits=limits)
    answers, _ = answering(served)
    forwards = 0 if order == 0x32 else 1
    assert answered(answers, order, bytes([axis, forwards, 50])) == b"\x01"
    assert (served.motion.goal != ARM.rest).any()
    assert clear_by(limits, served.motion.goal[None]).min() >= -1e-3
    path = np.linspace(ARM.rest, served.motion.goal, 50)
    assert order == 0x32 or clear_by(limits, path).min() >= -1e-3


@pytest.mark.parametrize(
    ("joint", "way", "came", "held_back", "says"),
    [
        (0, 0.4, 0.1, "collision", "from where it was sent: the guard kept it back (collision)."),
        (5, np.radians(20.0), 0.0, "", "joint6 stopped 20 deg from its goal"),  # it turns the tool about itself
    ],
)
def test_a_move_that_ends_elsewhere_is_told_and_one_that_the_guard_keeps_back_ends_there(
    joint, way, came, held_back, says
):
    served = resting()
    answers, said = answering(served)
    served.on_arrival = answers.arrived
    here = ARM.rest + came * np.eye(6)[joint]  # it comes no farther
    assert served.move_joints(ARM.rest + way * np.eye(6)[joint], 1.0)
    clock, served.held_back = 0.0, held_back
    while served.moving:
        clock += 0.05
        advance(served, clock, here)
    if held_back:
        np.testing.assert_allclose(served.destination, here, atol=1e-12)
        np.testing.assert_allclose(advance(served, clock + 0.05, here).goal[0], here, atol=1e-12)
    assert len(said) == 1
    assert says in said[0]


def test_orders_that_would_let_the_arm_fall_are_refused_and_said():
    answers, said = answering(resting())
    for command in REFUSED:
        assert answered(answers, command, b"\x01") == b"\x00"
    assert len(said) == len(REFUSED)
    assert answered(answers, 0x1A, b"\x00") == b"\x01", "free mode may end"


@pytest.mark.realtime
def test_a_client_that_leaves_a_move_half_done_is_told_of():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        answers, said = answering(resting(), listener=listener)
        with answers.server() as server:
            for request in (b"", encode(Frame(0x22, pack_angles(ARM.rest + 0.2) + b"\x32"))):
                with closing(socket.create_connection(listener.getsockname()[:2], 2.0)) as client:
                    client.sendall(request + encode(Frame(0x2B)))
                    client.recv(100)
                    time.sleep(0.1)
                while sum("the arm holds" in line for line in said) < 1 + bool(request):
                    time.sleep(0.01)
            assert server.failure is None
    ends = [line for line in said if "the arm holds" in line]
    assert "not at its end" not in ends[0]
    assert "Its last move was not at its end: a program waits for it" in ends[1]


def test_an_error_is_told_until_it_is_cleared():
    answers, _ = answering(resting())
    assert answered(answers, 0x22, pack_angles(np.full(6, 3.2)) + b"\x32") == b"\x00"
    assert answered(answers, 0x26) == b"\x01", "another order leaves the error"
    assert answered(answers, 0x07) == b"\x01", "joint 1 is beyond its limit"
    assert answered(answers, 0x08) == b"\x01"
    assert answered(answers, 0x07) == b"\x00"


def test_what_is_old_is_not_told(monkeypatch):
    served = resting()
    answers, _ = answering(served)
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now)
    assert answers.answer(Frame(0x20)) is not None
    monkeypatch.setattr(time, "monotonic", lambda: now + 2.0)
    assert answers.answer(Frame(0x20)) is None


def test_a_client_sees_the_angles_of_a_perfect_arm_where_its_tool_really_is(monkeypatch):
    way = np.array([0.004, -0.003, -0.008])
    apparent = Modelled(ARM, Displacement.none(ARM))
    np.testing.assert_array_equal([apparent.shown(ARM.rest), apparent.measured(ARM.rest)], [ARM.rest] * 2)
    monkeypatch.setattr(apparent, "shift", lambda _: way)
    rng = np.random.default_rng(3)
    for posture in ARM.rest + rng.uniform(-0.4, 0.4, (10, 6)):
        shown = apparent.shown(posture)
        np.testing.assert_allclose(tcp_position(ARM, shown), tcp_position(ARM, posture) + way, atol=2e-5)
        measured = apparent.measured(posture)
        np.testing.assert_allclose(tcp_position(ARM, measured) + way, tcp_position(ARM, posture), atol=2e-5)
        np.testing.assert_allclose(apparent.shown(measured), posture, atol=np.radians(0.4))


def test_a_gripper_is_passed_on_and_one_that_is_silent_asked_twice(monkeypatch):
    monkeypatch.setattr("rejoint.robots.serving.RELAY_PATIENCE", 60.0)
    asked: list[tuple[int, bytes]] = []

    def gripper(command, payload):
        asked.append((command, payload))
        if command == 0x67:
            raise NoReplyError("silent")
        return b"\x01"

    answers, _ = answering(resting(), gripper)
    over = threading.Event()

    def loop():
        while not over.wait(0.005):
            answers.relay()

    thread = threading.Thread(target=loop)
    thread.start()
    assert answered(answers, 0x66, b"\x01\x32") == b"\x01"
    for _ in range(3):
        assert answers.answer(Frame(0x67, b"\x32\x32")) is None
    over.set()
    thread.join()
    monkeypatch.setattr("rejoint.robots.serving.RELAY_PATIENCE", 0.0)
    assert answers.answer(Frame(0x66, b"\x00\x32")) is None
    answers.relay()
    assert asked == [(0x66, b"\x01\x32"), *[(0x67, b"\x32\x32")] * 2]


def test_any_bytes_are_borne(tmp_path):
    served = resting()
    log = OrderLog(tmp_path / "orders.jsonl", say=print)
    answers = Clients(served, log, None, lambda _: None)
    rng, decoder = np.random.default_rng(0), Finder(FORMAT)
    commands = [*REFUSED, *range(0x10, 0x60), 0xD5, 0xE1, 0xE5]
    slow = {0x24, 0x25, 0x31, 0x32, 0x34}  # inverse kinematics
    for number in range(3000):
        command = int(rng.choice(commands))
        payload = rng.bytes(int(rng.integers(0, 29)))
        stream = rng.bytes(3) + encode(Frame(command, payload)) if command not in slow else rng.bytes(9)
        for request in decoder.feed(stream):
            if request.command not in slow:
                found = answers.answer(request)
                assert found is None or found.command == request.command
        advance(served, 0.05 * number, ARM.rest)
    log.close()
    assert len((tmp_path / "orders.jsonl").read_text().splitlines()) == log.orders
    assert all(json.loads(line)["what"] == "order" for line in (tmp_path / "orders.jsonl").read_text().splitlines())


def test_a_full_disk_ends_the_log_and_not_the_arm():
    said: list[str] = []
    log = OrderLog(Path("/dev/full"), say=said.append)
    assert [log.ordered(Frame(0x29), done=True) for _ in range(3)] == [1, 2, 3]
    assert len(said) == 1
    assert "No space left on device" in said[0]


def test_an_order_that_the_motors_cannot_hold_is_refused_with_the_joint_and_by_how_much():
    """A worn arm ended 16 degrees off such an order, in silence."""
    goal = np.radians([0.0, -60.0, -30.0, 0.0, 0.0, 0.0])
    needed = np.abs(gravity_torque(ARM, goal))
    limit = np.full(6, 2.0 * needed.max())
    limit[1] = 0.8 * needed[1]
    served = ServedArm(ARM, ARM.rest, apparent=PLAIN, motors=Motors(limit, limit))
    computer, said = answering(served)
    assert computer.answer(Frame(0x22, pack_angles(goal) + b"\x32")).payload == b"\x00"
    assert served.error == 2
    assert "joint2 needs" in said[-1]
    assert "125 per cent" in said[-1]
    assert ServedArm(ARM, ARM.rest, apparent=PLAIN, motors=Motors(2.0 * limit, 2.0 * limit)).move_joints(goal, 0.5)


def test_an_order_of_one_coordinate_keeps_the_place_where_no_motor_holds_its_orientation():
    start = np.radians([0.0, -60.0, -40.0, 90.0, 0.0, 0.0])
    limit = np.full(6, 5.0)
    limit[1] = 0.9 * np.abs(gravity_torque(ARM, start))[1]
    served = ServedArm(ARM, start, apparent=PLAIN, motors=Motors(limit, 0.8 * limit))
    computer, said = answering(served)
    place = tcp_position(ARM, start)
    order = b"\x01" + round(1e4 * place[0]).to_bytes(2, "big", signed=True) + b"\x32"
    assert computer.answer(Frame(0x24, order)) == Frame(0x24, b"\x01")
    assert (np.abs(gravity_torque(ARM, served.destination)) <= limit).all()
    assert np.linalg.norm(tcp_position(ARM, served.destination) - place) < 1e-3
    assert "joint2" in said[-1]
    assert "111 per cent" in said[-1]
    whole = pack_coords(tcp_pose(ARM, start)) + b"\x32"
    assert computer.answer(Frame(0x25, whole)) == Frame(0x25, b"\x00"), "its orientation was asked for"
    assert computer.answer(Frame(0x07)) == Frame(0x07, b"\x02")
