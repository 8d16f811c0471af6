"""What an arm's own twin buys: predictive control on it, against the policy from the shelf and laws that know no twin.

`python -m benchmarks predictive --arms 16 --twins FOLDER` identifies each arm, a minute or two, and keeps its twin in
FOLDER; then every controller holds all arms at three targets each. Also what one control step costs.
"""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.frame import held_columns, holds
from rejoint.arms import mycobot280
from rejoint.arms.postures import find_postures
from rejoint.control.controllers.catalogue import make_controller, shelf_controller
from rejoint.control.controllers.feedforward import FeedforwardController
from rejoint.control.robot import ControlInput, JointState
from rejoint.logs.runfolder import RunFolder
from rejoint.twin.predictive import PredictiveController
from rejoint.twin.twin import Twin
from rejoint_lab.research.evaluation.evaluate import classical, planned
from rejoint_lab.research.evaluation.family import VARIANTS, ArmFamily, open_family, own_twin, try_on

TARGETS, STEPS = 3, 2000
OTHER_MOTIONS = 1_000_000
"""Added to the seed of a diagnosis for each time that it is done again: beyond the seeds of all families"""
ARM = mycobot280()


def know(family: ArmFamily, folder: Path, again: int = 0) -> list[Twin]:
    """Identify the arms of a family, or take over the twins in ``folder``; ``again`` gives each other motions."""
    found = []
    for seed in family.wear_seeds:
        files = RunFolder(folder / (f"{seed}-{again}" if again else str(seed)))
        files.path.mkdir(parents=True, exist_ok=True)
        found.append(own_twin(ARM, seed, files, seed + OTHER_MOTIONS * again))
    return found


def step_times(twin: Twin) -> np.ndarray:
    """[s] of processor time that single control steps take while the plan drives."""
    controller = planned(ARM, [twin])
    target = ARM.targets.upper[None]
    rest = ARM.rest[None]
    state = JointState(time=np.zeros(1), position=rest, age=np.zeros(1))
    goal = find_postures(ARM, target, rest, None)
    still = ControlInput(state=state, target=target, goal=goal, sent=rest, since_target=np.zeros(1))
    controller.reset(still, np.ones(1, dtype=bool))
    times = []
    for step in range(1, STEPS):
        now = replace(still, state=replace(still.state, time=np.full(1, 0.025 * step)))
        start = time.process_time()
        controller.command(now)
        times.append(time.process_time() - start)
    return np.array(times)


def main(
    arms: int = 16, family: int = 0, twins: Path = Path("runs/twins"), variant: str = "worn", again: int = 0
) -> None:
    """Print a row for each controller; ``twins`` keeps the arms' twins, ``again`` is the seed of other motions."""
    drawn, condition = ArmFamily(arms=arms, targets=TARGETS, crossings=0, seed=family), VARIANTS[variant]
    own = know(drawn, twins, again)
    stiffness = float(np.mean([one.parameters.stiffness.mean() for one in own]))
    shelf = None
    for name, make in {
        "shelf": shelf_controller,
        "predictive": lambda arm: planned(arm, own),
        "predictive, integrator": lambda arm: PredictiveController.of(arm, own, FeedforwardController(arm, stiffness)),
        "integrator": lambda arm: make_controller("integrator", arm),
        "feedforward": lambda arm: make_controller("feedforward", arm),
        "tuned-feedforward": lambda arm: classical("tuned-feedforward").make((), arm),
    }.items():
        outcome = try_on(ARM, lambda: open_family(ARM, condition, drawn), make, drawn)
        found = held_columns(outcome, arms)
        holds(name, *found, shelf)
        shelf = shelf or found
    median, p99 = 1e3 * np.percentile(step_times(own[0])[100:], [50, 99])
    print(f"one control step while it plans: median {median:.2f} ms, p99 {p99:.2f} ms of processor time")
