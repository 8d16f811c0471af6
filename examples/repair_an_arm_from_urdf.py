"""Repair a worn arm that only its URDF file describes, and draw its error at every target, before and after.

For example: `python examples/repair_an_arm_from_urdf.py ur5e.urdf --base base_link --tip tool0`.
"""

import argparse

import matplotlib.pyplot as plt
import numpy as np

import rejoint

options = argparse.ArgumentParser(description=__doc__)
options.add_argument("urdf", help="URDF or MJCF file")
options.add_argument("--base", help="body at which the arm begins; by default the root")
options.add_argument("--tip", help="body at which the arm ends")
options.add_argument("--run", help="run folder; by default a new one below runs/")
options.add_argument("--out", default="urdf.png", help="figure to write")
options.add_argument("--quick", action="store_true", help="do little of everything; no result")
chosen = options.parse_args()

arm = rejoint.load_arm(chosen.urdf, base=chosen.base, tip=chosen.tip)
result = rejoint.repair("emulated:worn", arm=arm, run=chosen.run, quick=chosen.quick)
print(result.diagnosis.verdict)
best = result.recommendation.controller
print("Use:", best)

figure, axis = plt.subplots()
for name, label in (("default", "before"), (best, f"after, with {best}")):
    settled = 1e3 * result.comparison.array("settled", name).mean(axis=(0, 1))
    axis.bar(np.arange(len(settled)) + (0.4 if name == best else 0.0), settled, width=0.4, label=label)
axis.set(xlabel="target", ylabel="settled encoder error mm")
axis.legend()
figure.savefig(chosen.out)
print("Figure:", chosen.out)
