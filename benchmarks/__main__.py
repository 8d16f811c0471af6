"""`make bench`: every benchmark that needs no arguments, in one run. Ratios within a run count; machines differ.

`python -m benchmarks plant` runs one of the modules beside this one, `python -m benchmarks plant --help` lists options.
"""

import sys
from importlib import import_module
from pathlib import Path

import typer

BENCHMARKS = (
    "plant", "step", "control", "guard", "postures", "following", "training", "policy", "diagnosis",
    "identification", "truth", "emulator", "serve", "kills", "seeing", "feetech", "dynamixel", "moving", "shelf",
    "elimination", "payload", "years",
)  # fmt: skip
"""Modules beside this one; each has a `main`"""

name, *words = sys.argv[1:] or [""]
known = sorted({path.stem for path in Path(__file__).parent.glob("[a-z]*.py")} - {"frame", "virtual"})
if name and name not in known:
    sys.exit(f"no benchmark is called {name}; known: {', '.join(known)}")
for one in [name] if name else BENCHMARKS:
    print(f"\n== {one} ==", flush=True)
    app = typer.Typer(add_completion=False)
    app.command()(import_module(f"benchmarks.{one}").main)
    app(words, prog_name=f"python -m benchmarks {one}", standalone_mode=bool(name))
