"""Which logs of a real arm an import stops, as they are and with their states stamped earlier or later.

Run with: python benchmarks/shifted_clocks.py (half a minute; needs the recordings that tests/real_so101.py names)
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from real_so101 import FOLDER, NO_RECORDINGS, recorded
from rejoint.arms import so101
from rejoint.logs import ImportOptions
from rejoint.logs.joining import to_log
from rejoint.logs.sage import motions
from rejoint.system.errors import FileError

SHIFTS = (0.0, -0.1, -0.15, -0.2, -0.3, -0.5, 0.3, 0.5)
"""[s] added to the stamps of the states"""


def main() -> None:
    """Print for every shift how many motions are stopped, how many noted, and how many taken as they are."""
    if not recorded():
        sys.exit(NO_RECORDINGS)
    arm, options = so101(), ImportOptions()
    found = list(motions(FOLDER, arm, options)[1])
    print("states shifted by s | stopped | noted | taken")
    for shift in SHIFTS:
        counts = {"stopped": 0, "noted": 0, "taken": 0}
        for motion in found:
            try:
                _, notes = to_log(replace(motion, state=motion.state.shifted(-shift)), arm, options)
            except FileError:
                counts["stopped"] += 1
            else:
                counts["noted" if any("clock" in note for note in notes) else "taken"] += 1
        print(f"{shift:+.2f} | " + " | ".join(str(count) for count in counts.values()))


if __name__ == "__main__":
    main()
