"""What a control cycle of an SO-101 costs: time on the bus, and time of the processor, at the emulated bus.

The emulator runs in a process of its own, on a pseudo-terminal, as slow as the wire and a USB adapter are.
"""

import subprocess
import sys
import time
from contextlib import closing

import numpy as np

from rejoint.robots import place_of
from rejoint.robots.feetech.bus import FeetechBus
from rejoint.system.errors import NoReplyError

CYCLES = 2000
BUS, PROCESSOR = 3.0, 0.3
"""[ms] that a cycle should take at most, at the 99th percentile"""


def cycles(bus, count=CYCLES):
    """Return times [s] on the bus and of the processor (count, 2) of a synchronous write and read, NaN for none."""
    rest = bus.read().position
    taken = np.empty((count, 2))
    for k in range(count):
        goal = rest + 0.05 * np.sin(k / 20)
        began, worked = time.perf_counter(), time.thread_time()
        bus.send(goal)
        try:
            bus.read()
            taken[k] = time.perf_counter() - began, time.thread_time() - worked
        except (TimeoutError, NoReplyError):  # a busy machine: the emulator was late
            taken[k] = np.nan
            bus.resynchronise(time.monotonic() + 1.0)
        time.sleep(0.005)
    return taken


def system_calls(count=CYCLES):
    """Return times [s] of the processor (count,) in two writes and two waits at a terminal, which any driver needs."""
    import os
    import pty
    import select
    import tty

    own, client = pty.openpty()
    tty.setraw(client)
    taken = np.empty(count)
    for k in range(count):
        began = time.thread_time()
        for _ in range(2):
            os.write(client, b"x" * 16)
        select.select([client], [], [], 0.0)
        taken[k] = time.thread_time() - began
        os.read(own, 4096)
    os.close(own)
    os.close(client)
    return taken


def main():
    command = [sys.executable, "-m", "rejoint", "emulate", "--arm", "so101", "--pty"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as emulator:
        try:
            address = next(word for line in emulator.stdout for word in line.split() if word.startswith("feetech:"))
            place = place_of(address)
            with closing(FeetechBus(place.detail, _arm())) as bus:
                bus.open()
                bus.prepare()
                taken = 1e3 * cycles(bus)
        finally:
            emulator.terminate()
    for name, column, most in (("bus", 0, BUS), ("processor", 1, PROCESSOR)):
        middle, high = np.nanpercentile(taken[:, column], [50, 99])
        print(f"{name:10s} median {middle:.2f} ms, p99 {high:.2f} ms (at most {most} ms is asked for)")
    least = 1e3 * np.percentile(system_calls(), [50, 99])
    print(f"{'system':10s} median {least[0]:.2f} ms, p99 {least[1]:.2f} ms: two writes and a look at a terminal alone")
    print(f"late answers: {np.isnan(taken[:, 0]).sum()} of {len(taken)}")


def _arm():
    from rejoint.arms import load_arm

    return load_arm("so101")
