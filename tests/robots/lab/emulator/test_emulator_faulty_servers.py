"""Faults on real ports and terminals: through the vendor's unmodified client, and through raw sockets."""

import contextlib
import errno
import os
import select
import socket
import struct
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.robots.lab.emulator import Firmware, Timing, parse_faults, serve_pty, serve_tcp
from rejoint.robots.lab.emulator.servers import beyond_loopback
from rejoint.robots.vendor import MyCobot280, MyCobot280Socket

ARM = mycobot280()
QUICK = Timing(state=0.001, acknowledgement=0.001)
REST = [20.0, 0.0, -85.0, -5.0, 0.0, 0.0]
GET_ANGLES = bytes.fromhex("FE FE 02 20 FA")
ANGLES = bytes.fromhex("FE FE 0E 20 07D0 0000 DECC FE0C 0000 0000 FA")
pytestmark = [pytest.mark.realtime, pytest.mark.filterwarnings("ignore:.*getdefaultlocale.*:DeprecationWarning")]


def place(server):
    host, port = server.address.removeprefix("tcp://").rsplit(":", 1)
    return host, int(port)


def device(server):
    return server.address.removeprefix("serial://").partition("?")[0]


@contextlib.contextmanager
def serving(plant, text, *, pty=False):
    serve = serve_pty if pty else lambda firmware, **options: serve_tcp(firmware, port=0, **options)
    with serve(Firmware(plant, ARM), timing=QUICK, faults=parse_faults(text, ARM.joints)) as server:
        yield server


# --- the vendor's client ------------------------------------------------------------------------


def angles(client):
    """What a call ends with: the angles, another value, or the name of an exception."""
    try:
        return client.get_angles()
    except (struct.error, OSError, IndexError, TypeError) as error:
        return type(error).__name__


def timed(client):
    began = time.monotonic()
    return angles(client), time.monotonic() - began


def repeated(client):
    return [angles(client) for _ in range(10)]


def moved(client):
    before = angles(client)
    client.set_fresh_mode(1)
    assert client.send_angles([30.0, *REST[1:]], 100) == 1
    time.sleep(0.5)
    return before, angles(client), client.get_angles_plan()[0]


def suffering(client):
    temperatures = []
    deadline = time.monotonic() + 10.0
    while not temperatures or (temperatures[-1][1] < 75 and time.monotonic() < deadline):
        temperatures.append(client.get_servo_temps())
    return temperatures[-1], client.get_servo_status(), client.get_servo_voltages(), moved(client)


def lost_and_found(client):
    """Ask until the connection is gone; what is said then, and by a new connection."""
    right, deadline = angles(client), time.monotonic() + 10.0
    outcome = right
    while isinstance(outcome, list) and time.monotonic() < deadline:
        time.sleep(0.02)
        outcome = angles(client)
    return right, outcome


ILL = "overheat@0,current=4@0,overload=5@0,voltage=6@0,freeze=3@0,limit=2@0"
CASES = {
    "drop=1": (False, timed),
    "half=1": (False, angles),
    "echo=1": (False, angles),
    "split=1": (False, repeated),
    "slow=0.25": (False, timed),
    "stale=1": (False, moved),
    "gone=0.3/60": (False, lost_and_found),
    "garbage=0.000001,double=0.000001": (False, angles),
    ILL: (False, suffering),
    "echo=1 ": (True, angles),
    "split=1 ": (True, angles),
    "drop=1 ": (True, timed),
}
"""Faults: whether on a terminal (a blank at the end keeps the names apart), and what the client does"""


@pytest.fixture(scope="module")
def outcomes(ideal_plant):
    """All cases at once, since every client sleeps for 1.5 s at first."""

    def run(text):
        pty, work = CASES[text]
        with serving(ideal_plant(), text, pty=pty) as server:
            client = MyCobot280(device(server), 1_000_000) if pty else MyCobot280Socket(*place(server))
            try:
                return work(client)
            finally:
                client.close()

    with ThreadPoolExecutor(len(CASES)) as crew:
        return dict(zip(CASES, crew.map(run, CASES), strict=True))


@pytest.mark.parametrize("transport", ["", " "])
def test_the_client_gives_up_on_answers_that_are_lost(outcomes, transport):
    outcome, took = outcomes["drop=1" + transport]
    assert outcome == -1
    assert took > 0.85  # three times its patience


@pytest.mark.parametrize("text", ["half=1", "echo=1", "echo=1 "])
def test_the_client_cannot_use_what_is_cut_or_echoed(outcomes, text):
    assert outcomes[text] != REST


def test_the_client_takes_a_piece_of_a_split_answer_for_the_whole(outcomes):
    assert any(outcome != REST for outcome in outcomes["split=1"])


def test_a_terminal_puts_split_answers_together(outcomes):
    assert outcomes["split=1 "] == REST


def test_faults_that_are_switched_on_but_do_not_hit_do_nothing(outcomes):
    assert outcomes["garbage=0.000001,double=0.000001"] == REST


def test_the_client_waits_for_a_slow_robot(outcomes):
    outcome, took = outcomes["slow=0.25"]
    assert outcome == REST
    assert took > 0.25


def test_the_client_is_told_old_angles_of_an_arm_that_moves(outcomes):
    before, after, plan = outcomes["stale=1"]
    assert before == after == REST
    assert plan == pytest.approx(30.0, abs=0.02)


def test_the_client_notices_that_the_connection_is_gone(outcomes):
    right, then = outcomes["gone=0.3/60"]
    assert right == REST
    assert then in ("BrokenPipeError", "ConnectionResetError", -1)


def test_the_client_reads_what_the_servos_suffer_from(outcomes):
    temperatures, status, voltages, (before, after, _) = outcomes[ILL]
    assert temperatures[1] >= 75
    assert max(np.delete(temperatures, 1)) == 30
    assert status == [0, [2], 0, [3], [5], [0]]
    assert voltages == [12.0] * 5 + [7.0]
    assert before[1] > np.degrees(ARM.upper[1]) + 2.0
    assert before[2] == after[2] == REST[2]
    assert after[0] == pytest.approx(30.0, abs=0.1)


# --- raw sockets and terminals ------------------------------------------------------------------


def read(descriptor, patience=5.0):
    assert select.select([descriptor], [], [], patience)[0], "nothing came"
    return os.read(descriptor, 1024)


def test_the_pieces_of_an_answer_are_apart_on_the_wire(plant):
    with serving(plant, "split=1") as server, socket.create_connection(place(server), 5.0) as client:
        client.sendall(GET_ANGLES)
        first = client.recv(1024)
        assert ANGLES.startswith(first)
        assert 0 < len(first) < len(ANGLES)
        assert first + client.recv(1024) == ANGLES


def test_a_connection_that_is_gone_is_refused_and_comes_back(plant):
    with serving(plant, "gone=0.05/0.4") as server:
        with socket.create_connection(place(server), 5.0) as client:
            client.sendall(GET_ANGLES)
            assert client.recv(1024) == ANGLES
            assert client.recv(1024) == b""
        refused, got, deadline = 0, b"", time.monotonic() + 10.0
        while not got and time.monotonic() < deadline:
            try:
                with socket.create_connection(place(server), 5.0) as client:
                    client.sendall(GET_ANGLES)
                    got = client.recv(1024)
            except ConnectionRefusedError:
                refused += 1
            except ConnectionResetError:
                pass  # it was let into the backlog in the very moment
            time.sleep(0.02)
        assert refused > 0
        assert got == ANGLES


def test_a_terminal_that_leads_nowhere_loses_everything_and_comes_back(plant):
    with serving(plant, "gone=0.05/0.3", pty=True) as server:
        line = os.open(device(server), os.O_RDWR | os.O_NOCTTY)
        try:
            os.write(line, GET_ANGLES)
            assert read(line) == ANGLES
            time.sleep(0.1)
            os.write(line, bytes.fromhex("FE FE 02 12 FA"))  # is_power_on: never answered
            time.sleep(0.4)
            os.write(line, GET_ANGLES)
            assert read(line) == ANGLES
        finally:
            os.close(line)


def wait_for_the_end(server):
    for thread in threading.enumerate():
        if thread.name == f"emulator {server.address}":
            thread.join(5.0)


@pytest.mark.parametrize("pty", [False, True])
def test_an_emulator_that_died_is_gone_without_a_word(plant, pty):
    with serving(plant, "die@0.05", pty=pty) as server:
        if pty:
            line = os.open(device(server), os.O_RDWR | os.O_NOCTTY)
            os.write(line, GET_ANGLES)
            assert read(line) == ANGLES
            wait_for_the_end(server)
            with pytest.raises(OSError, match=os.strerror(errno.EIO)):
                os.write(line, GET_ANGLES)
            os.close(line)
            return
        with socket.create_connection(place(server), 5.0) as client:
            client.sendall(GET_ANGLES)
            assert client.recv(1024) == ANGLES
            assert client.recv(1024) == b""
        wait_for_the_end(server)
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(place(server), 5.0)


def test_the_command_line_dies_hard_and_warns_of_other_machines():
    words = ["emulate", "--wear", "healthy", "--host", "0.0.0.0", "--port", "0", "--fault", "die@0.1,drop=0.5"]
    with subprocess.Popen([sys.executable, "-m", "rejoint", *words], stderr=subprocess.PIPE, text=True) as process:
        lines = [process.stderr.readline().strip() for _ in range(3)]
        port = int(lines[0].rpartition("tcp://0.0.0.0:")[2].split()[0])
        with socket.create_connection(("127.0.0.1", port), 5.0) as client:
            client.sendall(GET_ANGLES)
            with contextlib.suppress(ConnectionResetError):
                while client.recv(1024):
                    pass
        rest = process.communicate(timeout=20)[1]
    assert "Other machines can drive it too" in lines[1]
    assert lines[2] == "Faults: die@0.1,drop=0.5"
    assert (process.returncode, rest) == (1, "")


def test_an_address_beyond_loopback_is_known_as_such():
    assert not any(map(beyond_loopback, ("tcp://127.0.0.1:9000", "tcp://127.8.0.1:1", "serial:///dev/pts/3?baud=1")))
    assert all(map(beyond_loopback, ("tcp://0.0.0.0:9000", "tcp://192.168.1.20:9000")))
