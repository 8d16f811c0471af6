"""What the journal costs a control cycle, on a disk that is busy with large files meanwhile."""

import os
import tempfile
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from rejoint.journal import Journal

CYCLES, PERIOD = 2000, 0.005


def keep_busy(path: Path, over: threading.Event) -> None:
    """Write and sync a large file again and again."""
    content = bytes(20_000_000)
    while not over.is_set():
        with path.open("wb") as file:
            file.write(content)
            os.fsync(file.fileno())


def main() -> None:
    joints = tuple(f"joint{k}" for k in range(1, 7))
    for what in ("an idle disk", "a busy disk"):
        with tempfile.TemporaryDirectory() as folder:
            over = threading.Event()
            other = threading.Thread(target=keep_busy, args=(Path(folder) / "large", over))
            if what == "a busy disk":
                other.start()
            journal = Journal.begin(Path(folder) / "a.parquet", arm="a", joint_names=joints, robot="r", label="l")
            cycle = SimpleNamespace(
                position=np.zeros((1, 6)), command=np.zeros((1, 6)), target=np.zeros((1, 3)), true_tcp=np.zeros((1, 3))
            )
            taken = []
            for k in range(CYCLES):
                cycle.time = np.array([k * PERIOD])
                start = time.perf_counter()
                journal.see(cycle)
                taken.append(time.perf_counter() - start)
                time.sleep(PERIOD)
            over.set()
            if other.is_alive():
                other.join()
            journal.discard()
        median, p99, most = 1e6 * np.percentile(taken, [50, 99, 100])
        print(f"a row of the journal, {what}: median {median:.0f} us, p99 {p99:.0f} us, largest {most:.0f} us")
