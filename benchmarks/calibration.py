"""How bad the simulated arms are: the table that the wear profiles were calibrated with.

    python -m benchmarks.calibration [--sets 12] [--seed 0] [--wear worn --wear healthy ...]

Each arm goes to ten targets in sequence, 20 s each, as in section IV of Park et al. 2024. "hold"
stays at every target; its settled error is the mean of the last second. "cross" goes on at the first
error below 10 mm, as the paper does; its error is read there or at the time-out. The control laws
here are short and without a guard, so that the plant is judged and not the controllers.
"""

from __future__ import annotations

import argparse
import time as clock
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from rejoint.arms import Arm, Array, clip_norm, dls, frames, load_arm, position_jacobian, solve_position, tcp_position
from rejoint.plant.wear import load_wear, wear_names
from rejoint.robots.emulated import EmulatedRobot

DWELL = 20.0
REACHED = 0.010
TARGETS = 10


@dataclass(kw_only=True)
class Memory:
    """What the laws remember; arrays are (B, n) [rad]."""

    wanted: Array
    command: Array
    total: Array
    before: Array
    period: Array
    fresh: Array


Law = Callable[[Arm, Memory, Array, Array], Array]


def default(arm: Arm, memory: Memory, position: Array, target: Array) -> Array:
    """Send the inverse-kinematics solution and trust the servos."""
    return memory.wanted


def pid(arm: Arm, memory: Memory, position: Array, target: Array) -> Array:
    """Equation 27 of the paper with the integral as a plain sum."""
    e = memory.wanted - position
    memory.before = np.where(memory.fresh[:, None], e, memory.before)
    memory.total = memory.total + e
    rate = (e - memory.before) / memory.period[:, None]
    memory.before = e
    return np.clip(position + 0.40 * e + 0.01 * memory.total + 0.005 * rate, arm.lower, arm.upper)


def integrator(arm: Arm, memory: Memory, position: Array, target: Array) -> Array:
    """Damped least squares on the last command, gain 0.1, anti-windup 15 degrees."""
    f = frames(arm, position)
    step = clip_norm(dls(position_jacobian(arm, f), target - f.tcp_position), np.radians(5.0))
    lead = np.radians(15.0)
    command = np.clip(memory.command + 0.1 * step, position - lead, position + lead)
    return np.clip(command, arm.lower, arm.upper)


LAWS: dict[str, tuple[Law, bool]] = {
    "default, hold": (default, False),
    "PID, cross": (pid, True),
    "PID, hold": (pid, False),
    "integrator, hold": (integrator, False),
}


@dataclass(kw_only=True)
class Result:
    """Ten targets of each of B arms; arrays are (B, 10)."""

    reached: Array
    first: Array = field(repr=False)
    settled: Array
    true: Array
    duration: Array


def drive(robot: EmulatedRobot, law: Law, targets: Array, stop: bool) -> Result:
    """Run one law on all arms; ``targets`` (B, 10, 3) [m]."""
    arm, count = robot.arm, robot.count
    state, every = robot.read(), np.arange(robot.count)
    zero = np.zeros_like(state.position)
    memory = Memory(
        wanted=state.position, command=state.position, total=zero, before=zero,
        period=np.full(count, 0.025), fresh=np.ones(count, bool),
    )  # fmt: skip
    index, begun, active = np.zeros(count, int), state.time.copy(), np.ones(count, bool)
    shape = targets.shape[:2]
    result = Result(
        reached=np.zeros(shape, bool), first=np.full(shape, np.nan), settled=np.zeros(shape), true=np.zeros(shape),
        duration=np.zeros(shape),
    )  # fmt: skip
    sums, samples = np.zeros((2, count)), np.zeros(count)
    while active.any():
        goal = targets[every, np.minimum(index, TARGETS - 1)]
        if memory.fresh.any():
            solved = solve_position(arm, goal, memory.wanted).q
            memory.wanted = np.where(memory.fresh[:, None], solved, memory.wanted)
            memory.total = np.where(memory.fresh[:, None], 0.0, memory.total)
        memory.command = np.where(active[:, None], law(arm, memory, state.position, goal), memory.command)
        old, state = state, robot.step(memory.command, active)
        memory.period = np.where(active, state.time - old.time, memory.period)
        error = np.linalg.norm(tcp_position(arm, state.position) - goal, axis=-1)
        off = np.linalg.norm(robot.true_tcp() - goal, axis=-1)
        since = state.time - begun
        crossing = active & (error < REACHED)
        k = np.minimum(index, TARGETS - 1)
        new = crossing & ~result.reached[every, k]
        result.reached[every[new], k[new]] = True
        result.first[every[new], k[new]] = since[new]
        late = active & (since > DWELL - 1.0)
        sums += late * np.stack([error, off])
        samples += late
        over = active & ((since >= DWELL) | (stop & crossing))
        done = every[over], k[over]
        many = np.maximum(samples[over], 1)
        result.settled[done] = np.where(crossing[over] & stop, error[over], sums[0, over] / many)
        result.true[done] = np.where(crossing[over] & stop, off[over], sums[1, over] / many)
        result.duration[done] = since[over]
        sums[:, over], samples[over] = 0.0, 0.0
        index, begun, memory.fresh = index + over, np.where(over, state.time, begun), over
        active = index < TARGETS
    return result


def describe(result: Result) -> str:
    """One row of the table."""
    per_set = 100 * result.reached.mean(axis=1)
    return (
        f"{100 * result.reached.mean():5.1f} ({per_set.min():3.0f}-{per_set.max():3.0f})"
        f" | {1e3 * result.settled.mean():5.1f} +- {1e3 * result.settled.std():4.1f}"
        f" | {1e3 * result.settled.mean(axis=1).min():4.1f}-{1e3 * result.settled.mean(axis=1).max():4.1f}"
        f" | {1e3 * result.true.mean():5.1f} | {result.duration.sum(axis=1).mean():6.1f}"
        f" | {np.nanmedian(result.first) if result.reached.any() else np.nan:5.2f}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Print how bad the simulated arms are.")
    parser.add_argument("--sets", type=int, default=12, help="target sets, each on an arm of its own")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--wear", action="append", help="wear profile; may be repeated")
    parser.add_argument("--law", action="append", help=f"part of one of: {', '.join(LAWS)}")
    options = parser.parse_args()
    arm = load_arm("mycobot280")
    targets = arm.targets.sample(np.random.default_rng(options.seed), (options.sets, TARGETS))
    print(
        "profile        law               | <10 mm % (sets) | settled mm    | per set   | true mm | cycle s | first s"
    )
    for name in options.wear or wear_names():
        for label, (law, stop) in LAWS.items():
            if options.law and not any(part in label for part in options.law):
                continue
            begun = clock.perf_counter()
            robot = EmulatedRobot(arm, [load_wear(name, arm)] * options.sets, seed=options.seed)
            result = drive(robot, law, targets, stop)
            speed = result.duration.sum() / (clock.perf_counter() - begun)
            print(f"{name:14} {label:17} | {describe(result)} | {speed:.0f}x real time", flush=True)


if __name__ == "__main__":
    main()
