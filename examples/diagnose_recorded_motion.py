"""Find out what is wrong with an arm from arrays in memory: time, commands and encoder readings of any motion.

Here an emulated worn arm makes the motion; arrays from anywhere else do as well.
"""

import argparse

import numpy as np

import rejoint

options = argparse.ArgumentParser(description=__doc__)
options.add_argument("--robot", default="emulated:worn", help="address of an emulated arm, such as emulated:healthy")
options.add_argument("--seconds", type=float, default=60.0, help="length of the motion")
chosen = options.parse_args()

robot = rejoint.open_robot(chosen.robot)
state, rest = robot.read(), robot.arm.rest
time, command, position = [], [], []
while state.time[0] < chosen.seconds:
    t = state.time[0]
    swing = np.sin(2 * np.pi * t / np.resize([11, 13, 17, 7, 9, 5], rest.size))  # each joint at its own pace
    goal = rest + 0.25 * swing * min(t / 3.0, 1.0)
    time.append(t)
    position.append(state.position[0])
    command.append(goal)
    state = robot.step(goal[None])
robot.close()

log = rejoint.RunLog.of(time, command, position, arm=robot.arm)
found = rejoint.diagnose(log, arm=robot.arm)
print(found.verdict)
print(f"\n{'joint':10} {'what':14} {'mm at the tool':>14}")
for finding in found.findings:
    print(f"{finding.joint:10} {finding.kind:14} {finding.tcp_mm:14.1f}")
