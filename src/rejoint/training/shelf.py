"""How the policies from the shelf are made: one for any worn arm of a build of the catalogue, without a twin.

    python -m rejoint.training mycobot280

writes `rejoint.control.shelf.shelf_path` again. The recipe is the default preset on broad ranges. On another kind of
processor the same seed gives another policy, so the file is not compared by its digest but by what it does:
`python -m benchmarks shelf`.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from rejoint.arms import load_arm
from rejoint.system.progress import Progress, no_progress
from rejoint.training.train import TrainingOptions, TrainingResult, train

SEEDS = {"mycobot280": 0}
"""Training seed of each policy (chosen: the first; no other was tried)"""


def make_shelf_policy(name: str, file: Path, on_progress: Progress = no_progress) -> TrainingResult:
    """Train the policy for the arm of the catalogue that is called ``name``, and put it into ``file``."""
    with tempfile.TemporaryDirectory(prefix="rejoint-shelf-") as folder:
        options = TrainingOptions(seed=SEEDS[name], threads=1)  # so that the number of cores does not matter
        result = train(load_arm(name), None, out=Path(folder), options=options, on_progress=on_progress)
        file.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(result.policy, file)
    return result
