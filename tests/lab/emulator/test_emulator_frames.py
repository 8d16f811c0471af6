"""Frames: bytes worked by hand from the protocol page, round trips, and streams that are broken."""

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rejoint.robots.mycobot.wire import FORMAT, MAX_PAYLOAD, Frame, encode
from rejoint.robots.wireserver import Finder

frames = st.builds(Frame, st.integers(0, 255), st.binary(max_size=MAX_PAYLOAD))
nasty = st.lists(st.sampled_from([0xFE, 0xFA, 0x00, 0x02, 0x0F, 0x1E, 0x20, 0xFF]), max_size=60).map(bytes)

# get_angles; the acknowledgement of send_angles in a real arm's log; send_angles(
# [10.5, -20.25, 0, 90, -155, 180], 50): 1050 = 0x041A, -2025 = 0xF817, 9000 = 0x2328,
# -15500 = 0xC374, 18000 = 0x4650, 50 = 0x32; LEN = 13 + 2.
GOLDEN = [
    (Frame(0x20), "FE FE 02 20 FA"),
    (Frame(0x22, b"\x01"), "FE FE 03 22 01 FA"),
    (
        Frame(0x22, bytes.fromhex("041A F817 0000 2328 C374 4650 32")),
        "FE FE 0F 22 04 1A F8 17 00 00 23 28 C3 74 46 50 32 FA",
    ),
]


def split(stream):
    """Return all whole frames of a stream, and the rest."""
    decoder = Finder(FORMAT)
    return decoder.feed(stream), decoder.rest


@pytest.mark.parametrize(("frame", "text"), GOLDEN)
def test_golden_bytes(frame, text):
    assert encode(frame) == bytes.fromhex(text)
    assert split(bytes.fromhex(text)) == ([frame], b"")


@given(nasty | st.binary(max_size=200), st.lists(st.integers(1, 7), max_size=40))
def test_pieces_give_the_same_frames_as_the_whole(stream, sizes):
    decoder, got, at = Finder(FORMAT), [], 0
    for size in [*sizes, len(stream)]:
        got += decoder.feed(stream[at : at + size])
        at += size
    whole, rest = split(stream)
    assert got == whole
    assert bool(decoder.rest) == bool(rest)
    assert len(rest) < MAX_PAYLOAD + 5


@given(nasty | st.binary(max_size=200), frames)
@example(b"\xfe\xfe\x0f\x22", Frame(0x20))
@example(b"\xfe", Frame(0x20))
def test_a_frame_is_found_after_any_garbage_once_the_line_was_quiet(garbage, frame):
    decoder = Finder(FORMAT)
    decoder.feed(garbage)
    decoder.expire()
    assert not decoder.rest
    assert decoder.feed(encode(frame)) == [frame]


def test_header_and_footer_inside_a_payload_are_data():
    frame = Frame(0x22, b"\xfe\xfe\x02\x20\xfa\xfe\xfe")
    assert split(encode(frame)) == ([frame], b"")
