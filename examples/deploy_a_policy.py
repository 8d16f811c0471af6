"""Drive an arm to targets with a policy file, or another controller, and list what became of each target."""

import argparse

import rejoint

options = argparse.ArgumentParser(description=__doc__)
options.add_argument("controller", nargs="?", default="integrator", help="policy file (.onnx), or a baseline's name")
options.add_argument("--robot", default="emulated:worn", help="address of the robot")
options.add_argument("--dwell", type=float, default=4.0, help="seconds per target")
chosen = options.parse_args()

targets = [[0.17, 0.00, 0.20], [0.18, 0.03, 0.21], [0.16, -0.05, 0.18]]  # metres
done = rejoint.deploy(
    chosen.robot, targets, settings=rejoint.Settings(controller=chosen.controller, dwell=chosen.dwell)
)
for visit in done.visits:
    x, y, z = (1e3 * value for value in visit.target)
    said = "reached" if visit.reached else f"missed: {visit.remark}"
    print(f"({x:4.0f}, {y:4.0f}, {z:4.0f}) mm: {1e3 * visit.error:5.2f} mm off, {said}")
print(f"{len(done.visits) - len(done.missed)} of {len(done.visits)} targets reached")
