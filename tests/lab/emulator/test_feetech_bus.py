"""What the emulated servos answer, and what their registers do, without a wire."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rejoint.arms import load_arm
from rejoint.robots.wireserver import Finder
from rejoint_lab.emulator import servobus as packets
from rejoint_lab.emulator.faults import parse_faults
from rejoint_lab.emulator.feetech import FORMAT, SIZE, TABLE, StsArm
from rejoint_lab.emulator.servobus import BROADCAST, Packet

ARM = load_arm("so101")


@pytest.fixture
def bus():
    return StsArm.build(ARM, "so101")


def word(value):
    return int(value).to_bytes(2, "little")


def answers(bus, number, code, *parameters):
    found = bus.execute(Packet(number, code, b"".join(p if isinstance(p, bytes) else bytes([p]) for p in parameters)))
    return [Finder(FORMAT).feed(answer.data)[0] for answer in found]


def value(bus, number, address, size=2):
    return int.from_bytes(answers(bus, number, packets.READ, address, size)[0].parameters, "little")


def test_registers_do_not_overlap_and_fit():
    cells = [cell for field in TABLE.values() for cell in range(SIZE)[field.register.cells]]
    assert len(cells) == len(set(cells))
    assert max(cells) < SIZE
    assert all(field.default < 256**field.register.size for field in TABLE.values())


def test_every_servo_answers_its_ping_and_tells_its_model(bus):
    for number in range(1, 7):
        assert answers(bus, number, packets.PING) == [Packet(number, 0)]
        assert value(bus, number, 3) == 777
        assert value(bus, number, 5, 1) == number
    assert answers(bus, 7, packets.PING) == []
    assert [a.id for a in answers(bus, BROADCAST, packets.PING)] == [1, 2, 3, 4, 5, 6]


def test_a_synchronous_read_is_answered_in_its_order_and_its_slots(bus):
    request = Packet(BROADCAST, packets.SYNC_READ, bytes([56, 15, 6, 1, 9, 2]))
    found = bus.execute(request)
    assert [Finder(FORMAT).feed(answer.data)[0].id for answer in found] == [6, 1, 2]
    assert all(len(answer.data) == 21 for answer in found)
    first, second, fourth = (answer.after for answer in found)
    assert second - first == pytest.approx(24 * 10e-6)
    assert fourth - second == pytest.approx(2 * 24 * 10e-6)  # the slot of the missing one stays empty


def test_silent_servos_neither_hear_nor_answer(bus):
    bus.faults = parse_faults("mute=2@0/9", 5)
    bus.suffer(0.0)
    assert answers(bus, 2, packets.PING) == []
    before = bus.servos[1]["Goal_Position"]
    bus.execute(Packet(BROADCAST, packets.SYNC_WRITE, bytes([42, 2, 2, 0, 8])))
    assert bus.servos[1]["Goal_Position"] == before
    assert [a.id for a in answers(bus, BROADCAST, packets.SYNC_READ, 56, 2, 1, 2, 3)] == [1, 3]


def test_an_arm_goes_where_a_synchronous_write_sends_it(bus):
    here = [value(bus, number, 56) for number in range(1, 7)]
    goals = [h + 100 for h in here]
    data = b"".join(bytes([i + 1]) + word(goal) for i, goal in enumerate(goals))
    assert answers(bus, BROADCAST, packets.SYNC_WRITE, 42, 2, data) == []
    bus.advance(1.5)
    there = [value(bus, number, 56) for number in range(1, 7)]
    assert np.abs(np.subtract(there, goals)).max() < 40
    moved = np.degrees(bus.angles - ARM.rest)
    assert (moved > 5).all()
    assert (moved < 12).all()


def test_goals_stay_within_the_limits_of_the_servo(bus):
    low = value(bus, 1, 9)
    assert answers(bus, 1, packets.WRITE, 42, word(low - 300))[0].code == 0
    bus.advance(3.0)
    assert value(bus, 1, 56) >= low - 2


def test_settings_outlast_the_power_only_if_the_lock_was_open(bus):
    servo = bus.servos[0]
    answers(bus, 1, packets.WRITE, 21, 16)
    assert bus.plant.settings["p"][0, 0] == 16
    servo.cycle_power()
    assert servo["P_Coefficient"] == 32
    answers(bus, 1, packets.WRITE, 55, 0)
    answers(bus, 1, packets.WRITE, 21, 48)
    servo.cycle_power()
    assert (servo["P_Coefficient"], servo["Lock"], servo["Torque_Enable"]) == (48, 1, 0)


def test_a_goal_turns_the_torque_on_where_the_joint_is(bus):
    bus.advance(0.5)
    assert answers(bus, 2, packets.WRITE, 40, 0)[0].code == 0
    bus.advance(0.1)
    assert value(bus, 2, 60) == 0
    limp = value(bus, 2, 56)
    answers(bus, 2, packets.WRITE, 42, word(limp))
    assert value(bus, 2, 40, 1) == 1
    bus.advance(0.5)
    assert abs(value(bus, 2, 56) - limp) < 20


def test_the_goal_in_force_stays_in_its_register_whatever_the_offset(bus):
    for goal in (0x7FFF, 0xFFFF):
        for offset in (0x7FFF, 0xFFFF):
            answers(bus, 2, packets.WRITE, 42, word(goal))
            answers(bus, 2, packets.WRITE, 31, word(offset))
            assert len(answers(bus, 2, packets.READ, 67, 2)[0].parameters) == 2


@settings(max_examples=200)
@given(number=st.integers(0, 254), code=st.integers(0, 255), parameters=st.binary(max_size=40))
def test_no_packet_ends_the_bus(number, code, parameters):
    before = bytes(BUS.servos[0].cells[:5])
    for answer in BUS.execute(Packet(number, code, parameters)):
        assert len(Finder(FORMAT).feed(answer.data)) == 1
    BUS.advance(0.001)
    assert bytes(BUS.servos[0].cells[:5]) == before
    assert np.isfinite(BUS.angles).all()


BUS = StsArm.build(ARM, "so101")
