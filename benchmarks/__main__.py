"""`make bench`: every benchmark in one run. Ratios within a run are what counts; machines differ.

Run one of them alone with `python -m benchmarks plant`. Identification takes the logs of a real SO-101 with
`--logs FOLDER` (or `make bench LOGS=FOLDER`, or the environment variable REJOINT_SO101), else an emulated one's.
"""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path

BENCHMARKS = (
    "plant", "step", "gpu", "control", "guard", "following", "training", "rivals", "agents", "policy", "diagnosis",
    "identification", "truth", "emulator", "serve", "hostile", "journal", "kills", "family", "seeing", "feetech",
    "moving", "shelf", "racing", "payload", "posing", "years", "again", "history", "fleet", "live",
)  # fmt: skip
"""Modules beside this one; each has a `main`, that of `identification` takes a folder of logs."""


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Speeds, side by side in one run.")
    parser.add_argument("names", nargs="*", help=f"which to run, all by default: {', '.join(BENCHMARKS)}")
    parser.add_argument("--logs", type=Path, help="folder of a real SO-101's SAGE motions; by default emulated ones")
    options = parser.parse_args()
    unknown = set(options.names) - set(BENCHMARKS)
    if unknown:
        parser.error(f"no benchmark is called {', '.join(sorted(unknown))}; known: {', '.join(BENCHMARKS)}")
    for name in options.names or BENCHMARKS:
        print(f"\n== {name} ==")
        module = import_module(f"benchmarks.{name}")
        if name == "identification":
            module.bench(options.logs)
        else:
            module.main()


main()
