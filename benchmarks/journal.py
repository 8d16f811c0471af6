"""What the journal costs a control cycle, also on a disk that another process keeps busy with large files.

Beside it, in turns, as much plain arithmetic as takes about the same time: its tail is the machine's own.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from benchmarks.control import arithmetic, count
from rejoint.logs.journal import Journal

CYCLES, PERIOD = 2000, 0.005
BUSY = """
import os, sys
while True:
    with open(sys.argv[1], "wb") as file:
        file.write(bytes(20_000_000))
        os.fsync(file.fileno())
"""


def rows(folder: Path) -> tuple[list[float], list[float]]:
    """Return the times [s] that rows of a journal take, and plain arithmetic in turns with them."""
    joints = tuple(f"joint{k}" for k in range(1, 7))
    journal = Journal.begin(folder / "a.parquet", arm="a", joint_names=joints, robot="r", label="l", rows=CYCLES)
    cycle = SimpleNamespace(
        position=np.zeros((1, 6)), command=np.zeros((1, 6)), target=np.zeros((1, 3)), true_tcp=np.zeros((1, 3))
    )
    taken, yardstick, far = [], [], arithmetic(30e-6)
    for k in range(CYCLES):
        cycle.time = np.array([k * PERIOD])
        start = time.perf_counter()
        journal.see(cycle)
        taken.append(time.perf_counter() - start)
        start = time.perf_counter()
        count(far)
        yardstick.append(time.perf_counter() - start)
        time.sleep(PERIOD)
    journal.discard()
    return taken, yardstick


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        for disk in ("idle", "busy"):
            other = None
            if disk == "busy":
                other = subprocess.Popen([sys.executable, "-c", BUSY, str(Path(name) / "large")])
            try:
                times = rows(Path(name))
            finally:
                if other is not None:
                    other.kill()
                    other.wait()
            for what, taken in zip(("a row of the journal", "plain arithmetic"), times, strict=True):
                median, p99, most = 1e6 * np.percentile(taken, [50, 99, 100])
                print(f"{disk} disk, {what}: median {median:.0f} us, p99 {p99:.0f} us, most {most:.0f} us")
