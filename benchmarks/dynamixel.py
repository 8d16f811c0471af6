"""What a control cycle of an arm of Dynamixel X servos costs: time on the bus, and time of the processor.

As `python -m benchmarks feetech`: the emulator runs in a process of its own, as slow as the wire and a USB adapter are;
the same bytes are exchanged in turn with the driver and without it.
"""

import os
import subprocess
import sys
import time
from contextlib import closing

import numpy as np

from benchmarks.feetech import PAUSE, exchange, timed
from rejoint.arms import load_arm
from rejoint.robots import place_of
from rejoint.robots.dynamixel.bus import BLOCK, DynamixelBus
from rejoint.robots.dynamixel.registers import TABLE
from rejoint_lab.emulator.dynamixel import BROADCAST, FAST_SYNC_READ, SYNC_WRITE, TURN, encode
from rejoint_lab.emulator.servobus import ADAPTER, BYTE, Packet

CYCLES = 1000
MOST = 1.1, 0.4
"""Times what the wire and the adapter take, and [ms] of the processor, at the median"""


def requests(ids, counts):
    """Return the two packets of a cycle that sends servos to ``counts``, and the size of the answer."""
    goals = b"".join(bytes([one]) + count.to_bytes(4, "little") for one, count in zip(ids, counts, strict=True))
    write = TABLE["goal"].address.to_bytes(2, "little") + (4).to_bytes(2, "little") + goals
    read = TABLE["load"].address.to_bytes(2, "little") + BLOCK.size.to_bytes(2, "little") + bytes(ids)
    packets = [Packet(BROADCAST, SYNC_WRITE, write), Packet(BROADCAST, FAST_SYNC_READ, read)]
    return (*map(encode, packets), 8 + len(ids) * (BLOCK.size + 4))


def measure(name):
    """Print what a cycle takes, with the driver and without."""
    command = [sys.executable, "-m", "rejoint", "emulate", "--arm", name, "--pty"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as emulator:
        try:
            address = next(word for line in emulator.stdout for word in line.split() if word.startswith("dynamixel:"))
            place = place_of(address)
            with closing(DynamixelBus(place.detail, load_arm(name))) as bus:
                bus.open()
                bus.prepare()
                rest, line = bus.read().position, os.open(place.detail.wire.device, os.O_RDWR | os.O_NOCTTY)
                request = requests(bus.ids, bus.zeros.counts(rest[bus.joint]))
                taken = np.empty((CYCLES, 2, 2))
                for driven, bare in taken:
                    time.sleep(PAUSE)
                    driven[:] = timed(lambda: (bus.send(rest), bus.read()))
                    time.sleep(PAUSE)
                    bare[:] = timed(lambda: exchange(line, *request))
                os.close(line)
        finally:
            emulator.terminate()
    write, read, size = request
    least = 1e3 * ((len(write) + len(read) + size) * BYTE + TURN + ADAPTER)
    print(f"{name}, {len(bus.ids)} servos: {least:.2f} ms on the wire and in the adapter at least")
    for what, column, most in (("bus", 0, MOST[0] * least), ("processor", 1, MOST[1])):
        for who, times in (("driver", taken[:, 0, column]), ("without", taken[:, 1, column])):
            shown = ", ".join(f"p{share} {1e3 * np.percentile(times, share):.2f}" for share in (10, 50, 90, 99))
            print(f"{what:10s} {who:8s} {shown} ms" + f" (at most {most:.2f} ms is asked for)" * (who == "driver"))


def main():
    """Measure control cycles of a Koch and a WidowX."""
    for name in ("koch", "wx250s"):
        measure(name)
