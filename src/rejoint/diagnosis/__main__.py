"""Measure the healthy reference of an arm of the catalogue again: ``python -m rejoint.diagnosis mycobot280``."""

from __future__ import annotations

import sys

from rejoint.arms import load_arm
from rejoint.diagnosis.healthy import measure_healthy, reference_path
from rejoint.system.files import write_json

if __name__ == "__main__":
    arm = load_arm(sys.argv[1] if len(sys.argv) > 1 else "mycobot280")
    write_json(reference_path(arm), measure_healthy(arm))
