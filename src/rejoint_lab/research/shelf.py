"""Training of the generic policies: one for any worn arm of a catalogue build, without a twin.

    python -m rejoint_lab.research.shelf mycobot280
    python -m rejoint_lab.research.shelf so101

write `rejoint.control.controllers.catalogue.shelf_path` again, with targets in the target region, then anywhere. Other
processors give other files; compare by `python -m benchmarks shelf`.
"""

import shutil
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from rejoint.arms import Arm, load_arm
from rejoint.control.controllers.catalogue import shelf_path
from rejoint.training.ranges import SLOW_BACKLASH, BroadRanges, MixedRanges, Ranges
from rejoint.training.task import DEFAULT, PpoSettings
from rejoint.training.train import DECAY_START, TrainingOptions, TrainingResult, begin_at, train

SO101_STIFFNESS = (12.0, 12.0, 12.0, 10.8, 10.8)
"""[N m/rad] of the law under the policy; chosen between worn servos and those of `_so101_ranges`"""


ANYWHERE_TOO = PpoSettings(iterations=450, log_std=-1.0, critic_first=6)
"""Settings of the second part; chosen"""


def _so101_ranges(arm: Arm) -> Ranges:
    """Half worn, half as-found SO-101, in factors on the medians of a worn arm of this weight.

    An STS3215 has 0.163 P N m/rad per N m of its stall torque (2.9 to 6 N m). A real SO-101 had viscous friction of 0.8
    to 1.6 N m s/rad and dry friction of 0.25 to 0.82 N m (the wear profile ``so101``).
    """
    worn = BroadRanges(arm=arm, acceleration=arm.servo_acceleration)
    found = replace(
        worn,
        stiffness=(1.07, 4.3),
        damping=(2.5, 8.0),
        coulomb=(0.0, 10.0),
        torque_limit=(2.5, 6.0),
        backlash=SLOW_BACKLASH,
    )
    return MixedRanges(first=found, second=worn, share=0.5)


_SO101_LAW = replace(DEFAULT.task.law, stiffness=SO101_STIFFNESS, decay_start=DECAY_START)
RECIPES: dict[str, Callable[[Arm], TrainingOptions]] = {
    "mycobot280": lambda arm: TrainingOptions(preset=DEFAULT, ranges=BroadRanges(arm=arm)),
    "so101": lambda arm: TrainingOptions(
        preset=replace(DEFAULT, task=replace(DEFAULT.task, law=_SO101_LAW)), ranges=_so101_ranges(arm)
    ),
}


def make_shelf_policy(name: str, file: Path) -> TrainingResult:
    """Train the policy for the catalogue arm ``name``, and write ``file``."""
    arm = load_arm(name)
    options = RECIPES[name](arm)  # no other seed than 0 was tried
    preset = options.recipe
    near = replace(preset, task=replace(preset.task, anywhere=0.0))
    with tempfile.TemporaryDirectory(prefix="rejoint-shelf-") as folder:
        first = train(arm, None, out=Path(folder) / "near", options=replace(options, preset=near))
        start = begin_at(first.policy.read_bytes())
        options = replace(options, preset=replace(preset, warm=ANYWHERE_TOO), start=start)
        result = train(arm, None, out=Path(folder), options=options)
        file.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(result.policy, file)
    return result


if __name__ == "__main__":
    chosen = sys.argv[1] if len(sys.argv) > 1 else "mycobot280"
    make_shelf_policy(chosen, shelf_path(chosen))
