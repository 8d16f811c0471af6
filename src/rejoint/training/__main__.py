"""Train the generic policy of a catalogue arm again: ``python -m rejoint.training mycobot280``."""

from __future__ import annotations

import sys

from rejoint.control.controllers.catalogue import shelf_path
from rejoint.training.shelf import make_shelf_policy

if __name__ == "__main__":
    name = sys.argv[1] if len(sys.argv) > 1 else "mycobot280"
    make_shelf_policy(name, shelf_path(name))
