"""Where a server is, and waiting for what it does."""

import time


def place(server):
    host, port = server.address.removeprefix("tcp://").rsplit(":", 1)
    return host, int(port)


def until(condition, patience=10.0):
    """Wait for what another thread does; the deadline is only there so that a failure ends."""
    deadline = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.01)
