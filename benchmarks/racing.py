"""Whether a race recommends what a comparison to the end does, and in how much of the arm's time.

Emulated arms drawn about the worn one, each diagnosed and with its own twin; one policy for all of them (a file,
`--policy` of `python -m benchmarks.racing`; without one that from the shelf takes part). What every controller does at
every target is emulated side by side first, twice with other noise, holding for eight seconds. The first time is the
long way, twenty targets judged by their intervals, as on a real arm before there were races. Of the second time the
race is told what it asks for, the first five seconds of each hold; its arm's time is that of the trials that it asked
for. What the recommended controller costs is told by all forty holds: how much farther off it settles than the best
one, and how much later it stays within 2 mm. ``--sets 2`` races to twenty targets, ``--shelf`` with the policy from the
shelf beside the other one.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

import rejoint
from rejoint.arms import mycobot280
from rejoint.control.catalogue import contenders
from rejoint.control.comparison.compare import Settings, Trial, compare
from rejoint.control.comparison.driven import Driven, measure
from rejoint.control.comparison.ledger import Ledger
from rejoint.control.comparison.onearm import looks
from rejoint.control.comparison.protocols import Crossings, Holds
from rejoint.control.comparison.racing import Race
from rejoint.control.comparison.recommend import Recommendation, recommend
from rejoint.control.comparison.result import Comparison
from rejoint.control.comparison.targets import draw_targets
from rejoint.control.default import DefaultController
from rejoint.control.robot import Robot
from rejoint.control.shelf import SHELF
from rejoint.robots import open_robot
from rejoint.runs.metering import Meter
from rejoint.runs.openloop import DEFAULT, trials
from rejoint.runs.stages.compare import RACE_PROTOCOL, RACE_SETS
from rejoint.runs.stages.controllers import make_factories

ARM = mycobot280()
PERIOD = (0.045, 0.055)
"""[s] about what a myCobot needs over TCP (docs/results.md)"""
SETS = 2
"""Target sets of the long way"""
WAY = 2.7
"""[s] from the end of a trial to the beginning of the next: to the rest posture, and a second there (chosen: what it
takes over TCP in the mean)"""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One arm."""

    race: Recommendation
    long: Recommendation
    again: Recommendation
    """of the long way with other noise: what it agrees with itself in is all that a race can agree with it in"""
    seconds: float
    """of the arm's time for the race"""
    held: int
    """targets at which the recommended controller was held"""
    worse: tuple[float, float]
    """by how much the race's controller is worse than the best in all holds: settled [m], time to stay [s]"""
    slow: tuple[float, float]
    """the same of the long way's"""

    @property
    def verdict(self) -> str:
        """Whether the race recommends what the long way does."""
        return _verdict(self.race, self.long)


def _verdict(one: Recommendation, long: Recommendation) -> str:
    """Return ``same``, ``tied`` where the long way could not tell the two apart, or ``OTHER``."""
    if one.controller == long.controller:
        return "same"
    return "tied" if one.controller in long.tied else "OTHER"


class _Asked(dict):  # type: ignore[type-arg]
    """Trials as a ledger has them, which remembers those that were asked for."""

    def get(self, key, default=None):  # type: ignore[no-untyped-def]
        self.setdefault("asked", []).append(found := super().get(key, default))
        return found


def try_arm(number: int, policy: Path | None, sets: int, *, shelf: bool) -> Outcome:
    """Race on the worn arm drawn with the seed ``number``, and go the long way."""
    address = f"emulated:worn?seed={number}"
    diagnosed = rejoint.diagnose(address, period=PERIOD, seed=number)
    twin = rejoint.identify(diagnosed.excitation)
    names = [*contenders(real=True, shelf=True, policy=policy is not None, twin=True)]
    names = [name for name in dict.fromkeys((*names, *([SHELF] if shelf else ()))) if name != DEFAULT]
    given = {name: policy or name if name == "policy" else name for name in names}
    factories = make_factories(given, ARM, PERIOD, twin=twin)

    def connect(count: int, seed: int) -> Robot:
        return open_robot(address, count=count, seed=seed, period=PERIOD, threads=1)

    before = trials(ARM, diagnosed.targets, RACE_PROTOCOL)
    assert before is not None
    targets, short = draw_targets(ARM, sets=SETS, seed=number), []
    targets[0] = before.targets

    def keep(trial: Trial) -> None:
        if trial.repetition == 1 and trial.kind == "hold":
            short.append(_short(trial, targets))

    twice = compare(connect, factories, targets, Settings(seed=number, batched=True, repetitions=2), on_trial=keep)
    done, meter = _Asked({part.key: part for driven in short for part in _parts(driven)}), Meter()
    settings = Settings(seed=number, batched=False, protocol=RACE_PROTOCOL, race=Race())
    everyone = {DEFAULT: DefaultController, **factories}
    raced = compare(
        lambda count, seed: meter.watch(connect(count, seed)), everyone, targets[:sets], settings,
        measured=(before.driven,), ledger=Ledger(None, done), source="open loop",
    )  # fmt: skip
    best, slow, again = recommend(raced), recommend(_once(twice, 0)), recommend(_once(twice, 1))
    return Outcome(
        race=best, long=slow, again=again, seconds=meter.moving + sum(map(_seconds, done["asked"])),
        held=raced.row(best.controller).held, worse=_worse(twice, best.controller),
        slow=_worse(twice, again.controller),
    )  # fmt: skip


def _short(trial: Trial, targets: np.ndarray) -> Driven:
    """Measure a trial as a race does."""
    one = trial.recording.of(slice(trial.arm_index, trial.arm_index + 1))
    if trial.kind == "hold":
        one = replace(one, active=one.active & (one.since_target < RACE_PROTOCOL.hold + PERIOD[1]))
    return measure(
        ARM, one, targets[trial.target_set][None], RACE_PROTOCOL, controller=trial.controller, kind=trial.kind,
        places=((trial.target_set, 0),), both=True,
    )  # fmt: skip


def _once(twice: Comparison, repetition: int) -> Comparison:
    """Return one of two repetitions."""
    sets, _, count = twice.rows[0].outcomes.shape

    def pick(values: tuple) -> tuple:  # type: ignore[type-arg]
        return tuple(np.array(values, dtype=object).reshape(sets, 2, count)[:, repetition].ravel())

    rows = []
    for row in twice.rows:
        found = {}
        for item in fields(row.outcomes):
            values = getattr(row.outcomes, item.name)
            if item.name in ("stay", "stayed"):
                found[item.name] = tuple(map(pick, values))
            elif item.name not in ("shape", "within", "modelled", "turned"):
                found[item.name] = pick(values)
        rows.append(replace(row, outcomes=replace(row.outcomes, shape=(sets, 1, count), **found)))
    return replace(twice, rows=tuple(rows), repetitions=1)


def _parts(driven: Driven) -> list[Driven]:
    """Cut the holds of a set into those that a race asks for."""
    assert driven.crossings is not None
    assert driven.holds is not None
    stops, found = looks(driven.targets, driven.targets * driven.places[0][0], Race()), []
    for part in (slice(first, stop) for first, stop in pairwise(stops)):
        crossings = Crossings(**{f.name: getattr(driven.crossings, f.name)[:, part] for f in fields(Crossings)})
        holds = Holds(**{f.name: _cut(getattr(driven.holds, f.name), f.name, part) for f in fields(Holds)})
        found.append(replace(driven, first=part.start, crossings=crossings, holds=holds))
    return found


def _cut(values: np.ndarray, name: str, part: slice) -> np.ndarray:
    return values[:, :, part] if name in ("stay", "modelled") else values[:, part]


def _seconds(driven: Driven | None) -> float:
    """[s] that a trial takes on one arm, with the way to its beginning."""
    if driven is None:  # of the default, where it is still in the race: driven, and counted by the meter
        return 0.0
    return WAY + driven.targets * RACE_PROTOCOL.hold


def _worse(twice: Comparison, ours: str) -> tuple[float, float]:
    if ours not in twice.controllers:
        return np.inf, np.inf
    each = {row.controller: row.outcomes for row in twice.rows}
    settled = {name: float(np.nanmean(one.array("settled"))) for name, one in each.items()}
    stay = {name: float(np.nanmean(one.array("stay")[-1])) for name, one in each.items()}
    return settled[ours] - min(settled.values()), stay[ours] - min(stay.values())


def bench(arms: int, policy: Path | None, first: int = 0, sets: int = RACE_SETS, *, shelf: bool = False) -> None:
    """Try so many arms, and count."""
    found = []
    for number in range(first, first + arms):
        begun, one = time.perf_counter(), try_arm(number, policy, sets, shelf=shelf)
        found.append(one)
        print(
            f"arm {number:3}: {one.verdict:5}  race: {one.race.controller} after {one.held} targets, "
            f"{one.seconds / 60:.1f} min; long way: {' or '.join((one.long.controller, *one.long.tied))}, "
            f"again {' or '.join((one.again.controller, *one.again.tied))}; worse than the best by "
            f"{1e3 * one.worse[0]:.2f} mm, {one.worse[1]:.2f} s  ({time.perf_counter() - begun:.0f} s to emulate)",
            flush=True,
        )
    again = [_verdict(one.again, one.long) for one in found]
    verdicts, minutes = [one.verdict for one in found], np.array([one.seconds for one in found]) / 60
    worse, slow = np.mean([one.worse for one in found], axis=0), np.mean([one.slow for one in found], axis=0)
    print(
        f"{verdicts.count('same')} of {arms} the same, {verdicts.count('tied')} that the long way cannot tell from its "
        f"own (the long way with other noise: {again.count('same')} and {again.count('tied')}); worse than the best by "
        f"{1e3 * worse[0]:.2f} mm and {worse[1]:.2f} s in the mean (the long way: {1e3 * slow[0]:.2f} and "
        f"{slow[1]:.2f}); {np.median(minutes):.1f} min of the arm's time in the median, {minutes.max():.1f} at most"
    )


def main() -> None:
    """Race on a few arms without a policy: in a minute or two."""
    bench(4, None)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.racing")
    parser.add_argument("--arms", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="seed of the first arm")
    parser.add_argument("--policy", type=Path)
    parser.add_argument("--sets", type=int, default=RACE_SETS, help="target sets of a race at most")
    parser.add_argument("--shelf", action="store_true", help="race with the policy from the shelf as well")
    options = parser.parse_args()
    bench(options.arms, options.policy, options.first, options.sets, shelf=options.shelf)
