"""Whether a race recommends what a comparison to the end does, and in how much of the arm's time.

Emulated arms drawn about the worn one, each alone and in virtual time; one policy for all of them (a file, `--policy` of
`python -m benchmarks.racing`; without one the classical controllers race among themselves). For each arm: ten targets
open loop, as the diagnosis has them, then the race. The long way is every controller of the race at the same two sets,
held for eight seconds, as on a real arm before there were races, and three repetitions of it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rejoint.arms import Arm, mycobot280
from rejoint.control.catalogue import contenders
from rejoint.control.comparison.compare import Settings, compare
from rejoint.control.comparison.racing import Race
from rejoint.control.comparison.recommend import Recommendation, recommend
from rejoint.control.comparison.result import Comparison, Protocol
from rejoint.control.comparison.targets import draw_targets
from rejoint.control.default import DefaultController
from rejoint.control.loop import Schedule, run
from rejoint.control.robot import Robot
from rejoint.control.start import begin
from rejoint.diagnosis.open_loop import DWELL
from rejoint.robots import open_robot
from rejoint.runs.effort import Meter
from rejoint.runs.openloop import trials
from rejoint.runs.stages.compare import RACE_PROTOCOL, RACE_SETS
from rejoint.runs.stages.driving import make_factories

PERIOD = (0.045, 0.055)
"""[s] about what a myCobot needs over TCP (docs/results.md)"""
REPETITIONS = 3
"""of the long way (chosen: what is left of the noise is small beside what targets differ)"""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One arm."""

    race: Recommendation
    long: Recommendation
    minutes: float
    """of the arm's time for the race"""
    targets: int
    """at which the recommended controller was held"""
    worse: tuple[float, float]
    """by how much the race's controller is worse in the long way: settled [m], time to stay within 2 mm [s]"""

    @property
    def tied(self) -> bool:
        """Whether the long way could not tell the two apart either."""
        return self.race.controller in (self.long.controller, *self.long.tied)


def try_arm(number: int, policy: Path | None) -> Outcome:
    """Race on the worn arm drawn with the seed ``number``, and go the long way."""
    arm = mycobot280()
    names = contenders(real=True, policy=policy is not None)
    given = {name: policy if name == "policy" and policy is not None else name for name in names}
    factories = make_factories(given, arm, PERIOD)

    def connect(count: int, seed: int) -> Robot:
        return open_robot(f"emulated:worn?seed={number}", count=count, seed=seed, period=PERIOD, threads=2)

    targets, meter = draw_targets(arm, sets=RACE_SETS, seed=number), Meter()
    before = open_loop(connect(1, number), targets[:1], arm)
    raced = compare(
        lambda count, seed: meter.watch(connect(count, seed)), factories, targets,
        Settings(seed=number, batched=False, protocol=RACE_PROTOCOL, race=Race()), measured=before, source="open loop",
    )  # fmt: skip
    whole = compare(
        connect,
        factories,
        targets,
        Settings(seed=1000 + number, batched=True, repetitions=REPETITIONS, protocol=Protocol()),
    )
    best, long = recommend(raced), recommend(whole)
    return Outcome(
        race=best, long=long, minutes=meter.moving / 60, targets=raced.row(best.controller).held,
        worse=_worse(whole, best.controller, long.controller),
    )  # fmt: skip


def open_loop(robot: Robot, targets: np.ndarray, arm: Arm) -> tuple:
    """Send the first set once, as the diagnosis does."""
    begin(robot)
    log = run(robot, DefaultController(arm), targets, Schedule(dwell=DWELL)).log(0, "diagnosis/targets")
    found = trials(arm, log, RACE_PROTOCOL)
    assert found is not None
    return found.driven


def _worse(whole: Comparison, ours: str, theirs: str) -> tuple[float, float]:
    pick: Callable[[str, str], float] = lambda name, what: float(np.nanmean(  # noqa: E731
        whole.row(name).outcomes.array(what)[-1 if what == "stay" else ...]))  # fmt: skip
    return pick(ours, "settled") - pick(theirs, "settled"), pick(ours, "stay") - pick(theirs, "stay")


def bench(arms: int, policy: Path | None, first: int = 0) -> None:
    """Try so many arms, and count."""
    found = []
    for number in range(first, first + arms):
        begun, one = time.perf_counter(), try_arm(number, policy)
        found.append(one)
        same = "same" if one.race.controller == one.long.controller else "tied" if one.tied else "OTHER"
        print(
            f"arm {number:3}: {same:5}  race {one.race.controller:12} after {one.targets:2} targets, "
            f"{one.minutes:4.1f} min; "
            f"long way {one.long.controller:12} tied with {', '.join(one.long.tied) or 'none'}; worse by "
            f"{1e3 * one.worse[0]:+.2f} mm, {one.worse[1]:+.2f} s  ({time.perf_counter() - begun:.0f} s)",
            flush=True,
        )  # fmt: skip
    same = sum(one.race.controller == one.long.controller for one in found)
    minutes = np.array([one.minutes for one in found])
    print(
        f"\n{same} of {arms} the same, {sum(one.tied for one in found)} the same or one that the long way cannot tell "
        "from it; "
        f"{np.median(minutes):.1f} min of the arm's time in the median, {minutes.max():.1f} at most"
    )


def main() -> None:
    """Four arms without a policy: in a minute or two."""
    bench(4, None)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.racing")
    parser.add_argument("--arms", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--policy", type=Path)
    options = parser.parse_args()
    bench(options.arms, options.policy, options.first)
