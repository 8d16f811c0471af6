"""What an arm's own twin buys: predictive control on it, against the policy from the shelf and laws that know no twin.

`python -m benchmarks.predictive --arms 16 --twins FOLDER` identifies each arm, a minute or two, and keeps its twin in
FOLDER; then every controller holds all arms at three targets each. Also what one control step costs.
"""

import argparse
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from rejoint.arms import mycobot280
from rejoint.control.catalogue import make_controller
from rejoint.control.comparison.result import Protocol
from rejoint.control.controller import ControlInput
from rejoint.control.feedforward import FeedforwardController
from rejoint.control.robot import JointState
from rejoint.control.shelf import shelf_controller
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.research.evaluation.family import ArmFamily, family_targets, find_variant, open_family
from rejoint.research.evaluation.identification import identify_arm
from rejoint.research.evaluation.outcome import Outcome
from rejoint.research.evaluation.trials import TrialArms, TrialSettings, try_on
from rejoint.research.rivals.catalogue import make_rival
from rejoint.system.statistics import paired_difference
from rejoint.twin.file import read_twin
from rejoint.twin.parameters import TwinParameters
from rejoint.twin.planning import PlanSettings
from rejoint.twin.predictive import PredictiveController
from rejoint.twin.simulation import Draw
from rejoint.twin.twin import Twin

TARGETS, STEPS = 3, 2000
OTHER_MOTIONS = 1_000_000
"""Added to the seed of a diagnosis for each time that it is done again: beyond the seeds of all families"""
ARM = mycobot280()
NARROW = int(np.argmin(Protocol().within))


def know(family: ArmFamily, folder: Path, again: int = 0) -> list[Twin]:
    """Identify the arms of a family, or take over the twins in ``folder``; ``again`` gives each other motions."""
    found = []
    for seed in map(family.wear_seed, range(family.arms)):
        files = RunFolder(folder / (f"{seed}-{again}" if again else str(seed)))
        files.path.mkdir(parents=True, exist_ok=True)
        if not files.twin.exists():
            identify_arm(ARM, seed, files, seed + OTHER_MOTIONS * again, lambda *_: None)
        found.append(read_twin(files.twin, ARM))
    return found


def together(twins: list[Twin]) -> Draw:
    """Return the twins of all arms as one batch."""
    each = [Draw.of(one.parameters.repeat(1), one.stiction, one.acceleration) for one in twins]
    stacked = {f.name: np.concatenate([getattr(one, f.name) for one in each]) for f in fields(Draw) if f.name != "twin"}
    names = [f.name for f in fields(TwinParameters)]
    return Draw(
        twin=TwinParameters(**{name: np.concatenate([getattr(one.twin, name) for one in each]) for name in names}),
        **stacked,
    )


def describe(name: str, outcome: Outcome, against: Outcome | None) -> str:
    """One line about one controller; pairs are the same arm at the same target, and intervals resample arms."""
    settled, stay = outcome.settled, outcome.stay[..., NARROW]
    line = (
        f"{name:22s} settled {1e3 * np.nanmean(settled):.2f} mm "
        f"(95 % below {1e3 * np.nanpercentile(settled, 95):.2f}), "
        f"farther than 5 mm {100 * np.mean(~(settled < 5e-3)):.1f} %, "
        f"stays within {' / '.join(f'{np.median(outcome.stay[..., w]):.2f}' for w in range(outcome.stay.shape[-1]))} s"
    )
    if against is None:
        return line
    arms = np.repeat(np.arange(len(settled)), settled.shape[1])
    found = paired_difference(settled.ravel(), against.settled.ravel(), arms)
    ratio = np.median(stay) / np.median(against.stay[..., NARROW])
    nearer = "" if found is None or found.low is None else (
        f", settled {1e3 * found.value:+.2f} mm ({1e3 * found.low:+.2f} to {1e3 * found.high:+.2f})"
    )  # fmt: skip
    return f"{line}; against shelf: {ratio:.2f} of its time{nearer}"


def step_times(twin: Twin) -> np.ndarray:
    """[s] of processor time that single control steps take while the plan drives."""
    controller = PredictiveController.of(ARM, twin, shelf_controller(ARM))
    target = ARM.targets.upper[None]
    still = ControlInput(
        state=JointState(time=np.zeros(1), position=ARM.rest[None], age=np.zeros(1)), target=target,
        sent=ARM.rest[None], since_target=np.zeros(1),
    )  # fmt: skip
    controller.reset(still, np.ones(1, dtype=bool))
    times = []
    for step in range(1, STEPS):
        now = replace(still, state=replace(still.state, time=np.full(1, 0.025 * step)))
        start = time.process_time()
        controller.command(now)
        times.append(time.process_time() - start)
    return np.array(times)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.predictive")
    parser.add_argument("--arms", type=int, default=16)
    parser.add_argument("--family", type=int, default=0, help="family of arms; settings were chosen on 4")
    parser.add_argument("--twins", type=Path, default=Path("runs/twins"), help="folder that keeps the arms' twins")
    parser.add_argument("--variant", default="worn", help="condition; twins are those of the arms without it")
    parser.add_argument("--again", type=int, default=0, help="seed of diagnoses and plans, for twins of other motions")
    options = parser.parse_args()
    family, variant = ArmFamily(arms=options.arms, targets=TARGETS, seed=options.family), find_variant(options.variant)
    twins = know(family, options.twins, options.again)
    known, stiffness = together(twins), float(np.mean([one.parameters.stiffness.mean() for one in twins]))
    plan = PlanSettings(seed=options.again)
    bench = TrialArms(
        open=lambda: open_family(ARM, variant, family), targets=family_targets(ARM, family, TARGETS),
        wear_seed=np.array([family.wear_seed(i) for i in range(family.arms)], dtype=float),
    )  # fmt: skip
    settings, shelf = TrialSettings(family=family, protocol=Protocol(), crossing=False), None
    for name, make in {
        "shelf": shelf_controller,
        "predictive": lambda arm: PredictiveController(arm, known, shelf_controller(arm), plan),
        "predictive, integrator": lambda arm: PredictiveController(
            arm, known, FeedforwardController(arm, stiffness), plan
        ),
        "integrator": lambda arm: make_controller("integrator", arm),
        "feedforward": lambda arm: make_controller("feedforward", arm),
        "tuned-feedforward": lambda arm: make_rival("tuned-feedforward", arm),
    }.items():
        outcome = try_on(ARM, bench, make, settings, lambda _: None)
        print(describe(name, outcome, shelf), flush=True)
        shelf = shelf or outcome
    median, p99 = 1e3 * np.percentile(step_times(twins[0])[100:], [50, 99])
    print(f"one control step while it plans: median {median:.2f} ms, p99 {p99:.2f} ms of processor time")


if __name__ == "__main__":
    main()
