"""Waiting for what another thread or process does."""

import time


def until(condition, patience=120.0):
    """Wait until the ``condition`` holds; the deadline is only there so that a failure ends."""
    deadline = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.01)
