"""`make bench`: every benchmark in one run. Ratios within a run are what counts; machines differ.

Run one of them alone with `python -m benchmarks plant`.
"""

import sys
from collections.abc import Callable

from benchmarks import control, plant, training

BENCHMARKS: dict[str, Callable[[], None]] = {"plant": plant.main, "control": control.main, "training": training.main}


def main() -> None:
    names = sys.argv[1:] or list(BENCHMARKS)
    unknown = set(names) - set(BENCHMARKS)
    if unknown:
        sys.exit(f"no benchmark is called {', '.join(sorted(unknown))}; known: {', '.join(BENCHMARKS)}")
    for name in names:
        print(f"\n== {name} ==")
        BENCHMARKS[name]()


main()
