"""The emulated bus of X servos: bytes of the manual, what servos do and refuse, and ROBOTIS' own client as judge."""

import socket
import time
from contextlib import contextmanager

import dynamixel_sdk as sdk
import numpy as np
import pytest
import serial
from hypothesis import given, settings
from hypothesis import strategies as st

from rejoint.arms import load_arm
from rejoint.robots.wireserver import Finder, TerminalServer
from rejoint_lab.emulator.dynamixel import (
    ACTION,
    BULK_READ,
    BULK_WRITE,
    FAST_BULK_READ,
    FAST_SYNC_READ,
    FORMAT,
    REBOOT,
    REG_WRITE,
    STATUS,
    XArm,
    crc,
    encode,
)
from rejoint_lab.emulator.faults import parse_faults
from rejoint_lab.emulator.servers import on_port
from rejoint_lab.emulator.servobus import BROADCAST, PING, READ, SYNC_READ, SYNC_WRITE, WRITE, BusSession, Packet

GOLDEN = {
    "FF FF FD 00 01 03 00 01 19 4E": Packet(1, PING),
    "FF FF FD 00 01 07 00 55 00 06 04 26 65 5D": Packet(1, STATUS, bytes([0, 6, 4, 38])),
    "FF FF FD 00 FE 03 00 01 31 42": Packet(BROADCAST, PING),
    "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15": Packet(1, READ, bytes([132, 0, 4, 0])),
    "FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0": Packet(1, STATUS, bytes([0, 166, 0, 0, 0])),
    "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89": Packet(1, WRITE, bytes([116, 0, 0, 2, 0, 0])),
    "FF FF FD 00 01 04 00 55 00 A1 0C": Packet(1, STATUS, bytes([0])),
    "FF FF FD 00 01 09 00 04 68 00 C8 00 00 00 AE 8E": Packet(1, REG_WRITE, bytes([104, 0, 200, 0, 0, 0])),
    "FF FF FD 00 01 03 00 05 02 CE": Packet(1, ACTION),
    "FF FF FD 00 01 03 00 08 2F 4E": Packet(1, REBOOT),
    "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA": Packet(BROADCAST, SYNC_READ, bytes([132, 0, 4, 0, 1, 2])),
    "FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87": Packet(
        BROADCAST, SYNC_WRITE, bytes([116, 0, 4, 0, 1, 150, 0, 0, 0, 2, 170, 0, 0, 0])
    ),
    "FF FF FD 00 FE 0D 00 92 01 90 00 02 00 02 92 00 01 00 1A 05": Packet(
        BROADCAST, BULK_READ, bytes([1, 144, 0, 2, 0, 2, 146, 0, 1, 0])
    ),
    "FF FF FD 00 FE 10 00 93 01 20 00 02 00 A0 00 02 1F 00 01 00 50 B7 68": Packet(
        BROADCAST, BULK_WRITE, bytes([1, 32, 0, 2, 0, 160, 0, 2, 31, 0, 1, 0, 80])
    ),
    "FF FF FD 00 FE 0D 00 82 7E 00 0A 00 01 02 03 04 05 06 18 B7": Packet(
        BROADCAST, SYNC_READ, bytes([126, 0, 10, 0, 1, 2, 3, 4, 5, 6])
    ),
    "FF FF FD 00 06 09 00 03 14 00 9C FF FF FF D5 95": Packet(6, WRITE, bytes([20, 0, 0x9C, 255, 255, 255])),
}
"""ROBOTIS' manual of protocol 2, and what its client was seen to send"""


@pytest.mark.parametrize("text", GOLDEN)
def test_bytes_of_the_manual_are_these_packets(text):
    assert encode(GOLDEN[text]) == bytes.fromhex(text)
    assert Finder(FORMAT).feed(bytes.fromhex(text)) == [GOLDEN[text]]


PACKETS = st.builds(
    Packet, st.integers(0, 252), st.integers(0, 255), st.lists(st.sampled_from([0, 0xFD, 0xFF]), max_size=30).map(bytes)
)


@given(st.lists(PACKETS, min_size=1), st.integers(1, 40), st.binary(max_size=5))
def test_packets_are_found_stuffed_cut_and_behind_garbage(packets, size, garbage):
    garbage = garbage.replace(b"\xff", b"")
    stream = b"".join(garbage + encode(packet) for packet in packets)
    found, seeker = [], Finder(FORMAT)
    for start in range(0, len(stream), size):
        found += seeker.feed(stream[start : start + size])
    assert found == packets
    spoilt = bytearray(encode(packets[0]))
    spoilt[-1] ^= 1
    assert Finder(FORMAT).feed(bytes(spoilt)) == []


def made(name="koch"):
    return XArm.build(load_arm(name), "new")


@pytest.fixture
def bus():
    return made()


def word(value, size=4):
    return int(value).to_bytes(size, "little", signed=value < 0)


def ask(bus, servo, code, *parts):
    """Answers as (ID, error byte, data)."""
    request = Packet(servo, code, b"".join(part if isinstance(part, bytes) else word(part, 2) for part in parts))
    packets = [Finder(FORMAT).feed(answer.data) for answer in bus.execute(request)]
    return [(one.id, one.parameters[0], one.parameters[1:]) for (one,) in packets]


def read(bus, servo, address, size=4):
    ((_, _, data),) = ask(bus, servo, READ, address, size)
    return int.from_bytes(data, "little", signed=True)


def write(bus, servo, address, value, size=4):
    ((_, error, _),) = ask(bus, servo, WRITE, address, word(value, size))
    return error


def test_faults_hit_the_servos_of_their_joint():
    bus = made("vx300s")
    bus.faults = parse_faults("mute=3@0/2,same=3@2", 6)
    bus.suffer(1.0)
    assert [servo.number for servo in bus.servos if servo not in bus.hearing()] == [4, 5]
    bus.suffer(3.0)
    assert [servo.number for servo in bus.servos] == [1, 2, 3, 2, *range(5, 10)]


def test_servos_refuse_what_the_manual_says(bus):
    cases = {
        (11, 3, 1): 7,  # of the lasting area, under torque
        (132, 0, 4): 7,  # measured
        (300, 0, 1): 7,  # nothing
        (84, 16384, 2): 4,
        (102, 1800, 2): 6,  # a limit in another register
        (116, 2100, 4): 0,
    }
    assert {case: write(bus, 3, *case) for case in cases} == cases
    assert write(bus, 1, 102, 5, 2) == 7  # an XL430 has no current
    assert ask(bus, 3, READ, 0, 0) == [(3, 5, b"")]
    assert ask(bus, 3, 0x77) == [(3, 2, b"")]
    for code, parts in ((READ, (0, 2)), (WRITE, (65, b"\1")), (REBOOT, ())):
        assert ask(bus, 9, code, *parts) == ask(bus, BROADCAST, code, *parts) == []


def test_lasting_registers_outlive_a_reboot_and_others_do_not(bus):
    assert write(bus, 1, 64, 0, 1) == 0
    assert write(bus, 1, 9, 50, 1) == write(bus, 1, 84, 900, 2) == 0
    turned = read(bus, 1, 132) + 4096
    assert write(bus, 1, 20, read(bus, 1, 20) + 4096) == 0
    assert read(bus, 1, 132) == turned
    assert ask(bus, 1, REBOOT) == [(1, 0, b"")]
    assert ask(bus, 1, PING) == []
    bus.advance(0.3)
    assert (read(bus, 1, 9, 1), read(bus, 1, 84, 2), read(bus, 1, 64, 1)) == (50, 640, 0)
    assert read(bus, 1, 132) == turned


def test_another_mode_takes_the_gains_back(bus):
    assert read(bus, 3, 84, 2) == 1500
    write(bus, 3, 64, 0, 1)
    assert write(bus, 3, 11, 5, 1) == 0
    assert (read(bus, 3, 84, 2), read(bus, 3, 112)) == (400, 0)
    assert write(bus, 1, 11, 5, 1) == 7  # under torque
    write(bus, 1, 64, 0, 1)
    assert write(bus, 1, 11, 5, 1) == 4  # an XL430 has no such mode


@pytest.mark.parametrize(("fault", "bit"), [("overload=2@0", 32), ("voltage@0", 1), ("current=2@0", 16)])
def test_a_tripped_servo_is_limp_and_says_so_until_it_is_rebooted(bus, fault, bit):
    bus.faults = parse_faults(fault, 5)
    bus.suffer(0.0)
    bus.advance(0.2)
    bus.faults = {}
    assert write(bus, 2, 65, 1, 1) == 0x80
    assert read(bus, 2, 70, 1) == bit
    tripped = bool(bit & read(bus, 2, 63, 1))
    write(bus, 2, 64, 1, 1)
    assert read(bus, 2, 64, 1) == (not tripped)
    ask(bus, 2, REBOOT)
    bus.advance(0.3)
    assert write(bus, 2, 64, 1, 1) == 0
    assert read(bus, 2, 70, 1) == 0


def test_a_servo_that_cannot_move_trips_and_one_that_limits_its_current_does_not():
    def blocked(mode):
        bus = made("omx")
        write(bus, 15, 64, 0, 1)
        assert write(bus, 15, 11, mode, 1) == 0
        write(bus, 15, 102, 100, 2)
        write(bus, 15, 64, 1, 1)
        bus.gripper.qvel[:] = 0.0
        write(bus, 15, 116, 4000)
        for _ in range(50):
            bus.advance(0.1)
        return read(bus, 15, 70, 1), read(bus, 15, 64, 1), read(bus, 15, 126, 2)

    assert blocked(3)[:2] == (32, 0)
    error, torque, current = blocked(5)
    assert (error, torque) == (0, 1)
    assert current == pytest.approx(100, abs=8)


def test_a_bus_that_falls_silent_stops_the_arm_where_it_has_a_watchdog(bus):
    write(bus, 1, 98, 5, 1)
    write(bus, 1, 112, 50)
    write(bus, 1, 116, 3000)
    bus.advance(0.4)
    here = read(bus, 1, 132)
    assert read(bus, 1, 98, 1) == -1
    assert write(bus, 1, 116, 3000) == 4
    bus.advance(0.5)
    assert read(bus, 1, 132) == pytest.approx(here, abs=20)
    assert write(bus, 1, 98, 0, 1) == write(bus, 1, 116, 3000) == 0


def test_a_profile_takes_the_time_that_was_asked_for():
    bus = made("omx")
    start = read(bus, 11, 132)
    for address, value in ((112, 100), (108, 50), (116, start + 800)):
        assert write(bus, 11, address, value) == 0
    bus.advance(0.25)  # 100 x 0.229 rpm are 1563 counts/s, 50 units of acceleration 12 207 counts/s^2
    assert read(bus, 11, 140) - start == pytest.approx(1563 * (0.25 - 0.064), abs=15)
    write(bus, 11, 64, 0, 1)
    write(bus, 11, 10, 4, 1)  # times instead
    bus.advance(0.2)
    write(bus, 11, 64, 1, 1)
    for address, value in ((112, 1000), (108, 200), (116, start)):
        assert write(bus, 11, address, value) == 0
    bus.advance(0.98)
    assert abs(read(bus, 11, 140) - start) > 0
    bus.advance(0.05)
    assert read(bus, 11, 140) == start


def test_two_servos_of_a_joint_work_together_or_against_each_other():
    bus = made("wx250s")
    place = [read(bus, servo, 132) for servo in (2, 3)]
    assert place[0] == place[1]
    ask(bus, BROADCAST, SYNC_WRITE, 116, 4, b"\2" + word(place[0] + 60))
    bus.advance(1.0)
    assert read(bus, 2, 116) == read(bus, 3, 116)
    assert read(bus, 2, 126, 2) == read(bus, 3, 126, 2)
    for servo in (2, 3):
        assert ask(bus, servo, PING)[0][0] == servo
    write(bus, 3, 64, 0, 1)
    write(bus, 3, 20, 40)
    write(bus, 3, 64, 1, 1)
    bus.advance(0.5)
    assert abs(read(bus, 2, 126, 2) - read(bus, 3, 126, 2)) > 100


def test_registers_are_gathered_and_writes_wait(bus):
    for k, address in enumerate((70, 132, 133, 134, 135)):
        assert write(bus, 3, 168 + 2 * k, address, 2) == 0
    ((_, _, data),) = ask(bus, 3, READ, 208, 5)
    assert int.from_bytes(data[1:], "little") == read(bus, 3, 132)
    assert ask(bus, 3, REG_WRITE, 65, b"\1") == [(3, 0, b"")]
    assert (read(bus, 3, 69, 1), read(bus, 3, 65, 1)) == (1, 0)
    ask(bus, BROADCAST, ACTION)
    assert (read(bus, 3, 69, 1), read(bus, 3, 65, 1)) == (0, 1)
    before = read(bus, 3, 120, 2)
    bus.advance(0.05)
    assert read(bus, 3, 120, 2) - before == 50


def test_answers_come_in_the_time_of_their_bytes_and_spoil_one_another(bus):
    asked = Packet(BROADCAST, SYNC_READ, word(126, 2) + word(10, 2) + bytes([6, 1, 2]))
    ends = [answer.after for answer in bus.execute(asked)]
    assert np.diff([0.0, *ends]) == pytest.approx([21e-5 + 20e-6] * 3)
    (one,) = bus.execute(asked._replace(code=FAST_SYNC_READ))
    assert one.data[-2:] == crc(one.data[:-2])
    assert (len(one.data), one.after) == (8 + 3 * 14, pytest.approx(50e-5 + 20e-6))
    ask(bus, 1, WRITE, 68, b"\1")
    assert ask(bus, 1, WRITE, 65, b"\1") == []
    bus.servos[2]["ID"] = 2
    assert len(bus.execute(Packet(2, PING))) == 2
    bus.faults = parse_faults("power=0/9", 5)
    bus.suffer(0.1)
    assert [servo["Torque_Enable"] for servo in bus.servos] == [0] * 6


MANY = (SYNC_READ, FAST_SYNC_READ, SYNC_WRITE, BULK_READ, FAST_BULK_READ, BULK_WRITE)
ORDINARY = st.sampled_from([REBOOT, READ, WRITE, REG_WRITE, ACTION, 0x77, *MANY])


@settings(max_examples=300, deadline=None)
@given(st.sampled_from([1, 2, 3, 0xFE]), ORDINARY, st.integers(0, 700), st.binary(max_size=20), st.booleans())
def test_no_packet_ends_the_bus(servo, code, address, data, waits):
    for answer in WIDOWX.execute(Packet(servo, code, word(address, 2) + data)):
        assert code in (FAST_SYNC_READ, FAST_BULK_READ) or len(Finder(FORMAT).feed(answer.data)) == 1
    if waits:
        WIDOWX.advance(0.05)
    assert np.isfinite(WIDOWX.angles).all()


WIDOWX = made("wx250s")


class AnyPort(sdk.PortHandler):
    """ROBOTIS' port on anything that pyserial opens."""

    def setupPort(self, cflag_baud):  # noqa: ARG002, N802 - its names
        self.ser = serial.serial_for_url(self.port_name, baudrate=self.baudrate, timeout=0.001)
        if hasattr(self.ser, "_socket"):
            self.ser._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.is_open, self.tx_time_per_byte = True, 10_000 / self.baudrate
        return True

    def setPacketTimeout(self, length):  # noqa: N802
        self.setPacketTimeoutMillis(self.tx_time_per_byte * length + 100)  # a busy machine


@contextmanager
def client(kind):
    """ROBOTIS' port and packet handler on an emulated arm."""
    with kind(BusSession(made())) as server:
        place = server.address.removeprefix("dynamixel://").partition("?")[0]
        port = AnyPort(place if kind is TerminalServer else f"socket://{place}")
        assert port.openPort()
        try:
            yield port, sdk.PacketHandler(2.0)
        finally:
            port.closePort()


@pytest.mark.realtime
@pytest.mark.parametrize("kind", [TerminalServer, on_port])
def test_robotis_client_drives_the_arm(kind):
    with client(kind) as (port, packets):
        assert packets.broadcastPing(port)[0] == {
            servo: [1060, 46] if servo < 3 else [1200, 52] for servo in range(1, 7)
        }
        group, goals = sdk.GroupSyncRead(port, packets, 126, 10), sdk.GroupSyncWrite(port, packets, 116, 4)
        assert all(group.addParam(servo) for servo in range(1, 7))
        assert packets.write1ByteTxRx(port, 1, 11, 4) == (sdk.COMM_SUCCESS, 7)
        assert group.txRxPacket() == group.fastSyncRead() == sdk.COMM_SUCCESS
        before = {servo: group.getData(servo, 132, 4) for servo in range(1, 7)}
        for servo, count in before.items():
            goals.addParam(servo, list(word(count + 150)))
        assert goals.txPacket() == sdk.COMM_SUCCESS
        time.sleep(1.0)
        assert group.txRxPacket() == sdk.COMM_SUCCESS
        assert all(40 < group.getData(servo, 132, 4) - count < 260 for servo, count in before.items())
        assert packets.reboot(port, 5)[0] == sdk.COMM_SUCCESS
        time.sleep(0.5)
        assert packets.read1ByteTxRx(port, 5, 64) == (0, sdk.COMM_SUCCESS, 0)
        assert packets.ping(port, 9)[1] == sdk.COMM_RX_TIMEOUT
        if kind is TerminalServer:
            port.closePort()
            assert port.setBaudRate(57600)
            assert packets.ping(port, 1)[1] != sdk.COMM_SUCCESS


@pytest.mark.realtime
def test_robotis_client_finds_all_that_it_can_ask_for():
    with client(on_port) as (port, packets):
        done, on = (sdk.COMM_SUCCESS, 0), range(1, 7)
        assert packets.ping(port, 1) == (1060, *done)
        assert packets.read2ByteTxRx(port, 3, 84) == (1500, *done)
        bulk, writes = sdk.GroupBulkRead(port, packets), sdk.GroupBulkWrite(port, packets)
        asked = (144, 2), (132, 4)
        assert all(bulk.addParam(servo, *asked[servo % 2]) for servo in on)
        assert all(writes.addParam(servo, *((65, 1, [1]) if servo % 2 else (98, 1, [0]))) for servo in on)
        assert writes.txPacket() == bulk.txRxPacket() == sdk.COMM_SUCCESS
        seen = [bulk.getData(servo, *asked[servo % 2]) for servo in on]
        assert seen[1::2] == [120, 50, 50]
        assert packets.write1ByteTxRx(port, 3, 64, 0) == packets.write4ByteTxRx(port, 3, 20, 0) == done
        assert packets.write1ByteTxRx(port, 3, 11, 4) == done
