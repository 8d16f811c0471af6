"""What the guard costs one arm, and whether its laws hold in millions of cases.

The laws, and a geometry of their own, are those of the tests (tests/control/guard_laws.py). Half of the cases belong to
the arms of the catalogue, half to chains that nobody built, a new one every now and then. Ten million of them:
`python -c "from benchmarks.guard import millions; millions(10**7)"`. What the acceleration limit does to a policy:
`python -c "from benchmarks.guard import ramps; ramps('RUN/policy.onnx')"`.
"""

import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from rejoint.arms import Array, mycobot280, so101
from rejoint.control.catalogue import make_controller
from rejoint.control.comparison.protocols import KINDS, Kind, measure_crossings, measure_holds, schedule
from rejoint.control.comparison.result import Protocol
from rejoint.control.guard import RAMP, GuardLimits, Reason, guard, reason_names
from rejoint.control.loop import run
from rejoint.control.robot import JointState
from rejoint.robots.emulated import EmulatedRobot
from rejoint.robots.lab.plant.wear import draw_wear, load_wear

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "control"))

from guard_laws import check, draw_cases, random_chain

CASES = 1_000_000
BATCH, CALLS = 1000, 5000
GARBAGE = (0.0, 0.1, 0.5)
"""Shares of arms with numbers that are none"""
ARMS, RAMPS = 16, (1e-6, RAMP, 0.03, 0.06)
CHAIN_BATCHES = 5
"""Twice so many batches of each chain"""


def main(cases: int = CASES) -> None:
    one_arm()
    millions(cases)


def one_arm() -> None:
    """Print what a call costs where a command passes, is limited, and is stopped by a contact."""
    arm = mycobot280()
    limits, rest, still = GuardLimits.of(arm), arm.rest[None], np.zeros((1, arm.joints))
    folded = np.radians([[0.0, 0.0, 146.0, -146.0, 0.0, 0.0]])  # 1.2 deg from where wrist and upper arm touch
    deeper = folded + np.radians([[0.0, 0.0, 3.0, 0.0, 0.0, 0.0]])
    kinds = {"passes": (rest + 0.001, rest), "is limited": (rest + 1.0, rest), "meets a contact": (deeper, folded)}
    for name, (wanted, sent) in kinds.items():
        state, taken = JointState(time=np.zeros(1), position=sent, age=np.zeros(1)), np.empty(CALLS)
        for call in range(CALLS):
            start = time.perf_counter()
            out = guard(limits, wanted, sent, still, state, 0.025)
            taken[call] = time.perf_counter() - start
        median, p99 = 1e6 * np.percentile(taken[100:], [50, 99])
        told = ", ".join(reason_names(int(out.reasons[0]))) or "unchanged"
        print(f"one arm, a command that {name} ({told}): median {median:.0f} us, p99 {p99:.0f} us")


def millions(cases: int) -> None:
    """Check so many cases; an AssertionError names the law that does not hold."""
    rng, start, done, changed = np.random.default_rng(0), time.perf_counter(), 0, 0
    counts = dict.fromkeys(Reason, 0)
    arms = _arms(rng)
    while done < cases:
        limits = next(arms)
        out = check(limits, draw_cases(limits, rng, BATCH, garbage=float(rng.choice(GARBAGE))))
        done, changed = done + BATCH, changed + int(np.count_nonzero(out.reasons))
        for reason in counts:
            counts[reason] += int(np.count_nonzero(out.reasons & np.uint16(reason.value)))
    taken = time.perf_counter() - start
    print(f"{done} cases, every law held in each; {taken:.0f} s; {changed / done:.0%} of the commands were not passed")
    print(", ".join(f"{reason_names(reason)[0]} {number / done:.1%}" for reason, number in counts.items() if number))


def _arms(rng: np.random.Generator) -> Iterator[GuardLimits]:
    known = [GuardLimits.of(mycobot280()), GuardLimits.of(so101())]
    while True:
        chain = GuardLimits.of(random_chain(rng))
        for _ in range(CHAIN_BATCHES):
            yield from (*known, chain, chain)


def ramps(policy: str, period: tuple[float, float] = (0.020, 0.030), name: str = "policy") -> None:
    """Print what a controller does on worn myCobot arms, by the time [s] that commands take to full speed."""
    arm, protocol = mycobot280(), Protocol()
    wears = [draw_wear(load_wear("worn", arm), arm, seed) for seed in range(ARMS)]
    targets = arm.targets.sample(np.random.default_rng(7), (ARMS, 5))
    before: dict[Kind, Array] = {}
    for ramp in RAMPS:
        limits = replace(GuardLimits.of(arm), max_acceleration=arm.max_speed / ramp)
        for kind in KINDS:
            robot = EmulatedRobot(arm, wears, seed=1, period=period)
            rule = schedule(kind, protocol, keep_going=True)
            recording = run(robot, make_controller(name, arm, policy=Path(policy)), targets, rule, limits=limits)
            if kind == "crossing":
                what, found = "10 mm crossed after [ms]", measure_crossings(arm, recording, targets, protocol).time
            else:
                what, found = "settled at [um]", 1e3 * measure_holds(arm, recording, targets, protocol).settled
            mean = 1e3 * found.mean(axis=-1)
            change = mean - before.setdefault(kind, mean)
            held = (recording.reasons[recording.active] & np.uint16(Reason.ACCELERATION) > 0).mean()
            half = 1.96 * change.std(ddof=1) / np.sqrt(ARMS)
            told = f"{what} {mean.mean():.0f}, change {change.mean():+.1f} +- {half:.1f}"
            print(f"ramp {ramp:g} s: {told}, held back in {held:.2%} of the cycles")
