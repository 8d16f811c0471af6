"""`make bench`: every benchmark that needs no arguments, in one run. Ratios within a run count; machines differ.

Run one of them alone with `python -m benchmarks plant`, with its options by `python -m benchmarks.plant --help`.
"""

import sys
from importlib import import_module

BENCHMARKS = (
    "plant", "step", "control", "guard", "postures", "following", "training", "rivals", "policy", "diagnosis",
    "identification", "truth", "emulator", "serve", "hostile", "kills", "seeing", "feetech", "moving", "shelf",
    "elimination", "payload", "years", "again",
)  # fmt: skip
"""Modules beside this one; each has a `main`"""

names = sys.argv[1:]
if unknown := {*names} - {*BENCHMARKS}:
    sys.exit(f"no benchmark is called {', '.join(sorted(unknown))}; known: {', '.join(BENCHMARKS)}")
for name in names or BENCHMARKS:
    print(f"\n== {name} ==")
    import_module(f"benchmarks.{name}").main()
