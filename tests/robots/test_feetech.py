"""The driver of an SO-101 on the maker's client, against the emulated bus; rows of docs/robots.md among them."""

import json
import re
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest

from emulatedservers import serve_bus
from rejoint.arms import load_arm
from rejoint.control.controllers.classical import IntegratorController
from rejoint.control.loop import Schedule, run
from rejoint.robots import open_robot, place_of
from rejoint.robots.feetech import KIND
from rejoint.robots.feetech.bus import FeetechBus, FeetechWire
from rejoint.robots.knobs import LIMIT, TunedServos
from rejoint.robots.servobus import STEP, Gripper, read_calibration
from rejoint.system.errors import (
    AddressError,
    ConnectionLostError,
    GuardTripError,
    InputError,
    PowerLostError,
    RobotError,
)
from rejoint_lab.emulator.feetech import HOMING, StsArm
from targetdrive import drive_until_error

pytestmark = pytest.mark.realtime  # the client waits 50 ms for an answer, whatever keeps the emulated bus from it

ARM = load_arm("so101")
TARGETS = np.array([[[0.33, 0.05, 0.22], [0.31, -0.05, 0.20]]])
TORQUE, GOAL, LOCK = 40, 42, 55


def built():
    return StsArm.build(ARM, "so101")


def opened(server, options=""):
    return closing(open_robot(server.address + options))


def serving(fault="", *, pty=False, arm=None):
    return serve_bus(arm or built(), fault, pty=pty)


def never_dropped(arm):
    """Every servo kept its torque, and nothing that it keeps without power was written."""
    for servo in arm.servos:
        for address, data in servo.writes:
            assert address in (TORQUE, GOAL, LOCK)
            assert address == GOAL or data == b"\1"
        assert servo["Torque_Enable"] == 1
    return True


def drive(fault, *, dwell=1.5):
    """Drive to two targets with a fault; returns the recording, what ended it, and the arm."""
    with serving(fault) as server, opened(server) as robot:
        return *drive_until_error(robot, TARGETS, dwell), server.arm


def calibration(path, **changes):
    spans = [(930, 3166), (910, 3186), (946, 3150), (967, 3129), (0, 4095), (1937, 3189)]
    motors = {
        name: {"id": i + 1, "drive_mode": 0, "homing_offset": HOMING[i], "range_min": low, "range_max": high}
        for i, (name, (low, high)) in enumerate(zip((*ARM.joint_names, "gripper"), spans, strict=True))
    }
    for name, change in changes.items():
        motors[name] |= change
    path.write_text(json.dumps(motors))
    return path


@pytest.mark.parametrize(
    "left", [{}, {"Acceleration": 50, "Goal_Velocity": 300}, {"Acceleration": 10, "Maximum_Acceleration": 254}]
)
def test_servos_as_sold_or_slowed_down_by_another_program_follow_as_promptly_as_under_lerobot(left):
    """Else a joint sets off so late after a jump of its command that the monitor takes it for stuck."""
    slow = built()
    for servo in slow.servos:
        servo["Acceleration"], servo["Maximum_Acceleration"] = 0, 100
        for name, value in left.items():
            servo[name] = value
        slow.settle(servo)
        servo._kept = bytes(servo.cells)
    with serving(arm=slow) as server, opened(server):
        pass
    prompt = built().plant.settings[0, :5]
    for field in ("acceleration", "speed"):
        assert (slow.plant.settings[0, :5][field] == prompt[field]).all()
    assert all(servo["Lock"] == 1 and servo["Torque_Enable"] == 1 for servo in slow.servos)
    for servo in slow.servos[:5]:
        servo.cycle_power()
        assert servo["Maximum_Acceleration"] == left.get("Maximum_Acceleration", 100)
    assert not slow.servos[5].writes


def test_a_servo_that_labours_gets_its_old_gains_back_and_no_stiffer_ones():
    class Servos(TunedServos):
        load, gravity = 0.0, 0.8
        memory = {"p": (32, 32), "i": (0, 0), LIMIT: (0, 0), "dead_cw": (1, 1)}  # noqa: RUF012

        def read_gains(self):
            return dict(self.memory)

        def write_gain(self, name, values):
            self.memory[name] = tuple(values)

        def strain(self, joint):
            return self.load * (joint == 0), 30

        def relieve(self, _):
            self.load = min(self.load, self.gravity)

        def wait(self, duration):
            pass

    servos = Servos(KIND, ("1", "2"), {})
    servos.prepare_gains()
    before = servos.servo_gains()
    servos.tune({"p": (48, 32), "i": (1, 0), LIMIT: (50, 0), "dead_cw": (0, 1)})
    servos.load = 0.9
    with pytest.raises(RobotError):
        servos.tune({"p": (64, 32)})
    assert servos.memory["p"][0] == 48
    servos.load, servos.gravity = 0.9, 0.4  # by friction alone: where it stands it bears them
    servos.tune({"p": (64, 32)})
    assert servos.memory["p"][0] == 64
    servos.tune(before)
    assert servos.gains == before


def test_tuned_gains_are_taken_back_by_hand_or_by_power_and_kept_only_when_asked():
    with serving() as server, opened(server) as robot:
        before = robot.servo_gains()
        wanted = before | {"p": (32, 40, 48, 40, 32), "i": (0, 1, 2, 0, 0), "limit": (0, 50, 50, 0, 0)}
        robot.tune(wanted)
        assert robot.servo_gains() == wanted
        elbow = server.arm.servos[2]
        assert (elbow["P_Coefficient"], elbow["I_Coefficient"], elbow["Integral_Limit"]) == (48, 2, 50)
        assert max(np.diff([32] + [data[0] for address, data in elbow.writes if address == 21])) == 4
        robot.tune(before)
        assert robot.servo_gains() == before
        assert all(address != LOCK for servo in server.arm.servos for address, _ in servo.writes)
        robot.keep(wanted)
        locks = [data[0] for address, data in elbow.writes if address == LOCK]
        assert locks == [0, 1]
    for index, servo in enumerate(server.arm.servos[:5]):
        servo.cycle_power()
        assert (servo["P_Coefficient"], servo["I_Coefficient"]) == (wanted["p"][index], wanted["i"][index])
        assert servo["Lock"] == 1


def test_a_gripper_is_driven_beside_the_joints_and_left_alone_until_it_has_a_goal():
    with serving() as server, opened(server) as robot:
        servo = server.arm.servos[5]
        low, high = servo["Min_Position_Limit"], servo["Max_Position_Limit"]
        gripper = Gripper.find(robot.bus)
        assert gripper.opened == pytest.approx(100 * (servo["Present_Position"] - low) / (high - low))
        gripper.serve()
        assert not servo.writes
        gripper.goal = 150.0
        for _ in range(60):
            robot.step(ARM.rest[None])
            gripper.serve()
        goal = servo["Goal_Position"], servo["Torque_Limit"], servo["Torque_Enable"]
        assert goal == (high, 500, 1)
        assert gripper.opened > 90.0
        assert len([1 for address, _ in servo.writes if address == GOAL]) == 1
        assert all(servo["Torque_Enable"] == servo["Lock"] == 1 for servo in server.arm.servos)
        servo["ID"] = 9
        assert Gripper.find(robot.bus) is None


def test_gains_that_came_during_a_connection_are_set_again_on_the_next_one():
    with serving() as server, closing(FeetechBus(place_of(server.address).detail, ARM)) as bus:
        bus.open()
        bus.prepare()
        bus.tune({"p": (40,) * 5})
        bus.close()
        server.arm.servos[0]["P_Coefficient"] = 32
        bus.open()
        bus.prepare()
        assert bus.servo_gains()["p"] == (40,) * 5


def zeros_of(homing, low, high, file=None, query=""):
    """What a bus makes of registers (5,)."""
    address = place_of(f"feetech://here{query}").detail
    told = {"homing": np.array(homing), "low": np.full(5, low), "high": np.full(5, high)}
    return FeetechBus.find_zeros(SimpleNamespace(arm=ARM, file=file, address=address, get_all=told.get))


def test_goals_are_clipped_to_what_the_servos_take():
    zeros = zeros_of([0] * 5, 1000, 3000)
    assert zeros.counts(np.full(5, 3.0)) == [3000] * 5
    assert zeros.counts(np.full(5, -3.0)) == [1000] * 5
    assert (zeros.middle == 2000.0).all()
    angles = np.linspace(-1.5, 1.5, 5)
    assert zeros.radians(zeros.counts(angles)) == pytest.approx(angles, abs=STEP / 2)


def test_a_calibration_must_be_one_and_that_of_this_arm(tmp_path):
    file = read_calibration(calibration(tmp_path / "a.json"), ARM)
    assert file.ids == ((1,), (2,), (3,), (4,), (5,))
    middle = zeros_of(HOMING[:5], 0, 4095, file).middle
    assert middle.tolist() == ((file.low + file.high) / 2).tolist()
    with pytest.raises(RobotError):
        zeros_of([*HOMING[:2], 5, *HOMING[3:5]], 0, 4095, file)
    with pytest.raises(InputError, match="ranges must rise"):
        read_calibration(calibration(tmp_path / "b.json", elbow_flex={"range_max": 10}), ARM)


def test_an_arm_that_was_never_calibrated_is_refused_and_nothing_is_written():
    with pytest.raises(RobotError, match=r"elbow_flex, wrist_flex may turn by a whole turn.*zero="):
        zeros_of([0] * 5, 0, 4095)
    assert zeros_of([0] * 5, 0, 4095, query="?zero=0,0,0,0,0").middle.tolist() == [2047.5] * 5
    with serving() as server:
        fresh = server.arm.servos[2]  # an elbow with a new servo
        fresh["Min_Position_Limit"], fresh["Max_Position_Limit"] = 0, 4095
        with pytest.raises(AddressError, match=r":\d+: elbow_flex may turn by a whole turn"):
            open_robot(server.address)
        assert not fresh.writes


@pytest.mark.parametrize("pty", [False, True])
def test_an_arm_is_read_and_goes_where_it_is_sent(pty):
    with serving(pty=pty) as server, opened(server) as robot:
        state = robot.read()
        assert state.position[0] == pytest.approx(ARM.rest, abs=np.radians(0.2))
        assert state.load[0] == pytest.approx(server.arm.plant.load[0], abs=0.0081)
        lead = server.arm.plant.status["goal"][0] - server.arm.plant.status["position"][0]
        assert state.load[0] == pytest.approx(lead * 8 / 1000, abs=1e-9)
        assert (state.voltage == 12.0).all()
        assert (state.temperature < 30).all()
        assert not state.fault.any()
        goal = ARM.rest + np.radians([8, 5, -5, 8, 8])
        for share in np.linspace(0, 1, 30):
            state = robot.step(ARM.rest[None] + share * (goal - ARM.rest))
        for _ in range(15):
            state = robot.step(goal[None])
        assert state.position[0] == pytest.approx(goal, abs=np.radians(6.0))
        assert never_dropped(server.arm)


def test_a_calibration_file_and_a_zero_of_the_owner_shift_the_angles(tmp_path):
    file = calibration(tmp_path / "arm.json", elbow_flex={"range_min": 946 + 20, "range_max": 3150 + 20})
    with serving() as server:
        with opened(server, f"?calibration={file}") as robot:
            shifted = robot.read().position[0]
        with opened(server, "?zero=0,0,0,5,0") as robot:
            turned = robot.read().position[0]
    assert np.degrees(shifted - ARM.rest) == pytest.approx([0, 0, -20 * 360 / 4096, 0, 0], abs=0.2)
    assert np.degrees(turned - ARM.rest) == pytest.approx([0, 0, 0, 5, 0], abs=0.2)


def test_torque_comes_on_where_the_arm_is_and_locks_are_shut():
    arm = built()
    for servo in arm.servos:
        servo["Torque_Enable"], servo["Lock"], servo["Goal_Position"] = 0, 0, 3000
        arm.settle(servo)
    arm.advance(0.2)
    limp = arm.angles
    with serving(arm=arm) as server, opened(server) as robot:
        held = robot.read().position[0]
        assert held == pytest.approx(limp, abs=np.radians(2.5))
    for servo in arm.servos[:5]:
        goals = [int.from_bytes(data, "little") for address, data in servo.writes if address == GOAL]
        order = [address for address, _ in servo.writes]
        assert order.index(GOAL) < order.index(TORQUE)
        assert abs(goals[0] - servo["Present_Position"]) < 30
        assert servo["Lock"] == servo["Torque_Enable"] == 1
    assert not arm.servos[5].writes  # the gripper is left as it is
    assert arm.servos[5]["Torque_Enable"] == 0


@pytest.mark.parametrize("count", [-5, 0, 4095])
def test_a_position_is_sent_back_as_the_goal_that_it_was_read_as(count):
    goal, position = KIND.registers["goal"], KIND.registers["position"]
    assert goal.encode(count) == position.encode(count)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            {"ID": 9},
            "elbow_flex .servo 3. is missing on the bus; check its cable, its ID and its baud rate; others .*: 9",
        ),
        ({"Model_Number": 1284}, "elbow_flex .servo 3. is of model 1284"),
        ({"Operating_Mode": 1}, "elbow_flex .servo 3. is not in position mode"),
    ],
)
def test_a_servo_that_cannot_be_driven_is_named(change, says):
    arm = built()
    for name, value in change.items():
        arm.servos[2][name] = value
    with serving(arm=arm) as server, pytest.raises(AddressError, match=says) as caught:
        open_robot(server.address)
    assert str(caught.value).startswith(f"{server.address}: elbow_flex")  # not that no SO-101 answers
    assert never_dropped(arm)


def test_an_arm_that_lost_its_torque_meanwhile_is_not_switched_on_again():
    arm = built()
    with serving(arm=arm) as server, closing(FeetechBus(place_of(server.address).detail, ARM)) as bus:
        bus.open()
        bus.prepare()
        bus.close()
        arm.servos[3].cycle_power()
        arm.settle(arm.servos[3])
        bus.open()
        with pytest.raises(PowerLostError):
            bus.prepare()
    assert arm.servos[3]["Torque_Enable"] == 0


def test_the_end_of_a_run_does_not_say_that_joints_hold_which_lost_their_torque(monkeypatch):
    with serving() as server, opened(server) as robot:
        ask, asked = FeetechWire.read_all, []

        def lose(wire, servos, address, size):
            asked.append(servos)
            if len(asked) == 20:
                server.arm.servos[2]["Torque_Enable"] = 0
                server.arm.settle(server.arm.servos[2])
                return {}
            return ask(wire, servos, address, size)

        monkeypatch.setattr(FeetechWire, "read_all", lose)
        with pytest.raises(PowerLostError) as caught:
            run(robot, IntegratorController(ARM), TARGETS, Schedule(dwell=1.5))
    assert "What has no torque does not hold" in " ".join(caught.value.__notes__)
    assert server.arm.servos[2]["Torque_Enable"] == 0


@pytest.mark.parametrize("fallen", [(3,), (1, 2, 3, 4, 5)])
def test_servos_that_began_anew_are_not_switched_on_by_the_next_goal(monkeypatch, fallen):
    """A dip of the supply resets servos: they are silent for a moment, joints fall, and any goal would lift them."""
    with serving() as server, opened(server) as robot:
        robot.step(ARM.rest[None])
        ask = FeetechWire.read_all

        def silent_once(wire, servos, address, size):
            monkeypatch.setattr(FeetechWire, "read_all", ask)
            for servo in fallen:
                server.arm.servos[servo - 1]["Torque_Enable"] = 0
                server.arm.settle(server.arm.servos[servo - 1])
            return {servo: data for servo, data in ask(wire, servos, address, size).items() if servo not in fallen}

        monkeypatch.setattr(FeetechWire, "read_all", silent_once)
        with pytest.raises(PowerLostError):
            robot.step(ARM.rest[None])
        robot.stop()
    torque = [servo["Torque_Enable"] for servo in server.arm.servos[:5]]
    assert torque == [0 if number in fallen else 1 for number in range(1, 6)]


def test_two_programs_do_not_drive_one_arm():
    with serving(pty=True) as server, opened(server) as robot:
        with pytest.raises(AddressError, match="another program drives the arm there"):
            open_robot(server.address)
        assert np.isfinite(robot.read().position).all()


@pytest.mark.parametrize(
    ("fault", "gap"),
    [
        ("drop=0.005,garbage=0.01,half=0.005,echo=0.005,double=0.01,stall=0.3/1.2", 0),
        ("mute=2@0.7/2", 1.5),
        ("gone=0.7/1", 0.9),
    ],
    ids=["lossy", "servo", "cable"],
)
def test_what_is_lost_or_silent_for_a_while_is_got_over(fault, gap):
    recording, error, arm = drive(fault, dwell=2.0)
    assert error is None
    assert np.isfinite(recording.position).all()
    assert np.diff(recording.time[:, 0]).max() > gap
    assert never_dropped(arm)


@pytest.mark.parametrize(
    ("fault", "says", "holds"),
    [("mute=2@1/60", "shoulder_lift (servo 2)", "holds its position"), ("gone=1/60", "", "holds there")],
)
def test_what_stays_silent_is_named_and_the_arm_holds(monkeypatch, fault, says, holds):
    monkeypatch.setattr("rejoint.robots.bus.TIMEOUT", 1.5)
    monkeypatch.setattr("rejoint.robots.bus.SILENCE", 1.0)
    recording, error, arm = drive(fault)
    assert isinstance(error, ConnectionLostError)
    assert says in str(error)
    assert holds in error.__notes__[-1]
    assert len(recording.time) > 10
    assert never_dropped(arm)


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("overload=3@1", r"elbow_flex reports a servo fault \(overload\)"),
        ("voltage@1", r"the supply sags to 7\.0 V from 12\.0 V"),
        ("sag=24", r"the supply sags to|servo fault \(voltage\)"),  # the second after a dip between two cycles
        ("overheat=2@0", "shoulder_lift is at"),
    ],
)
def test_what_servos_suffer_from_is_named_and_holds_the_arm(fault, says):
    _, error, arm = drive(fault)
    assert isinstance(error, GuardTripError)
    assert re.search(says, str(error))
    assert never_dropped(arm)
