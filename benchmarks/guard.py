"""What the guard costs one arm, and whether its laws hold in millions of cases.

The laws, and a geometry of their own, are those of the tests (tests/control/guard_laws.py). Half of the cases belong to
the arms of the catalogue, half to chains that nobody built, a new one every now and then. Ten million of them:
`python -m benchmarks guard --cases 10000000`.
"""

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rejoint.arms import mycobot280, so101
from rejoint.control.guard import GuardLimits, Reason, guard, reason_names
from rejoint.control.robot import JointState

sys.path.extend(str(Path(__file__).parents[1] / "tests" / room) for room in ("", "control"))

from guard_laws import check, draw_cases, random_chain

CASES = 1_000_000
BATCH, CALLS = 1000, 5000
GARBAGE = (0.0, 0.1, 0.5)
"""Shares of arms with numbers that are none"""
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
