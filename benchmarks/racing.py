"""Whether a race recommends what a comparison to the end does, and in how much of the arm's time.

Emulated arms drawn about the worn one; one policy for all of them (a file, `--policy` of `python -m benchmarks.racing`;
without one the classical ones race among themselves). What every controller does at every target is emulated side by
side first, twice with other noise, holding for eight seconds. The first time is the long way, as on a real arm before
there were races. Of the second time the race is told what it asks for, the first five seconds of each hold; its arm's
time is that of the trials that it asked for.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from rejoint.arms import mycobot280
from rejoint.control.catalogue import contenders
from rejoint.control.comparison.compare import Settings, Trial, compare
from rejoint.control.comparison.driven import Driven, measure
from rejoint.control.comparison.elimination import Elimination
from rejoint.control.comparison.ledger import Ledger
from rejoint.control.comparison.onearm import looks
from rejoint.control.comparison.protocols import Crossings, Holds
from rejoint.control.comparison.racing import Race, fewest
from rejoint.control.comparison.recommend import Recommendation, recommend
from rejoint.control.comparison.result import Comparison
from rejoint.control.comparison.targets import draw_targets
from rejoint.control.default import DefaultController
from rejoint.control.loop import Schedule, run
from rejoint.control.robot import Robot
from rejoint.control.start import begin
from rejoint.diagnosis.open_loop import DWELL
from rejoint.robots import open_robot
from rejoint.runs.effort import Meter
from rejoint.runs.openloop import DEFAULT, trials
from rejoint.runs.stages.compare import RACE_PROTOCOL, RACE_SETS
from rejoint.runs.stages.driving import make_factories

ARM = mycobot280()
PERIOD = (0.045, 0.055)
"""[s] about what a myCobot needs over TCP (docs/results.md)"""
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
    """by how much the race's controller is worse in the long way: settled [m], time to stay within 2 mm [s]"""

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


def try_arm(number: int, policy: Path | None) -> Outcome:
    """Race on the worn arm drawn with the seed ``number``, and go the long way."""
    names = [
        name for name in contenders(real=True, shelf=False, policy=policy is not None, twin=False) if name != DEFAULT
    ]
    factories = make_factories({name: policy or name if name == "policy" else name for name in names}, ARM, PERIOD)

    def connect(count: int, seed: int) -> Robot:
        return open_robot(f"emulated:worn?seed={number}", count=count, seed=seed, period=PERIOD, threads=1)

    targets = draw_targets(ARM, sets=RACE_SETS, seed=number)
    short: list[Driven] = []

    def keep(trial: Trial) -> None:
        if trial.repetition == 1:
            short.append(_short(trial, targets))

    twice = compare(connect, factories, targets, Settings(seed=number, batched=True, repetitions=2), on_trial=keep)
    before, meter = open_loop(connect(1, number), targets[:1]), Meter()
    done = _Asked({part.key: part for driven in short for part in _parts(driven, [*short, *before])})
    settings = Settings(seed=number, batched=False, protocol=RACE_PROTOCOL, race=Race())
    everyone = {DEFAULT: DefaultController, **factories}
    raced = compare(
        lambda count, seed: meter.watch(connect(count, seed)), everyone, targets, settings, measured=before,
        ledger=Ledger(None, done), source="open loop",
    )  # fmt: skip
    whole = _once(twice, 0)
    best, slow = recommend(raced), recommend(whole)
    return Outcome(
        race=best, long=slow, again=recommend(_once(twice, 1)),
        seconds=meter.moving + sum(map(_seconds, done["asked"])), held=raced.row(best.controller).held,
        worse=_worse(whole, best.controller, slow.controller),
    )  # fmt: skip


def open_loop(robot: Robot, targets: np.ndarray) -> tuple[Driven, ...]:
    """Send the first set once, as the diagnosis does."""
    begin(robot)
    log = run(robot, DefaultController(ARM), targets, Schedule(dwell=DWELL)).log(0, "diagnosis/targets")
    found = trials(ARM, log, RACE_PROTOCOL)
    if found is None:
        raise RuntimeError("the open loop was cut short")
    return found.driven


def _short(trial: Trial, targets: np.ndarray) -> Driven:
    """Measure a trial as a race does."""
    whole, b = trial.recording, slice(trial.arm_index, trial.arm_index + 1)
    arrays = {item.name: getattr(whole, item.name) for item in fields(whole)}
    one = replace(whole, **{name: values[b] if name == "tripped" else values[:, b]
                            for name, values in arrays.items() if isinstance(values, np.ndarray)})  # fmt: skip
    if trial.kind == "hold":
        one = replace(one, active=one.active & (one.since_target < RACE_PROTOCOL.hold + PERIOD[1]))
    return measure(
        ARM, one, targets[trial.target_set][None], RACE_PROTOCOL, controller=trial.controller, kind=trial.kind,
        places=((trial.target_set, 0),),
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
            elif item.name not in ("shape", "within"):
                found[item.name] = pick(values)
        rows.append(replace(row, outcomes=replace(row.outcomes, shape=(sets, 1, count), **found)))
    return replace(twice, rows=tuple(rows), repetitions=1)


def _parts(driven: Driven, known: list[Driven]) -> list[Driven]:
    """Cut a trial into those that a race asks for."""
    results = driven.crossings or driven.holds
    if results is None:
        return []
    found = []
    stops = [0, *(_stops(known, driven.places[0][0]) if driven.holds is not None else ()), driven.targets]
    for first, stop in pairwise(stops):
        part = type(results)(**{item.name: _cut(getattr(results, item.name), item.name, slice(first, stop))
                                for item in fields(results)})  # fmt: skip
        found.append(replace(
            driven, first=first, crossings=part if isinstance(part, Crossings) else None,
            holds=part if isinstance(part, Holds) else None,
        ))  # fmt: skip
    return found


def _cut(values: np.ndarray, name: str, part: slice) -> np.ndarray:
    return values[:, :, part] if name in ("stay", "modelled") else values[:, part]


def _stops(known: list[Driven], target_set: int) -> list[int]:
    """Return where a race looks within a set: by who is left after the first crossings, as in `OneArm.race`."""
    if target_set:
        return looks(10, 0)
    rules = Elimination(RACE_PROTOCOL)
    crossings = [driven for driven in known if driven.crossings is not None and driven.places[0][0] == 0]
    for driven in crossings:
        assert driven.crossings is not None
        rules.note(driven.controller, "crossing", (0, 0), driven.crossings.crossed[0], failed=False)
    left = sum(not rules.out(driven.controller) for driven in crossings)
    return looks(10, fewest(max(left - 1, 1), Race()))


def _seconds(driven: Driven | None) -> float:
    """[s] that a trial takes on one arm, with the way to its beginning."""
    if driven is None:  # of the default, where it is still in the race: driven, and counted by the meter
        return 0.0
    if driven.crossings is not None:
        return WAY + float(np.nansum(driven.crossings.time))
    return WAY + driven.targets * RACE_PROTOCOL.hold


def _worse(whole: Comparison, ours: str, theirs: str) -> tuple[float, float]:
    if ours not in whole.controllers:
        return np.inf, np.inf
    a, b = whole.row(ours).outcomes, whole.row(theirs).outcomes
    settled = np.nanmean(a.array("settled")) - np.nanmean(b.array("settled"))
    return float(settled), float(np.nanmean(a.array("stay")[-1]) - np.nanmean(b.array("stay")[-1]))


def bench(arms: int, policy: Path | None, first: int = 0) -> None:
    """Try so many arms, and count."""
    found = []
    for number in range(first, first + arms):
        begun, one = time.perf_counter(), try_arm(number, policy)
        found.append(one)
        print(
            f"arm {number:3}: {one.verdict:5}  race: {one.race.controller} after {one.held} targets, "
            f"{one.seconds / 60:.1f} min; long way: {' or '.join((one.long.controller, *one.long.tied))}, "
            f"again {' or '.join((one.again.controller, *one.again.tied))}; worse by "
            f"{1e3 * one.worse[0]:+.2f} mm, {one.worse[1]:+.2f} s  ({time.perf_counter() - begun:.0f} s to emulate)",
            flush=True,
        )
    again = [_verdict(one.again, one.long) for one in found]
    verdicts, minutes = [one.verdict for one in found], np.array([one.seconds for one in found]) / 60
    print(
        f"{verdicts.count('same')} of {arms} the same, {verdicts.count('tied')} that the long way cannot tell from its "
        f"own (the long way with other noise: {again.count('same')} and {again.count('tied')}); "
        f"{np.median(minutes):.1f} min of the arm's time in the median, {minutes.max():.1f} at most"
    )


def main() -> None:
    """Race on a few arms without a policy: in a minute or two."""
    bench(4, None)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.racing")
    parser.add_argument("--arms", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="seed of the first arm")
    parser.add_argument("--policy", type=Path)
    options = parser.parse_args()
    bench(options.arms, options.policy, options.first)
