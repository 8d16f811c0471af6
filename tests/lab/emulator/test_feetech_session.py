"""The emulated bus in time: how long answers take, and what faults do to them, without waiting for a clock."""

import numpy as np
import pytest

from rejoint.arms import load_arm
from rejoint.robots.wireserver import Finder
from rejoint_lab.emulator.faults import parse_faults
from rejoint_lab.emulator.feetech import FORMAT, StsArm, encode
from rejoint_lab.emulator.servobus import ADAPTER, BROADCAST, READ, SYNC_READ, SYNC_WRITE, BusSession, Packet

ARM = load_arm("so101")
MOVE = encode(Packet(BROADCAST, SYNC_WRITE, bytes([42, 2, 1, 0, 8, 2, 0, 8])))
BLOCK = encode(Packet(BROADCAST, SYNC_READ, bytes([56, 15, 1, 2, 3, 4, 5, 6])))


class Client:
    """Asks one question after the other on a clock of its own, ``pause`` [s] apart.

    The emulator is ``busy`` [s] with each of them; ``moved`` [s] is the time of its arm then.
    """

    def __init__(self, requests, fault="", pause=0.02, busy=0.0):
        self.now, self.requests, self.pause = 1e6, list(requests), pause
        self.ask_at, self.asked, self.heard = self.now, [], []
        self.session = BusSession(StsArm.build(ARM, "so101"), faults=parse_faults(fault, 5))
        self.session.clock, self.session.await_data = lambda: self.now, self._await
        self.moved, self.busy, self._execute = [], busy, self.session.arm.execute
        self.session.arm.execute = self._obey
        self.session.converse(self)

    def fileno(self):
        return -1

    def receive(self):
        self.asked.append(self.now)
        self.ask_at = self.now + self.pause
        return self.requests.pop(0) if self.requests else b""

    def send(self, data):
        self.heard.append((self.now, data))

    def _obey(self, request):
        self.moved.append(self.session.arm.plant.time[0])
        self.now += self.busy
        return self._execute(request)

    def _await(self, readable, pause):
        if readable is not None and self.now + pause >= self.ask_at:
            self.now = max(self.now, self.ask_at)
            return True
        self.now += pause
        return False

    def packets(self):
        return [[packet.id for packet in Finder(FORMAT).feed(data)] for _, data in self.heard]


@pytest.mark.parametrize(
    ("requests", "given"),
    [([BLOCK], {}), ([MOVE + BLOCK], {}), ([MOVE, BLOCK], {"pause": 1e-4, "busy": 4e-4})],
    ids=["alone", "right behind an order", "while the emulator works, which is no time on the wire"],
)
def test_an_answer_takes_the_time_of_all_bytes_and_of_the_adapter(requests, given):
    client = Client(requests, **given)
    slots, last = 5 * (15 + 6 + 3), 15 + 6
    expected = (len(b"".join(requests)) + slots + last) * 10e-6 + 20e-6 + ADAPTER
    assert client.heard[0][0] - client.asked[0] == pytest.approx(expected, abs=2e-5)
    assert client.packets() == [[1, 2, 3, 4, 5, 6]]
    assert expected < 3e-3


def test_the_arm_has_moved_up_to_the_moment_of_a_question():
    client = Client([BLOCK] * 20, pause=0.0077)
    assert len(client.moved) == 20
    moved, passed = np.subtract(client.moved, client.moved[0]), np.subtract(client.asked[:20], client.asked[0])
    assert moved == pytest.approx(passed, abs=1.1e-3)


def test_a_silent_servo_is_missing_for_as_long_as_it_was_asked_to_be():
    client = Client([BLOCK] * 100, "mute=2@0.5/1")
    missing = np.array([2 not in found for found in client.packets()])
    times = np.array([at - client.asked[0] for at, _ in client.heard])
    assert (missing == ((times >= 0.5) & (times < 1.5))).mean() > 0.97
    assert missing.sum() == pytest.approx(50, abs=3)


def test_single_packets_of_an_answer_are_lost():
    client = Client([BLOCK] * 300, "drop=0.05", pause=0.01)
    found = client.packets()
    lost = 1800 - sum(map(len, found))
    assert 50 < lost < 140
    assert all(ids == sorted(set(ids)) for ids in found)


def test_a_voltage_that_breaks_down_is_told_with_its_bit():
    ask = encode(Packet(1, READ, bytes([62, 4])))
    client = Client([ask] * 30, "voltage@0.3")
    first, last = (Finder(FORMAT).feed(data)[0] for _, data in (client.heard[0], client.heard[-1]))
    assert (first.code, first.parameters[0]) == (0, 120)
    assert (last.code, last.parameters[0], last.parameters[3]) == (1, 70, 1)
