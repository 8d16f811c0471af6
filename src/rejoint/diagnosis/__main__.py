"""Measure a catalogue arm's healthy reference: ``python -m rejoint.diagnosis mycobot280``."""

from __future__ import annotations

import sys

from rejoint.arms import load_arm
from rejoint.diagnosis.healthy import AS_SOLD, MEASURED, NEW, measure_healthy, reference_path
from rejoint.system.files import write_json

if __name__ == "__main__":
    arm = load_arm(sys.argv[1] if len(sys.argv) > 1 else "mycobot280")
    for p in MEASURED if arm.name in NEW else (AS_SOLD,):
        write_json(reference_path(arm, p), measure_healthy(arm, p=p))
