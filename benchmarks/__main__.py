"""`make bench`: every benchmark in one run. Ratios within a run are what counts; machines differ.

Run one of them alone with `python -m benchmarks plant`. Identification takes the logs of a real SO-101 with
`--logs FOLDER` (or `make bench LOGS=FOLDER`, or the environment variable REJOINT_SO101), else an emulated one's.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

from benchmarks import agents, control, following, identification, plant, policy, rivals, training

BENCHMARKS: dict[str, Callable[[Path | None], None]] = {
    "plant": lambda _logs: plant.main(),
    "control": lambda _logs: control.main(),
    "following": lambda _logs: following.main(),
    "training": lambda _logs: training.main(),
    "rivals": lambda _logs: rivals.main(),
    "agents": lambda _logs: agents.main(),
    "policy": lambda _logs: policy.main(),
    "identification": identification.bench,
}


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
        BENCHMARKS[name](options.logs)


main()
