"""An emulator that strangers may talk to: fuzzed requests, floods, connections dropped, and no rest."""

import gc
import socket
import threading
import tracemalloc

import numpy as np
import pytest
from benchmarks.emulator import GET_ANGLES, descriptors, drop_connections, fuzz
from reaching import place

from emulatedservers import serve_tcp
from rejoint.arms import mycobot280
from rejoint.robots.mycobot.motion import MAX_QUEUE
from rejoint.robots.mycobot.wire import Frame, answer, encode, pack_angles
from rejoint_lab.emulator.firmware import MAX_WRITES
from waiting import until

pytestmark = pytest.mark.realtime

ARM = mycobot280()
AT_ONCE = {"state": 0.0, "acknowledgement": 0.0}


def test_fuzzed_frames_never_raise_and_leave_a_posture(worn):
    """The worn arm behind damaged streams; a million frames are in `make bench`."""
    ends = fuzz(worn, 20_000, seed=11)
    assert ends["answered"] > 14_000
    assert ends["ignored"] > 1_000
    worn.power(True)
    worn.calibrate(0)
    assert answer(worn, Frame(0x20)).payload


def test_orders_that_nobody_waits_for_fill_no_queue_without_end(firmware):
    move = Frame(0x22, pack_angles(ARM.rest + 0.1) + b"\x64")
    for fresh in (0, 1):
        answer(firmware, Frame(0x16, bytes((fresh,))))
        taken = [answer(firmware, move).payload for _ in range(1000)]
        assert taken.count(b"\x00") == (0 if fresh else 1000 - MAX_QUEUE - 1)
    assert len(firmware.outbox) == MAX_WRITES
    firmware.advance(2.0)
    np.testing.assert_allclose(firmware.angles, ARM.rest + 0.1, atol=2e-4)  # the newest counts


def test_connections_opened_and_dropped_leave_nothing_behind(firmware):
    with serve_tcp(firmware, timing=AT_ONCE) as server:
        files, threads = descriptors(), threading.active_count()
        drop_connections(server, 300, seed=1)
        until(lambda: descriptors() == files)
        assert threading.active_count() == threads


def test_garbage_without_end_takes_no_memory_and_no_time_from_the_arm(firmware):
    noise = np.random.default_rng(5).bytes(50_000)
    with serve_tcp(firmware, timing=AT_ONCE) as server, socket.create_connection(place(server), 10.0) as client:
        client.sendall(noise)
        tracemalloc.start()
        try:
            for _ in range(20):
                client.sendall(noise)
            gc.collect()
            assert tracemalloc.get_traced_memory()[1] < 500_000  # a megabyte was sent
        finally:
            tracemalloc.stop()
        before = firmware.plant.time[0]
        until(lambda: firmware.plant.time[0] > before)
        client.sendall(bytes(40) + GET_ANGLES)  # as long as any frame that the noise may have begun
        until(lambda: b"\xfe\xfe\x0e\x20" in client.recv(65536))


def test_a_client_that_never_reads_makes_room_for_the_next(firmware):
    with serve_tcp(firmware, timing=AT_ONCE) as server, socket.socket() as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.connect(place(server))
        deaf.setblocking(False)
        until(lambda: not sent(deaf, GET_ANGLES * 200))
        with socket.create_connection(place(server), 20.0) as client:
            client.sendall(GET_ANGLES)
            assert client.recv(1024)[:4] == b"\xfe\xfe\x0e\x20"


def sent(client, data):
    """How much of it could be sent; nothing when the buffers are full or the server has given up."""
    try:
        return client.send(data)
    except OSError:
        return 0


def test_what_two_clients_write_is_never_mixed(firmware):
    with (
        serve_tcp(firmware, timing=AT_ONCE) as server,
        socket.create_connection(place(server), 10.0) as first,
        socket.create_connection(place(server), 10.0) as second,
    ):
        first.sendall(encode(Frame(0x12)) + GET_ANGLES[:3])
        assert first.recv(1024)[3] == 0x12
        second.sendall(GET_ANGLES[3:] + GET_ANGLES)
        first.sendall(bytes.fromhex("51 FA"))  # not the rest that the second one has sent
        assert first.recv(1024)[3] == 0x51
        first.close()
        assert second.recv(1024)[:4] == b"\xfe\xfe\x0e\x20"
