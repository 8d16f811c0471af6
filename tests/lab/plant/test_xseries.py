"""The law of X servos against logs of a real XL330 that moved a pendulum (Rhoban/bam, Apache-2.0)."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from benchmarks.dynamixel import SERVO, errors

from rejoint_lab.plant.xseries import NEW

SHARED = Path(__file__).parents[3].parent / "shared" / "data" / "real" / "bam_xl330"
LOGS = sorted(Path(os.environ.get("REJOINT_BAM", SHARED)).glob("*.json"))
FITTED = {
    "stall": 0.3711,
    "no_load": 11.65,
    "inertia": 0.001472,
    "coulomb": 0.004378,
    "viscous": 0.007681,
    "load_friction": 0.4117,
    "divisor": 208.7,
}
"""What `python -m benchmarks dynamixel LOGS` finds"""


def rms(servo):
    logs = [json.loads(path.read_text()) for path in LOGS]
    return [
        float(np.sqrt((one**2).mean())) for one in ([errors([log], [servo]) for log in logs] + [errors(logs, [servo])])
    ]


@pytest.mark.skipif(not LOGS, reason=f"no logs of a real XL330 in {SHARED}: set REJOINT_BAM to data/xl330 of BAM")
def test_a_servo_moves_as_a_real_one_did():
    *each, whole = rms(NEW[SERVO])
    assert whole < 5.5
    assert max(each) < 9.0
    assert rms(NEW[SERVO] | FITTED)[-1] < 2.7
