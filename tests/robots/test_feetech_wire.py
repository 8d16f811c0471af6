"""The maker's client on a line whose other end answers with bytes that were written down before."""

import itertools
import os
import pty
import socket
import time
import tty
from contextlib import closing, contextmanager

import numpy as np
import pytest

from rejoint.robots.family import wire_address
from rejoint.robots.feetech.bus import FeetechWire
from rejoint_lab.emulator.feetech import encode
from rejoint_lab.emulator.servobus import Packet

READ_56 = "FF FF FE 07 82 38 02 01 02 03 38"
"""A synchronous read of two registers from 56 on, of the servos 1 to 3"""
WRITE_42 = "FF FF FE 0A 83 2A 02 01 73 08 02 1A 04 AC"
"""A synchronous write of 2163 and 1050 to 42 of the servos 1 and 2"""
ANSWERS = {servo: encode(Packet(servo, 0, bytes([servo, 8]))) for servo in (1, 2, 3)}
DATA = {servo: bytes([servo, 8]) for servo in (1, 2, 3)}


@contextmanager
def wire_to(*answers, part=4096):
    """Open a line on which each request gets the next of ``answers`` at once, at most ``part`` bytes per look.

    Yields the line and the requests that came. No thread answers: on a busy machine it would be late.
    """
    own, client = pty.openpty()
    tty.setraw(client)
    requests, left, write, read = [], iter(answers), os.write, os.read

    def answered(line, data):
        count = write(line, data)
        requests.append(read(own, 4096))
        write(own, next(left))
        return count

    try:
        with (
            pytest.MonkeyPatch.context() as patch,
            closing(FeetechWire(wire_address(f"serial://{os.ttyname(client)}"))) as wire,
        ):
            patch.setattr(os, "write", answered)
            patch.setattr(os, "read", lambda line, size: read(line, min(size, part)))
            yield wire, requests
    finally:
        os.close(client)
        os.close(own)


def test_the_bytes_of_a_cycle_are_those_of_the_protocol():
    with wire_to(b"".join(ANSWERS.values()), b"") as (wire, requests):
        assert wire.read_all((1, 2, 3), 56, 2) == DATA
        wire.write_all((1, 2), 42, [bytes.fromhex("73 08"), bytes.fromhex("1A 04")])
    assert requests == [bytes.fromhex(READ_56), bytes.fromhex(WRITE_42)]


@pytest.mark.parametrize(
    ("answer", "found"),
    [
        (ANSWERS[1] + ANSWERS[3], {1, 3}),
        (ANSWERS[3], {3}),
        (b"\x07\xff" + ANSWERS[1] + ANSWERS[2] + ANSWERS[3][:-2], {1, 2}),
        (ANSWERS[1] + ANSWERS[2][:-1] + b"\x00" + ANSWERS[3], {1, 3}),
        (bytes.fromhex(READ_56) + ANSWERS[1] + ANSWERS[2], {1, 2}),
        (ANSWERS[2] + ANSWERS[1] + ANSWERS[3], {1, 2, 3}),
        (b"\xff" * 24, set()),
        (b"", set()),
    ],
)
def test_answers_that_are_missing_shifted_or_wrong_are_left_out(answer, found):
    with wire_to(answer) as (wire, _):
        assert wire.read_all((1, 2, 3), 56, 2) == {servo: DATA[servo] for servo in found}


def test_what_came_late_answers_no_later_question():
    old, new = encode(Packet(1, 0, b"\1\1")), encode(Packet(1, 0, b"\2\2"))
    with wire_to(old + old, new) as (wire, _):
        assert wire.read(1, 56, 2) == b"\1\1"
        assert wire.read(1, 56, 2) == b"\2\2"
    with wire_to(old + old) as (wire, _):
        assert wire.read(1, 56, 2) == b"\1\1"
        assert wire.quieten(0.01)
        assert not wire.quieten(0.01)


def test_whatever_comes_is_an_answer_or_an_error_with_a_name():
    rng = np.random.default_rng(0)
    noise = [b"\xff\xff\x01" + bytes([length]) + rng.bytes(int(rng.integers(0, 12))) for length in range(30)]
    noise.append(b"\xff\xff\x01\x00" + bytes(20))  # shorter than any packet, with more behind it
    with wire_to(*noise) as (wire, _):
        for _ in noise:
            with pytest.raises((TimeoutError, ValueError, IndexError)):
                wire.read(1, 56, 2)
            wire.quieten(0.001)


@pytest.mark.parametrize("size", [1, 2, 4])
def test_a_question_that_comes_back_is_no_answer(size):
    echo = encode(Packet(1, 2, bytes([31, size])))
    with (
        wire_to(echo + encode(Packet(1, 0, bytes(size)))) as (wire, _),
        pytest.raises(ValueError, match="use an adapter that does not echo"),
    ):
        wire.read(1, 31, size)


def test_an_answer_of_another_size_is_no_answer():
    """As of a synchronous read that comes late."""
    with (
        wire_to(encode(Packet(1, 0, bytes(15)))) as (wire, _),
        pytest.raises(ValueError, match="15 bytes instead of 1"),
    ):
        wire.read(1, 33, 1)


def test_answers_that_come_in_parts_are_put_together(monkeypatch):
    """A USB adapter hands over what it has every millisecond or so: the clock here goes on by as much at each look."""
    with wire_to(b"".join(ANSWERS.values()), part=5) as (wire, _):
        monkeypatch.setattr(time, "time", itertools.count(step=0.001).__next__)
        assert wire.read_all((1, 2, 3), 56, 2) == DATA


def test_a_line_that_ends_is_a_broken_one():
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        closing(FeetechWire(wire_address(f"feetech://127.0.0.1:{server.getsockname()[1]}"))) as wire,
    ):
        server.accept()[0].close()
        with pytest.raises(OSError, match=r"gone|reset|pipe"):
            wire.read_all((1, 2), 56, 2)
