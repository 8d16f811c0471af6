"""What one control step of a deployed policy costs: observation, network, law and guard."""

import tempfile
import time
from pathlib import Path

import numpy as np

from rejoint.arms import mycobot280
from rejoint.control.controller import Situation
from rejoint.control.guard import GuardLimits, guard
from rejoint.control.policy import load_policy
from rejoint.control.robot import JointState
from rejoint.training.train import TrainingOptions, train

STEPS = 5000


def main() -> None:
    arm = mycobot280()
    with tempfile.TemporaryDirectory() as folder:
        train(arm, None, out=Path(folder), options=TrainingOptions(iterations=1, agents=32, threads=1))
        policy = load_policy(Path(folder) / "policy.onnx", arm)
    limits, target = GuardLimits.of(arm), arm.targets.sample(np.random.default_rng(0), (1,))
    sent = arm.rest[None]
    times = []  # by the wall clock, and of the processor, which other programs do not prolong
    for step in range(STEPS):
        state = JointState(time=np.array([0.025 * step]), position=sent, age=np.zeros(1))
        situation = Situation(state=state, target=target, sent=sent, since_target=state.time)
        start = time.perf_counter(), time.thread_time()
        if step == 0:
            policy.reset(situation, np.array([True]))
        sent = guard(limits, policy.command(situation), sent, state, 0.025).command
        times.append((time.perf_counter() - start[0], time.thread_time() - start[1]))
    for clock, taken in zip(("wall clock", "processor time"), 1e6 * np.array(times[100:]).T, strict=True):
        median, p99 = np.percentile(taken, [50, 99])
        print(f"one control step, {clock}: median {median:.0f} us, p99 {p99:.0f} us")
