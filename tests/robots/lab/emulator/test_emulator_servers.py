"""Servers under clients that behave badly: raw sockets and terminals, no vendor client."""

import os
import signal
import socket
import struct
import subprocess
import sys
import termios
import time
from contextlib import closing, suppress

import numpy as np
import pytest

from rejoint.arms import mycobot280, tcp_position
from rejoint.robots.lab.emulator import Firmware, Timing, TruthLog, emulate, serve_pty, serve_tcp
from rejoint.system.errors import FileError, InputError, ProfileError

pytestmark = pytest.mark.realtime

QUICK = Timing(state=0.001, acknowledgement=0.001)
GET_ANGLES = bytes.fromhex("FE FE 02 20 FA")
ANGLES = bytes.fromhex("FE FE 0E 20 07D0 0000 DECC FE0C 0000 0000 FA")
IS_POWER_ON = bytes.fromhex("FE FE 02 12 FA")
POWER_IS_ON = bytes.fromhex("FE FE 03 12 01 FA")


def place(server):
    host, port = server.address.removeprefix("tcp://").rsplit(":", 1)
    return host, int(port)


def connect(server, patience=2.0):
    return closing(socket.create_connection(place(server), patience))


@pytest.fixture
def server(firmware):
    with serve_tcp(firmware, port=0, timing=QUICK) as running:
        yield running


def test_each_answer_arrives_whole_and_alone(server):
    with connect(server) as client:
        for _ in range(5):
            client.sendall(GET_ANGLES)
            assert client.recv(1024) == ANGLES


def test_two_commands_at_once_get_two_answers_in_order(server):
    with connect(server) as client:
        client.sendall(IS_POWER_ON + GET_ANGLES)
        got = b""
        while len(got) < len(POWER_IS_ON) + len(ANGLES):
            got += client.recv(1024)
        assert got == POWER_IS_ON + ANGLES


def test_garbage_gets_no_answer_and_does_no_harm(server):
    with connect(server) as client:
        client.sendall(np.random.default_rng(1).bytes(5000))
        client.settimeout(0.3)
        with suppress(TimeoutError):
            while client.recv(1024):
                pass  # random bytes may hold a command
        client.settimeout(2.0)
        client.sendall(GET_ANGLES)
        assert client.recv(1024) == ANGLES


def test_a_half_frame_is_given_up(server):
    with connect(server) as client:
        client.sendall(bytes.fromhex("FE FE 0F 22 00 00"))
        client.sendall(GET_ANGLES)  # swallowed by the half frame until the line is quiet
        assert client.recv(1024) == ANGLES


def test_a_frame_in_pieces_is_answered(server):
    with connect(server) as client:
        for i in range(len(GET_ANGLES)):
            client.sendall(GET_ANGLES[i : i + 1])
        assert client.recv(1024) == ANGLES


@pytest.mark.parametrize("farewell", ["close", "reset", "half frame"])
def test_the_next_client_is_served_however_the_last_one_left(server, farewell):
    with connect(server) as client:
        client.sendall(bytes.fromhex("FE FE 0F 22") if farewell == "half frame" else GET_ANGLES)
        if farewell == "reset":
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    with connect(server) as client:
        client.sendall(GET_ANGLES)
        assert client.recv(1024) == ANGLES


def test_a_second_client_waits_for_the_first_to_leave(server):
    with connect(server) as first, connect(server, 0.2) as second:
        first.sendall(GET_ANGLES)
        assert first.recv(1024) == ANGLES
        second.sendall(IS_POWER_ON)
        with pytest.raises(TimeoutError):
            second.recv(1024)
        first.close()
        second.settimeout(2.0)
        assert second.recv(1024) == POWER_IS_ON


def test_a_client_that_never_reads_does_not_block_the_arm(firmware):
    with (
        serve_tcp(firmware, port=0, timing=Timing(state=0.0, acknowledgement=0.0)) as running,
        connect(running) as client,
    ):
        client.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                client.send(GET_ANGLES * 200)
        before = firmware.time
        deadline = time.monotonic() + 5.0
        while firmware.time <= before and time.monotonic() < deadline:
            time.sleep(0.01)
        assert firmware.time > before


def test_time_goes_on_between_requests(server, plant):
    with connect(server) as client:
        client.sendall(bytes.fromhex("FE FE 0F 22 0BB8 0000 DECC FE0C 0000 0000 64 FA"))  # joint 1 to 30 deg
        assert client.recv(1024) == bytes.fromhex("FE FE 03 22 01 FA")
        deadline = time.monotonic() + 5.0
        while plant.position[0, 0] < np.radians(29.99) and time.monotonic() < deadline:
            time.sleep(0.01)  # nobody asks anything
        assert plant.position[0, 0] == pytest.approx(np.radians(30.0), abs=1e-3)


def test_a_port_in_use_is_named(server, firmware):
    port = place(server)[1]
    with pytest.raises(InputError, match=str(port)):
        serve_tcp(firmware, port=port)
    with pytest.raises(InputError, match="nosuchhost"):
        serve_tcp(firmware, host="nosuchhost.invalid", port=0)
    with pytest.raises(InputError, match="70000"):
        serve_tcp(firmware, port=70000)


def test_a_stopped_server_frees_its_port(firmware):
    with serve_tcp(firmware, port=0, timing=QUICK) as running:
        port = place(running)[1]
    with serve_tcp(firmware, port=port, timing=QUICK) as running, connect(running) as client:
        client.sendall(GET_ANGLES)
        assert client.recv(1024) == ANGLES


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


def test_a_terminal_does_not_echo_before_its_first_client(firmware):
    with serve_pty(firmware, timing=QUICK) as running:
        device = running.address.removeprefix("serial://").partition("?")[0]
        client = os.open(device, os.O_RDWR | os.O_NOCTTY)
        flags = termios.tcgetattr(client)[3]
        os.close(client)
        assert not flags & (termios.ECHO | termios.ICANON)


def test_the_truth_log_holds_what_nobody_can_ask_for(firmware, plant, tmp_path):
    path = tmp_path / "truth.csv"
    log = TruthLog.open(path, 6)
    with serve_tcp(firmware, port=0, timing=QUICK, log=log) as running, connect(running) as client:
        began = time.monotonic()
        for _ in range(20):
            client.sendall(GET_ANGLES)
            client.recv(1024)
    log.close()
    rows = np.genfromtxt(path, delimiter=",", names=True)
    assert rows.dtype.names[:4] == ("time", "x", "y", "z")
    assert np.all(np.diff(rows["time"]) > 0)
    assert began - 1 <= rows["time"][-1] <= time.monotonic()
    tip = tcp_position(mycobot280(), plant.position[0])
    np.testing.assert_allclose([rows["x"][-1], rows["y"][-1], rows["z"][-1]], tip, atol=1e-6)


@pytest.mark.parametrize("options", ["port=0", "pty=True"])
def test_emulate_can_be_reached_when_it_says_so_and_ends_with_ctrl_c(options, tmp_path):
    """A program of its own: it serves a client, and an interrupt ends it without a trace."""
    log = tmp_path / "truth.csv"
    program = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "  # ignored in background jobs
        "from pathlib import Path; from rejoint.arms import mycobot280; "
        "from rejoint.robots.lab.emulator import emulate; "
        f"emulate(mycobot280(), 'worn', {options}, log=Path({str(log)!r}), announce=lambda a: print(a, flush=True))"
    )
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", program], stdout=pipe, stderr=pipe, text=True) as process:
        address = process.stdout.readline().strip()
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
    assert (process.returncode, rest, complaints) == (0, "", "")
    assert len(log.read_text(encoding="utf-8").splitlines()) > 1


def test_a_log_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(FileError, match="nowhere"):
        emulate(mycobot280(), "worn", port=0, announce=lambda _: None, log=tmp_path / "nowhere" / "truth.csv")


def test_emulate_refuses_an_unknown_profile():
    with pytest.raises(ProfileError, match="worn"):
        emulate(mycobot280(), "no-such-wear", port=0, announce=lambda _: None)


def test_the_same_seed_gives_the_same_arm(worn):
    from rejoint.robots.lab.emulator import build_firmware

    other = build_firmware(mycobot280(), "worn")
    for firmware in (worn, other):
        assert isinstance(firmware, Firmware)
        firmware.fresh = True
        firmware.move_joints(mycobot280().rest + 0.2, 1.0)
        firmware.advance(0.7)
    np.testing.assert_array_equal(worn.angles, other.angles)
