"""What one control step of a deployed policy costs: observation, network, law and guard."""

import time

import numpy as np

from rejoint.arms import mycobot280
from rejoint.arms.postures import find_postures
from rejoint.control.controllers.catalogue import shelf_controller
from rejoint.control.guard import GuardLimits, guard
from rejoint.control.robot import ControlInput, JointState

STEPS, WARM_UP = 5000, 100


def main() -> None:
    arm = mycobot280()
    policy, limits = shelf_controller(arm), GuardLimits.of(arm)
    target = arm.targets.sample(np.random.default_rng(0), (1,))
    goal = find_postures(arm, target, arm.rest[None], None)
    sent, speed = arm.rest[None], np.zeros((1, arm.joints))
    times = []
    for step in range(STEPS):
        state = JointState(time=np.array([0.025 * step]), position=sent, age=np.zeros(1))
        inputs = ControlInput(state=state, target=target, goal=goal, sent=sent, since_target=state.time)
        start = time.perf_counter()
        if step == 0:
            policy.reset(inputs, np.array([True]))
        sent, _, speed = guard(limits, policy.command(inputs), sent, speed, state, 0.025)
        times.append(time.perf_counter() - start)
    median, p99 = 1e6 * np.percentile(times[WARM_UP:], [50, 99])
    print(f"one control step: median {median:.0f} us, p99 {p99:.0f} us")
