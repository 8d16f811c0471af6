"""Fit a digital twin to a worn arm, and draw how well it predicts motion, beside what was measured."""

import argparse

import matplotlib.pyplot as plt
import numpy as np

import rejoint

options = argparse.ArgumentParser(description=__doc__)
options.add_argument("--out", default="twin.png", help="figure to write")
chosen = options.parse_args()

found = rejoint.diagnose("emulated:worn")  # drives the arm; nothing is written
twin = rejoint.identify([found.excitation, found.targets])
low, high = twin.interval
for name, value, least, most in zip(
    twin.joint_names, twin.parameters.stiffness, low.stiffness, high.stiffness, strict=True
):
    print(f"{name}: stiffness {value:6.1f} N m/rad (95 %: {least:.1f} to {most:.1f})")

log = found.targets  # ten targets, which the fit has not seen
predicted = rejoint.replay(twin, log).positions[0]
figure, axes = plt.subplots(len(twin.joint_names), sharex=True, figsize=(8, 10))
for joint, axis in enumerate(axes):
    axis.plot(log.time, np.degrees(log.command[:, joint]), color="0.7", label="command")
    axis.plot(log.time, np.degrees(log.position[:, joint]), label="measured")
    axis.plot(log.time, np.degrees(predicted[:, joint]), "--", label="twin")
    axis.set_ylabel(f"{twin.joint_names[joint]} deg")
axes[0].legend(ncols=3)
axes[-1].set_xlabel("time s")
figure.savefig(chosen.out)
print("Figure:", chosen.out)
