"""The codec of the Feetech bus against bytes that others sent, and against whatever a wire can do to them."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rejoint.robots.registers import Register
from rejoint.robots.wireserver import Finder
from rejoint_lab.emulator.feetech import FORMAT, encode
from rejoint_lab.emulator.servobus import BROADCAST, PING, READ, SYNC_READ, SYNC_WRITE, WRITE, Packet

GOAL = (0x0873).to_bytes(2, "little")
GOLDEN = {
    "FF FF 01 02 01 FB": Packet(1, PING),
    "FF FF 01 04 02 03 02 F3": Packet(1, READ, bytes([3, 2])),
    "FF FF FE 0A 82 38 02 01 02 03 04 05 06 26": Packet(BROADCAST, SYNC_READ, bytes([56, 2, 1, 2, 3, 4, 5, 6])),
    "FF FF FE 16 83 2A 02 01 73 08 02 73 08 03 73 08 04 73 08 05 73 08 06 1A 04 A2": Packet(
        BROADCAST,
        SYNC_WRITE,
        bytes([42, 2]) + b"".join(bytes([i]) + GOAL for i in range(1, 6)) + bytes([6]) + (1050).to_bytes(2, "little"),
    ),
    "FF FF 06 05 03 1F 64 08 66": Packet(6, WRITE, bytes([31]) + Register(31, 2, 11).encode(-100)),
}
"""What LeRobot 0.4.4 was seen to send"""

PACKETS = st.builds(
    Packet, st.integers(0, 0xFE), st.sampled_from([0, 1, 2, 3, 32, SYNC_READ, SYNC_WRITE]), st.binary(max_size=30)
)


@pytest.mark.parametrize("text", GOLDEN)
def test_bytes_that_lerobot_sent_are_these_packets(text):
    assert encode(GOLDEN[text]) == bytes.fromhex(text)
    assert Finder(FORMAT).feed(bytes.fromhex(text)) == [GOLDEN[text]]


@given(value=st.integers(-2047, 2047), bit=st.sampled_from([11, 15]))
def test_numbers_with_a_sign_come_back(value, bit):
    register = Register(31, 2, bit)
    assert register.decode(register.encode(value)) == value


@given(sent=st.lists(PACKETS, max_size=5), cuts=st.lists(st.integers(0, 200), max_size=6))
def test_packets_come_whole_however_they_are_cut(sent, cuts):
    stream = b"".join(map(encode, sent))
    places = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    decoder, found = Finder(FORMAT), []
    for begin, end in pairwise(places):
        found += decoder.feed(stream[begin:end])
    assert found == sent
    assert not decoder.rest


@given(noise=st.binary(max_size=60), sent=PACKETS)
def test_after_any_garbage_and_a_pause_the_next_packet_is_found(noise, sent):
    decoder = Finder(FORMAT)
    decoder.feed(noise)
    while decoder.rest:
        decoder.expire()
    assert decoder.feed(encode(sent)) == [sent]


@given(sent=PACKETS, other=PACKETS, cut=st.integers(1, 5))
def test_a_packet_that_broke_off_costs_no_later_one_and_doubled_ones_come_twice(sent, other, cut):
    decoder = Finder(FORMAT)
    found = decoder.feed(encode(sent)[:-cut] + encode(other) * 2)
    while decoder.rest:
        found += decoder.expire()
    whole = [packet for packet in found if packet != other]  # by chance, what follows may complete it, its sum included
    assert found.count(other) >= 2 or whole


@given(data=st.lists(st.binary(max_size=80), max_size=8))
def test_nothing_ends_the_reader_and_it_keeps_no_more_than_a_packet(data):
    decoder = Finder(FORMAT)
    for part in data:
        for packet in decoder.feed(part):
            assert encode(packet) in b"".join(data)
    assert len(decoder.rest) <= 260
