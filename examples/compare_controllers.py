"""Train a policy for any worn arm of this kind, try it against classical controllers, and draw error over time."""

import argparse

import matplotlib.pyplot as plt
import numpy as np

import rejoint
from rejoint.arms import tcp_position

options = argparse.ArgumentParser(description=__doc__)
options.add_argument("--quick", action="store_true", help="train for seconds and try two targets; no result")
options.add_argument("--policy", help="policy file to try instead of training one")
options.add_argument("--out", default="controllers.png", help="figure to write")
chosen = options.parse_args()

arm = rejoint.load_arm("mycobot280")
policy = rejoint.Policy.load(chosen.policy) if chosen.policy else rejoint.train(arm=arm, quick=chosen.quick)
targets = [[0.17, 0.0, 0.20], [0.18, 0.03, 0.21]] if chosen.quick else None  # metres; None: ten are drawn
found = rejoint.compare(
    "emulated:worn", ["default", "integrator", policy], targets, plan=rejoint.TrialPlan(sets=1, repetitions=1)
)

figure, axis = plt.subplots()
for name in found.comparison.controllers:
    log = found.logs[f"hold-{name}-0-0"]
    error = np.linalg.norm(tcp_position(arm, log.position) - log.target, axis=1)
    axis.semilogy(log.time - log.time[0], 1e3 * error, label=name)
    settled = found.comparison.row(name).settled
    print(f"{name:12} settles at {1e3 * settled.mean.value:6.2f} mm")
axis.set(xlabel="time s", ylabel="encoder error mm")
axis.legend()
figure.savefig(chosen.out)
print("Recommended:", found.recommendation.controller)
print("Figure:", chosen.out)
