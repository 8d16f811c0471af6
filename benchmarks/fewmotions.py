"""How well a twin of few motions predicts the others: logs of a real SO-101, five motions at random, or one alone.

    python -m benchmarks.fewmotions LOGS [five] [alone]

LOGS as for `benchmarks.identification`. The structure is given (stiction 1.25, the servos' acceleration), no table is
fitted, and errors are those of the tool in free space.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks import logs as sources
from rejoint.arms import Arm, load_arm
from rejoint.logs.exclusions import find_exclusions, table_height
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.twin.fromlogs import FITTED
from rejoint.twin.judge import Candidate, judge
from rejoint.twin.motionfit import LogSettings, settle
from rejoint.twin.parameters import unpack
from rejoint.twin.structure import simplest
from rejoint.twin.unknown import unknown_prior

DRAWS, MOTIONS = 20, 5
EXCITING = np.radians(8.0)
"""[rad] that the command of every joint travels in a motion that excites the arm (chosen before the fits: four times
what friction hides); the others leave a joint unknown"""


def error(arm: Arm, seen: Sequence[RunLog], others: Sequence[RunLog]) -> float:
    """Mean error [mm] of the tool in free space over the ``others`` of a twin of the motions ``seen``."""
    structure = simplest(unknown_prior(arm), 1.25, arm.servo_acceleration)
    height = table_height(arm, seen)
    problem, found = settle(arm, seen, find_exclusions(arm, seen, height), structure, None, LogSettings(threads=1))
    replay = problem.replay
    twin = Candidate(
        name=FITTED, parameters=unpack(found.vector, arm.joints), stiction=replay.stiction,
        acceleration=replay.acceleration,
    )  # fmt: skip
    free = judge(arm, [twin], others, table=table_height(arm, others)).mean[FITTED].free
    return float("nan") if free is None else 1e3 * free.tcp


def five(arm: Arm, logs: Sequence[RunLog]) -> None:
    """Fit five motions, drawn at random, and judge on all others."""
    found = []
    for seed in range(DRAWS):
        chosen = set(np.random.default_rng(100 + seed).choice(len(logs), MOTIONS, replace=False).tolist())
        seen = [log for i, log in enumerate(logs) if i in chosen]
        found.append(error(arm, seen, [log for i, log in enumerate(logs) if i not in chosen]))
        print(f"{found[-1]:5.2f} mm  {', '.join(log.label for log in seen)}", flush=True)
    print(f"90th percentile {np.quantile(found, 0.9):.2f} mm, largest {max(found):.2f} mm")


def alone(arm: Arm, logs: Sequence[RunLog]) -> None:
    """Fit each motion by itself, and judge on all others."""
    found: dict[bool, list[float]] = {True: [], False: []}
    for log in logs:
        exciting = bool((np.ptp(log.command, axis=0) > EXCITING).all())
        try:
            found[exciting].append(error(arm, [log], [other for other in logs if other is not log]))
            print(f"{found[exciting][-1]:5.2f} mm  {'' if exciting else '(does not excite) '}{log.label}", flush=True)
        except InputError as refused:
            print(f"refused  {log.label}: {refused}", flush=True)
    for exciting, errors in found.items():
        kind = "excite" if exciting else "do not excite"
        print(
            f"{len(errors)} motions that {kind} every joint: median {np.median(errors):.2f} mm, most {max(errors):.2f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description="Twins of few motions of a real SO-101.")
    parser.add_argument("logs", type=Path, help="folder of SAGE motions")
    parser.add_argument("sections", nargs="*", choices=["five", "alone", []], help="what to run; both by default")
    options = parser.parse_args()
    arm = load_arm("so101")
    logs = sources.read(options.logs, arm)
    for name in options.sections or ["five", "alone"]:
        print(f"\n== {name} ==", flush=True)
        {"five": five, "alone": alone}[name](arm, logs)


if __name__ == "__main__":
    main()
