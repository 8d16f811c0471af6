"""Servers under clients that behave badly: raw sockets and terminals, no vendor client."""

import os
import re
import signal
import socket
import subprocess
import sys
from contextlib import closing

import numpy as np
import pytest
from reaching import place

from emulatedservers import serve_pty, serve_tcp
from rejoint.system.errors import InputError
from waiting import until

pytestmark = pytest.mark.realtime

QUICK = {"state": 0.001, "acknowledgement": 0.001}
GET_ANGLES = bytes.fromhex("FE FE 02 20 FA")
ANGLES = bytes.fromhex("FE FE 0E 20 07D0 0000 DECC FE0C 0000 0000 FA")
IS_POWER_ON = bytes.fromhex("FE FE 02 12 FA")
POWER_IS_ON = bytes.fromhex("FE FE 03 12 01 FA")


def connect(server):
    return closing(socket.create_connection(place(server), 2.0))


@pytest.fixture
def server(firmware):
    with serve_tcp(firmware, timing=QUICK) as running:
        yield running


def test_two_commands_at_once_get_two_answers_in_order(server):
    with connect(server) as client:
        client.sendall(IS_POWER_ON + GET_ANGLES)
        got = b""
        while len(got) < len(POWER_IS_ON) + len(ANGLES):
            got += client.recv(1024)
        assert got == POWER_IS_ON + ANGLES


def test_time_goes_on_between_requests(server, plant):
    with connect(server) as client:
        client.sendall(bytes.fromhex("FE FE 0F 22 0BB8 0000 DECC FE0C 0000 0000 64 FA"))  # joint 1 to 30 deg
        assert client.recv(1024) == bytes.fromhex("FE FE 03 22 01 FA")
        until(lambda: plant.position[0, 0] >= np.radians(29.99))  # nobody asks anything
        assert plant.position[0, 0] == pytest.approx(np.radians(30.0), abs=1e-3)


def test_a_port_in_use_is_named(server, firmware):
    for host, port in (("127.0.0.1", place(server)[1]), ("nosuchhost.invalid", 0), ("127.0.0.1", 70000)):
        with pytest.raises(InputError, match=f"{host}:{port}"):
            serve_tcp(firmware, host=host, port=port)


def test_a_terminal_carries_every_byte_and_outlives_its_clients(firmware):
    with serve_pty(firmware, timing=QUICK) as running:
        device = running.address.removeprefix("serial://").partition("?")[0]
        for _ in range(3):
            client = os.open(device, os.O_RDWR | os.O_NOCTTY)
            os.write(client, b"\x11\x13\x03\x04\xfe" + GET_ANGLES)
            got = b""
            while len(got) < len(ANGLES):
                got += os.read(client, 100)
            os.close(client)
            assert got == ANGLES


@pytest.mark.parametrize("options", [("--port", "0"), ("--pty",)])
def test_emulate_can_be_reached_when_it_says_so_and_ends_with_ctrl_c(options, tmp_path):
    """A program of its own: it serves a client, and an interrupt ends it without a trace."""
    log, pipe = tmp_path / "truth.csv", subprocess.PIPE
    words = [sys.executable, "-m", "rejoint", "emulate", *options, "--log", str(log)]
    with subprocess.Popen(words, stdout=pipe, stderr=pipe, text=True) as process:
        address = re.search(r"\w+://\S+", process.stderr.readline())[0]
        if address.startswith("tcp://"):
            host, port = address.removeprefix("tcp://").rsplit(":", 1)
            with closing(socket.create_connection((host, int(port)), 5.0)) as client:
                for _ in range(2):  # the log is written up to the second question, at least
                    client.sendall(IS_POWER_ON)
                    assert client.recv(1024) == POWER_IS_ON
        else:
            client = os.open(address.removeprefix("serial://").partition("?")[0], os.O_RDWR | os.O_NOCTTY)
            for _ in range(2):
                os.write(client, IS_POWER_ON)
                assert os.read(client, 100)[:2] == POWER_IS_ON[:2]
            os.close(client)
        process.send_signal(signal.SIGINT)
        try:
            rest, complaints = process.communicate(timeout=20)
        finally:
            process.kill()
    assert (process.returncode, rest, complaints) == (0, "", "Emulator ended.\n")
    assert len(log.read_text().splitlines()) > 1
