"""Where tests find the recordings of a real SO-101, and its maker's model, which are no part of this project.

The environment variable REJOINT_SO101 names the folder; without it, shared/data/so101 beside the checkout is taken.
"""

import os
from pathlib import Path

FOLDER = Path(os.environ.get("REJOINT_SO101", Path(__file__).parents[1].parent / "shared" / "data" / "so101"))
MODEL = FOLDER / "so101.xml"

NO_RECORDINGS = (
    f"the 44 recorded motions of a real SO-101 are not in {FOLDER}: they are the folder output/real/so101/custom of "
    "https://github.com/isaac-sim2real/sage (commit 4ffd262, Apache-2.0); clone it and set REJOINT_SO101 to that folder"
)
NO_MODEL = (
    f"there is no {MODEL}: it is Simulation/SO101/so101_new_calib.xml of https://github.com/TheRobotStudio/SO-ARM100 "
    "(Apache-2.0); copy it as so101.xml, with its folder assets of meshes, to the folder that REJOINT_SO101 names"
)


def recorded() -> bool:
    """Tell whether the recordings are there."""
    return (FOLDER / "multisine").is_dir()
