"""How often a verdict names the joint that rings most, and how often it names one on a healthy arm."""

from dataclasses import replace

import numpy as np

from rejoint.arms import mycobot280
from rejoint.diagnosis.diagnosis import judge, ringing_most
from rejoint.diagnosis.excitation import record
from rejoint.diagnosis.healthy import load_healthy
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import Wear, load_wear

HEALTHY = tuple(range(60))
WORN = tuple(range(1, 6))
DAMPING = 0.3
"""of what the worn arm has, in the joint that is to ring"""


def main() -> None:
    arm, healthy = mycobot280(), load_healthy(mycobot280())
    good = [load_wear(f"healthy?seed={seed}", arm) for seed in HEALTHY]
    bad = [
        (joint, _ringing(load_wear(f"worn?seed={seed}", arm), joint)) for seed in WORN for joint in range(arm.joints)
    ]
    robot = EmulatedRobot(arm, [*good, *(wear for _, wear in bad)], seed=4, address="emulated:mixed", threads=2)
    verdicts = [judge(arm, logs, healthy) for logs in record(robot, seed=9)]
    false = sum("rings" in verdict.verdict for verdict in verdicts[: len(good)])
    print(f"healthy arms said to have a joint that rings: {false} of {len(good)}")
    found = named = 0
    for (joint, _), diagnosis in zip(bad, verdicts[len(good) :], strict=True):
        most = ringing_most(diagnosis.findings)
        found += any(f.kind == "low_damping" and f.joint == arm.joint_names[joint] for f in diagnosis.findings)
        words = () if most is None else (f"{most.joint} rings", f"{most.joint} is badly damped")
        named += any(part in diagnosis.verdict for part in words)
    print(
        f"worn arms with {DAMPING:g} of the damping in one joint: found in {found} of {len(bad)}, "
        f"the joint that rings most named in {named}"
    )


def _ringing(wear: Wear, joint: int) -> Wear:
    damping = np.array(wear.damping_gain)
    damping[joint] *= DAMPING
    return replace(wear, damping_gain=damping)
