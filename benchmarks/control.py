"""What one control step of a deployed policy costs: observation, network, law and guard.

Beside it, in turns, as much plain arithmetic as takes the same time: its tail is the machine's own.
"""

import tempfile
import time
from pathlib import Path

import numpy as np

from rejoint.arms import mycobot280
from rejoint.control.controller import ControlInput
from rejoint.control.guard import GuardLimits, guard
from rejoint.control.policy import load_policy
from rejoint.control.robot import JointState
from rejoint.training.train import TrainingOptions, train

STEPS, WARM_UP = 5000, 100


def count(to: int) -> int:
    """Do plain arithmetic: nothing is allocated, nothing is looked up."""
    total = 0
    for number in range(to):
        total ^= number
    return total


def arithmetic(taken: float) -> int:
    """How far to `count` in ``taken`` [s]."""
    start = time.perf_counter()
    for _ in range(100):
        count(1000)
    return round(1000 * taken * 100 / (time.perf_counter() - start))


def main() -> None:
    arm = mycobot280()
    with tempfile.TemporaryDirectory() as folder:
        train(arm, None, out=Path(folder), options=TrainingOptions(iterations=1, agents=32, threads=1))
        policy = load_policy(Path(folder) / "policy.onnx", arm)
    limits, target = GuardLimits.of(arm), arm.targets.sample(np.random.default_rng(0), (1,))
    sent, speed = arm.rest[None], np.zeros((1, arm.joints))
    times, yardstick, far = [], [], 0
    for step in range(STEPS):
        state = JointState(time=np.array([0.025 * step]), position=sent, age=np.zeros(1))
        inputs = ControlInput(state=state, target=target, sent=sent, since_target=state.time)
        start = time.perf_counter()
        if step == 0:
            policy.reset(inputs, np.array([True]))
        sent, _, speed = guard(limits, policy.command(inputs), sent, speed, state, 0.025)
        times.append(time.perf_counter() - start)
        if step == WARM_UP:
            far = arithmetic(float(np.median(times)))
        start = time.perf_counter()
        count(far)
        yardstick.append(time.perf_counter() - start)
    for name, taken in {"one control step": times, "plain arithmetic": yardstick}.items():
        median, p99 = 1e6 * np.percentile(taken[WARM_UP + 1 :], [50, 99])
        print(f"{name}: median {median:.0f} us, p99 {p99:.0f} us")
