"""The driver of Dynamixel arms on ROBOTIS' client, against the emulated bus; rows of docs/faults.md among them."""

import json
import re
import socket
from contextlib import closing

import numpy as np
import pytest

from emulatedservers import serve_bus
from rejoint.arms import load_arm
from rejoint.control.guard import GuardLimits
from rejoint.robots import open_robot
from rejoint.robots.dynamixel.bus import DynamixelWire
from rejoint.robots.family import wire_address
from rejoint.robots.servobus import Gripper
from rejoint.system.errors import AddressError, ConnectionLostError, GuardTripError, PowerLostError, RobotError
from rejoint_lab.emulator.dynamixel import XArm
from targetdrive import drive_until_error

pytestmark = pytest.mark.realtime

KOCH, WIDOWX = load_arm("koch"), load_arm("wx250s")
TORQUE, GOAL = 64, 116
READ = "FF FF FD 00 FE 0D 00 82 7E 00 0A 00 01 02 03 04 05 06 18 B7"
WRITE = "FF FF FD 00 FE 25 00 83 74 00 04 00" + "".join(f" 0{i} 00 08 00 00" for i in range(1, 7)) + " 81 BB"


def built(arm=KOCH):
    return XArm.build(arm, "healthy")


def serving(arm=None, fault="", pty=False):
    return serve_bus(arm or built(), fault, pty=pty)


def opened(server, options="", arm=KOCH):
    return closing(open_robot(server.address + options, arm=arm))


def test_the_bytes_of_a_cycle_are_those_of_the_protocol():
    ids = range(1, 7)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = wire_address(f"dynamixel://127.0.0.1:{server.getsockname()[1]}")
        with closing(DynamixelWire(address)) as wire, server.accept()[0] as other:
            assert wire.read_all(ids, 126, 10) == {}
            wire.write_all(ids, GOAL, [(2048).to_bytes(4, "little")] * 6)
            wanted = bytes.fromhex(READ) + bytes.fromhex(WRITE)
            assert other.recv(len(wanted), socket.MSG_WAITALL) == wanted


@pytest.mark.parametrize(("arm", "pty"), [(KOCH, True), (WIDOWX, False), (load_arm("omx"), False)])
def test_an_arm_is_read_goes_where_it_is_sent_and_is_left_as_it_was(arm, pty):
    emulated = built(arm)
    for servo in emulated.servos:
        servo["Profile_Velocity"], servo["Bus_Watchdog"] = 100, 0
    before = [servo["Position_P_Gain"] for servo in emulated.servos]
    with serving(emulated, pty=pty) as server:
        with opened(server, "?p=600" if "?" not in server.address else "&p=600", arm) as robot:
            state = robot.read()
            assert state.position[0] == pytest.approx(arm.rest, abs=np.radians(3.0))
            assert (np.abs(state.load) <= 1.0).all()
            assert (state.voltage > 4.0).all()
            assert (state.temperature < 35.0).all()
            goal = arm.rest + np.radians(8.0)
            for share in np.linspace(0, 1, 30).tolist() + [1.0] * 20:
                state = robot.step(arm.rest[None] + share * (goal - arm.rest))
            assert state.position[0] == pytest.approx(goal, abs=np.radians(15.0))
            assert robot.servo_gains()["p"] == (600,) * arm.joints
            assert [servo["Profile_Velocity"] for servo in emulated.servos[:-1]] == [0] * (len(before) - 1)
        goals = {servo.number: [data for at, data in servo.writes if at == GOAL] for servo in emulated.servos}
        assert all(goals[servo.number] for servo in emulated.servos[:-1])
        assert goals[emulated.servos[-1].number] == []  # the gripper's
    assert [servo["Position_P_Gain"] for servo in emulated.servos] == before
    assert [servo["Profile_Velocity"] for servo in emulated.servos] == [100] * len(before)
    assert all(at >= TORQUE for servo in emulated.servos for at, _ in servo.writes)
    assert all(servo["Torque_Enable"] == 1 for servo in emulated.servos)


def test_torque_comes_on_where_the_arm_is_in_whatever_turn_a_servo_counts():
    arm = built()
    for index, servo in enumerate(arm.servos):
        servo["Torque_Enable"], servo["Goal_Position"] = 0, 3000
        servo.base += 4096 * (index - 2)
        arm.settle(servo)
    with serving(arm) as server, opened(server) as robot:
        held = robot.read().position[0]
        assert held == pytest.approx(arm.angles, abs=np.radians(2.5))
        robot.step(held[None])
        after = robot.step(held[None]).position[0]
    assert after == pytest.approx(held, abs=np.radians(2.5))
    for servo in arm.servos[:5]:
        order = [at for at, _ in servo.writes if at in (TORQUE, GOAL)]
        assert order.index(GOAL) < order.index(TORQUE)
    assert not arm.servos[5].writes


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"ID": 2}, "have two servos the ID 2"),
        ({"ID": 9}, r"elbow_flex .servo 3. is missing on the bus.*others that answer: 9"),
        ({"Model_Number": 1060}, r"elbow_flex .servo 3. is of model XL430-W250, and koch has XL330-M288"),
        ({"Operating_Mode": 1}, r"elbow_flex .servo 3. has no position mode"),
        ({"Operating_Mode": 3, "Homing_Offset": 1100}, "ignores its homing offset of 1100"),
        ({"Status_Return_Level": 1, "Bus_Watchdog": 255}, "obeys, but does not confirm it; set its register 68 to 2"),
    ],
)
def test_a_servo_that_cannot_be_driven_is_named_and_nothing_moves(change, says):
    arm = built()
    for name, value in change.items():
        arm.servos[2][name] = value
    with serving(arm) as server, pytest.raises(AddressError, match=says):
        open_robot(server.address, arm=KOCH)
    assert all(at != GOAL for servo in arm.servos for at, _ in servo.writes)


def test_another_baud_rate_is_named(monkeypatch):
    monkeypatch.setattr("rejoint.robots.bus.TIMEOUT", 0.3)
    with serving(pty=True) as server, pytest.raises(AddressError, match="answers there: give dynamixel:"):
        open_robot(re.sub(r"\?baud=.*", "", server.address) + "?baud=57600", arm=KOCH)


def test_a_servo_that_switched_itself_off_is_restarted_only_if_its_owner_says_so():
    arm = built()
    arm.servos[2].status["alarms"] = 32
    arm.advance(0.05)
    with serving(arm) as server:
        with pytest.raises(
            AddressError, match=r"elbow_flex .servo 3. has switched itself off \(overload\).*reboot=yes"
        ):
            open_robot(server.address, arm=KOCH)
        assert arm.servos[2]["Torque_Enable"] == 0
        with opened(server, "?reboot=yes") as robot:
            assert not robot.read().fault.any()
        assert arm.servos[2]["Torque_Enable"] == 1


def test_two_servos_of_a_joint_that_would_pull_against_each_other_are_refused():
    arm = built(WIDOWX)
    arm.servos[2]["Homing_Offset"] = 100
    with serving(arm) as server, pytest.raises(AddressError, match=r"shoulder .servo 3. stands 100 counts from"):
        open_robot(server.address, arm=WIDOWX)


def test_lerobots_calibration_and_the_owner_say_where_zero_is(tmp_path):
    arm, spans = built(), np.degrees(KOCH.upper - KOCH.lower) / 360 * 4096
    motors = {
        name: {
            "id": k + 1,
            "drive_mode": 0,
            "homing_offset": arm.servos[k]["Homing_Offset"],
            "range_min": max(round(2058 - spans[k] / 2), 0),
            "range_max": round(2058 + min(spans[k] / 2, 2037)),
        }
        for k, name in enumerate(KOCH.joint_names)
    }
    file = tmp_path / "koch.json"
    file.write_text(json.dumps(motors))
    middle = (KOCH.lower + KOCH.upper) / 2
    with serving(arm) as server:
        with opened(server) as robot:
            plain = robot.read().position[0]
        with opened(server, f"?calibration={file}&reverse=wrist_roll") as robot:
            shifted = robot.read().position[0] - middle
        motors["elbow_flex"]["drive_mode"] = 1
        file.write_text(json.dumps(motors))
        with pytest.raises(AddressError, match="elbow_flex: other drive mode"):
            open_robot(f"{server.address}?calibration={file}", arm=KOCH)
    turned = (plain - np.radians(10 * 360 / 4096)) * [1, 1, 1, 1, -1]
    assert shifted == pytest.approx(turned, abs=np.radians(0.5))


def test_a_gripper_opens_beside_the_joints():
    arm = built()
    arm.servos[5]["Min_Position_Limit"], arm.servos[5]["Max_Position_Limit"] = 1500, 2040
    with serving(arm) as server, opened(server) as robot:
        gripper = Gripper.find(robot.bus)
        gripper.serve()
        assert not arm.servos[5].writes
        gripper.goal = 50.0
        gripper.serve()
        assert arm.servos[5]["Goal_Position"] == 1770


TARGETS = np.array([[KOCH.targets.lower, KOCH.targets.upper]])


def drive(fault, dwell=2.0, limits=None):
    """Drive to two targets with a fault; returns the recording, and what ended it."""
    with serving(fault=fault) as server, opened(server) as robot:
        return drive_until_error(robot, TARGETS, dwell, limits)


@pytest.mark.parametrize(
    ("fault", "gap"),
    [
        ("drop=0.005,garbage=0.01,half=0.005,double=0.01", 0),
        ("stale=0.01,split=0.02", 0),
        ("mute=2@3/2", 1.5),
        ("gone=3/1", 0.9),
    ],
)
def test_what_is_lost_or_silent_for_a_while_is_got_over(fault, gap):
    recording, error = drive(fault)
    assert error is None
    assert np.isfinite(recording.position).all()
    assert np.diff(recording.time[:, 0]).max() > gap


@pytest.mark.parametrize(
    ("fault", "kind", "says"),
    [
        ("overload=3@3", GuardTripError, r"elbow_flex reports a servo fault \(overload\)"),
        ("voltage@3", GuardTripError, r"voltage|sags"),
        ("overheat=2@0", GuardTripError, "shoulder_lift is at"),
        ("mute=2@3/60", ConnectionLostError, r"shoulder_lift .servo 2. stays silent"),
        ("power=3/0.5", PowerLostError, "has lost its torque"),
    ],
)
def test_what_servos_suffer_from_is_named_and_ends_in_a_hold(monkeypatch, fault, kind, says):
    monkeypatch.setattr("rejoint.robots.bus.TIMEOUT", 1.5)
    monkeypatch.setattr("rejoint.robots.bus.SILENCE", 1.0)
    _, error = drive(fault)
    assert isinstance(error, kind)
    assert re.search(says, str(error))


def test_a_frozen_encoder_ends_in_a_hold_and_is_named():
    recording, error = drive("freeze=3@1", dwell=6.0, limits=GuardLimits.of(KOCH))
    assert isinstance(error, GuardTripError | RobotError)
    assert "elbow_flex" in str(error)
    assert np.isfinite(recording.position).all()


def test_limits_of_the_current_are_gains_where_servos_obey_them_and_profiles_everywhere():
    omx = load_arm("omx")
    arm = built(omx)
    for servo in arm.servos[:2]:
        servo["Operating_Mode"], servo["Goal_Current"], servo["Profile_Velocity"] = 5, 401, 77
        arm.settle(servo)
    with serving(arm) as server, opened(server, "?acceleration=9", arm=omx) as robot:
        before = robot.servo_gains()
        assert before["current"] == (34, 34, 100, 100)
        assert (before["speed"], before["acceleration"]) == ((0,) * 4, (9,) * 4)
        assert {rung.names[0] for rung in robot.rungs()} == {"limit", "current", "p", "i", "acceleration"}
        robot.tune({"current": (100, 34, 100, 100)})
        assert [servo["Goal_Current"] for servo in arm.servos[:3]] == [1193, 401, 1193]
        assert all(at != 102 for at, _ in arm.servos[2].writes)
        robot.read()  # only what answers is put back
    assert [servo["Goal_Current"] for servo in arm.servos[:2]] == [401, 401]
    assert [servo["Profile_Velocity"] for servo in arm.servos[:3]] == [77, 77, 0]
    with serving() as server, opened(server) as robot:
        assert "current" not in robot.servo_gains()
