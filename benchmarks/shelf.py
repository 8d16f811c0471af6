"""The policies from the shelf, made again by `python -m rejoint_lab.research.shelf ARM`, and compared by what they do.

On another kind of processor the same seed gives another policy, so the two are compared as two trainings are: on worn
arms that neither has met.
"""

import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.frame import NARROW
from rejoint.arms import load_arm
from rejoint.control.comparison.result import Columns, Protocol
from rejoint.control.controllers.catalogue import shelf_arms, shelf_path
from rejoint.control.controllers.policy import load_policy
from rejoint_lab.research.evaluation.family import WORN, ArmFamily, open_family, try_on
from rejoint_lab.research.shelf import make_shelf_policy

ARMS, TARGETS = 20, 3
FARTHER, LATER = 0.15e-3, 1.2
"""[m] by which the new one may settle farther, and how many times as long it may take to stay within 2 mm (chosen: what
trainings of three seeds differ by, docs/research.md)"""


def tried(name: str, file: Path) -> Columns:
    """Hold the policy of ``file`` on worn arms of this build."""
    family = ArmFamily(arms=ARMS, targets=TARGETS, crossings=0)
    arm = load_arm(name)
    return try_on(arm, lambda: open_family(arm, WORN, family), lambda arm: load_policy(file, arm), family)


def figures(outcome: Columns) -> tuple[float, float, float]:
    """Mean settled error [m], its 95th percentile [m], and median time [s] to come and stay within 2 mm."""
    return (
        float(np.nanmean(outcome["settled"])),
        float(np.nanpercentile(outcome["settled"], 95)),
        float(np.median(outcome[Protocol().stay_names[NARROW]])),
    )


def main() -> None:
    for name in shelf_arms():
        with tempfile.TemporaryDirectory() as folder:
            again = Path(folder) / "again.onnx"
            start = time.perf_counter()
            make_shelf_policy(name, again)
            taken = time.perf_counter() - start
            found = {what: figures(tried(name, file)) for what, file in (("kept", shelf_path(name)), ("again", again))}
            same = again.read_bytes() == shelf_path(name).read_bytes()
        print(f"{name}: made again in {taken:.0f} s, {'the same to the bit' if same else 'other bits'}")
        for what, (mean, tail, late) in found.items():
            print(
                f"  {what}: settled {1e3 * mean:.2f} mm, 95 % below {1e3 * tail:.2f} mm; within 2 mm after {late:.2f} s"
            )
        kept, new = found["kept"], found["again"]
        met = new[0] <= kept[0] + FARTHER and new[2] <= LATER * kept[2]
        print(f"  as good as the one that is kept: {'yes' if met else 'NO'}")
