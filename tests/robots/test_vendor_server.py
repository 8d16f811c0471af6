"""The driver through a relay that behaves as the vendor's server on the robot does, on the emulated arm.

Source: ``demo/Server_280.py`` in elephantrobotics/pymycobot. It hands whatever one ``recv`` returned to
the serial port, waits up to 0.5 s for one frame, and drops an answer that equals its request.
"""

import os
import select
import socket
import sys
import threading
import time
from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest

from emulatedservers import serve_pty
from rejoint.arms import mycobot280
from rejoint.robots import open_robot
from rejoint.robots.mycobot.bus import MyCobot280Socket
from rejoint.robots.mycobot.wire import FORMAT, encode
from rejoint.robots.wireserver import Finder
from rejoint_lab.emulator.firmware import Firmware

pytestmark = pytest.mark.realtime

TIMEOUT = 0.5


class Relay:
    """TCP on one side, the emulator's terminal on the other; one client at a time, one answer per command."""

    def __init__(self, device):
        self.port = os.open(device, os.O_RDWR | os.O_NOCTTY)
        self.listener = socket.create_server(("127.0.0.1", 0), backlog=1)
        self.address = f"tcp://127.0.0.1:{self.listener.getsockname()[1]}"
        self.swallowed, self.clients = 0, 0
        self.open = True
        self.thread = threading.Thread(target=self.serve, daemon=True)
        self.thread.start()

    def serve(self):
        while self.open:
            with suppress(OSError):
                connection, _ = self.listener.accept()
                self.clients += 1
                with connection:
                    while command := connection.recv(1024):
                        self.relay(connection, command)

    def relay(self, connection, command):
        os.write(self.port, command)
        decoder, deadline = Finder(FORMAT), time.monotonic() + TIMEOUT
        while (left := deadline - time.monotonic()) > 0:
            if select.select([self.port], [], [], left)[0]:
                for frame in decoder.feed(os.read(self.port, 100)):
                    if encode(frame) != command:
                        connection.sendall(encode(frame))
                        return
                    self.swallowed += 1

    def close(self):
        self.open = False
        self.listener.shutdown(socket.SHUT_RDWR)
        self.listener.close()
        self.thread.join()
        os.close(self.port)


@pytest.fixture
def relay(monkeypatch):
    client_module = sys.modules[MyCobot280Socket.__module__]
    monkeypatch.setattr(client_module, "time", SimpleNamespace(sleep=lambda _: None))  # 1.5 s in its constructor
    firmware = Firmware.build(mycobot280(), "worn")
    with serve_pty(firmware) as server:
        running = Relay(server.address.removeprefix("serial://").partition("?")[0])
        yield running
        running.close()
    assert firmware.fresh


def test_the_driver_works_through_the_vendors_server(relay):
    """The acknowledgement of set_fresh_mode(1) never arrives, and no later answer is taken for another."""
    robot = open_robot(relay.address)
    assert relay.swallowed == 3  # the client sent it three times
    state = robot.read()
    start, times = state.position, [state.time[0]]
    for k in range(20):
        state = robot.step(start + np.array([[0.01 * k, 0, 0, 0, 0, 0]]))
        times.append(state.time[0])
    robot.stop()
    robot.close()
    assert np.all(np.diff(times) > 0)
    assert relay.clients == 2  # the driver's probe and the client: it never had to connect again
    assert state.position[0, 0] - start[0, 0] == pytest.approx(0.17, abs=0.08)
    assert np.all(state.temperature < 60)
