"""Whether elimination in blocks recommends what a comparison to the end does, and in how much of the arm's time.

Emulated arms drawn about the worn one, each diagnosed and with its own twin; one policy for all of them (a file,
`--policy` of `python -m benchmarks elimination`; without one the generic policy takes part). What every controller does
at every target is emulated side by side first, twice with other noise, holding for eight seconds. The first time is the
long way, twenty targets judged by their intervals. Of the second time the comparison in blocks takes the trials that it
asks for, the first seconds of each hold; its arm's time is that of these trials. What the recommended controller
costs is measured on all forty holds: how much farther off it settles than the best one, and how much later it stays
within 2 mm. ``--sets 2`` goes to twenty targets.
"""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import rejoint
from rejoint.arms import mycobot280
from rejoint.control.comparison.compare import BLOCK, Ledger, Settings, TrialRunner
from rejoint.control.comparison.protocols import measure
from rejoint.control.comparison.recommend import Recommendation, recommend
from rejoint.control.comparison.result import Comparison, Driven
from rejoint.control.controllers.classical import DefaultController
from rejoint.control.recording import Recording
from rejoint.control.robot import Robot
from rejoint.control.targets import draw_targets
from rejoint.logs.runfolder import read_effort
from rejoint.robots import open_robot
from rejoint.runs.run import Run, staged
from rejoint.runs.stages.compare import DEFAULT, ONE_ARM_PROTOCOL, ONE_ARM_SETS, open_loop_trials
from rejoint.session.context import ControllerMaker

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

    short: Recommendation
    long: Recommendation
    seconds: float
    """of the arm's time in blocks"""
    held: int
    """targets at which the recommended controller was held"""
    worse: tuple[float, float]
    """by how much the controller of the blocks is worse than the best in all holds: settled [m], time to stay [s]"""

    @property
    def verdict(self) -> str:
        """Return ``same``, ``tied`` where the long way could not tell the two apart, or ``OTHER``."""
        if self.short.controller == self.long.controller:
            return "same"
        return "tied" if self.short.controller in self.long.tied else "OTHER"


class _Asked(dict):  # type: ignore[type-arg]
    """Trials as a ledger has them, which remembers those that were asked for."""

    def get(self, key, default=None):  # type: ignore[no-untyped-def]
        self.setdefault("asked", []).append(found := super().get(key, default))
        return found


def try_arm(number: int, policy: Path | None, sets: int) -> Outcome:
    """Compare in blocks on the worn arm drawn with the seed ``number``, and go the long way."""
    address = f"emulated:worn?seed={number}"
    diagnosed = rejoint.diagnose(address, settings=rejoint.Settings(period=PERIOD, seed=number))
    twin = rejoint.identify([diagnosed.excitation, diagnosed.targets])
    maker = ControllerMaker(ARM, PERIOD, twin=twin)
    names = maker.contenders(real=True, posed=False)
    given: dict[str, Path | str] = {name: name for name in names if name != DEFAULT}
    if policy is not None:
        del given["shelf"]
        given["policy"] = policy
    factories = maker.factories(given)

    def connect(count: int, seed: int) -> Robot:
        return open_robot(address, count=count, seed=seed, period=PERIOD)

    before = open_loop_trials(ARM, diagnosed.targets, ONE_ARM_PROTOCOL)
    assert before is not None
    targets, short = draw_targets(ARM, sets=SETS, seed=number), []
    targets[0] = before.targets

    def keep(driven: Driven, recording: Recording) -> None:
        if driven.key.kind == "hold":
            short.extend(_short(driven, recording, b, targets) for b, (_, r) in enumerate(driven.key.places) if r == 1)

    twice = TrialRunner(
        connect, factories, targets, Settings(seed=number, batched=True, repetitions=2), on_trial=keep
    ).compare()
    done = _Asked({part.key: part for driven in short for part in _parts(driven)})
    settings = Settings(seed=number, batched=False, protocol=ONE_ARM_PROTOCOL, block=BLOCK)
    everyone = {DEFAULT: DefaultController, **factories}
    ledger = Ledger()
    ledger.done = done
    with TemporaryDirectory() as folder:
        run = Run.create(folder, address, ARM)
        with staged(run, "compare") as watch:
            raced = TrialRunner(
                lambda count, seed: watch(connect(count, seed)),
                everyone,
                targets[:sets],
                settings,
                measured=before.driven,
                ledger=ledger,
            ).compare()
        effort = read_effort(run.folder)
    best = recommend(raced)
    return Outcome(
        short=best,
        long=recommend(_once(twice)),
        seconds=(effort.stages[0].moving if effort else 0.0) + sum(map(_seconds, done["asked"])),
        held=raced.row(best.controller).held,
        worse=_worse(twice, best.controller),
    )


def _short(driven: Driven, recording: Recording, b: int, targets: np.ndarray) -> Driven:
    """Measure the trial of arm ``b`` as a comparison in blocks does."""
    one, target_set = recording.at(slice(None), slice(b, b + 1)), driven.key.places[b][0]
    one = replace(recording, **vars(one), tripped=recording.tripped[b : b + 1])
    one = replace(one, active=one.active & (one.since_target < ONE_ARM_PROTOCOL.hold + PERIOD[1]))
    key = driven.key._replace(places=((target_set, 0),), first=0)
    return measure(ARM, one, targets[target_set][None], ONE_ARM_PROTOCOL, key)


def _once(twice: Comparison) -> Comparison:
    """Return the first of two repetitions."""
    count = len(twice.controllers)

    def pick(values: tuple) -> tuple:  # type: ignore[type-arg]
        return tuple(np.array(values, dtype=object).reshape(count, *twice.shape)[:, :, 0].ravel())

    results = {name: pick(values) for name, values in twice.results.items()}
    return replace(twice, results=results, repetitions=1)


def _parts(driven: Driven) -> list[Driven]:
    """Cut the holds of a set into blocks."""
    parts = []
    for k in range(0, driven.columns["held"].shape[1], BLOCK):
        columns = {name: values[:, k : k + BLOCK] for name, values in driven.columns.items()}
        parts.append(replace(driven, key=driven.key._replace(first=k), columns=columns))
    return parts


def _seconds(driven: Driven | None) -> float:
    """[s] that a trial takes on one arm, with the way to its beginning."""
    if driven is None:  # of the default, where it is still there: driven, and counted by the meter
        return 0.0
    return WAY + driven.columns["held"].shape[1] * ONE_ARM_PROTOCOL.hold


def _worse(twice: Comparison, ours: str) -> tuple[float, float]:
    if ours not in twice.controllers:
        return np.inf, np.inf
    narrow = twice.protocol.stay_names[-1]
    settled, stay = (
        {name: float(np.nanmean(twice.array(metric, name))) for name in twice.controllers}
        for metric in ("settled", narrow)
    )
    return settled[ours] - min(settled.values()), stay[ours] - min(stay.values())


def main(arms: int = 4, first: int = 0, policy: Path | None = None, sets: int = ONE_ARM_SETS) -> None:
    """Compare on so many arms and count; without a policy the generic one takes part."""
    found = []
    for number in range(first, first + arms):
        begun, one = time.perf_counter(), try_arm(number, policy, sets)
        found.append(one)
        print(
            f"arm {number:3}: {one.verdict:5}  blocks: {one.short.controller} after {one.held} targets, "
            f"{one.seconds / 60:.1f} min; long way: {' or '.join((one.long.controller, *one.long.tied))}; worse than "
            f"the best by {1e3 * one.worse[0]:.2f} mm, {one.worse[1]:.2f} s  ({time.perf_counter() - begun:.0f} s "
            "to emulate)",
            flush=True,
        )
    verdicts, minutes = [one.verdict for one in found], np.array([one.seconds for one in found]) / 60
    worse = np.mean([one.worse for one in found], axis=0)
    print(
        f"{verdicts.count('same')} of {arms} the same, {verdicts.count('tied')} that the long way cannot tell from its "
        f"own; worse than the best by {1e3 * worse[0]:.2f} mm and {worse[1]:.2f} s in the mean; "
        f"{np.median(minutes):.1f} min of the arm's time in the median, {minutes.max():.1f} at most"
    )
