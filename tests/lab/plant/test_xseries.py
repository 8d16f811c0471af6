"""The law of X servos against logs of a real XL330 that moved a pendulum (Rhoban/bam, Apache-2.0)."""

import json
import os
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from rejoint.arms import Arm, Box
from rejoint_lab.plant.plant import Truth, XPlant
from rejoint_lab.plant.wear import Wear
from rejoint_lab.plant.xseries import NEW

SHARED = Path(__file__).parents[3].parent / "shared" / "data" / "real" / "bam_xl330"
LOGS = sorted(Path(os.environ.get("REJOINT_BAM", SHARED)).glob("*.json"))
SERVO = "XL330-M288"


def pendulum(mass, length):
    end = np.eye(4)
    end[2, 3] = -length
    ends, one = np.array([-10.0]), np.ones(3)
    return Arm(
        name="pendulum", joint_names=("a",), offset=np.eye(4)[None], axis=np.array([[0.0, 1.0, 0.0]]), tip=end,
        lower=ends, upper=-ends, max_speed=-ends, mass=np.array([mass]), com=end[None, :3, 3],
        inertia=1e-6 * np.eye(3)[None], rest=np.zeros(1), targets=Box(lower=-one, upper=one), floor=-1.0,
        encoder_step=2 * np.pi / 4096, servos=(SERVO,),
    )  # fmt: skip


def wear():
    new = NEW[SERVO]
    known = dict.fromkeys(("damping_gain", "play", "ripple", "torque_noise"), 0.0)
    known |= {"position_gain": 0.6, "torque_limit": new["stall"], "link_stiffness": 100.0}
    known |= {"coulomb": new["coulomb"], "stiction": new["coulomb"], "load_friction": new["load_friction"]}
    known |= {"reflected_inertia": new["inertia"]}
    return Wear(name="bam", **{name: np.array([value]) for name, value in known.items()})


def predicted(log):
    """Measured and predicted angles [deg]."""
    rows = log["entries"]
    plant = XPlant(pendulum(log["mass"], log["length"]), [wear()], seed=0, truth=Truth())
    plant.settings["p"], plant.settings["voltage"], plant.settings["shutdown"] = log["kp"], log["vin"], 0
    plant.reset(np.array([[rows[0]["position"]]]))
    seen, start, passed = [rows[0]["position"]], rows[0]["timestamp"], 0
    for now, then in pairwise(rows):
        plant.status["goal"] = round(now["goal_position"] / plant.arm.encoder_step)
        plant.settings["torque_on"] = now["torque_enable"]
        steps = round(1e3 * (then["timestamp"] - start)) - passed
        plant.advance(1e-3 * steps)
        passed += steps
        seen.append(plant.encoder()[0, 0])
    return np.degrees([row["position"] for row in rows]), np.degrees(seen)


@pytest.mark.skipif(not LOGS, reason=f"no logs of a real XL330 in {SHARED}: set REJOINT_BAM to data/xl330 of BAM")
def test_a_new_servo_moves_as_a_real_one_did():
    errors = [np.abs(np.subtract(*predicted(json.loads(path.read_text())))) for path in LOGS]
    assert [error.mean() for error in errors] == pytest.approx([0.0] * len(errors), abs=7.0)
    assert np.concatenate(errors).mean() < 3.5
