"""Makes the logs of simulated arms on a table, which the tests of the twin share, importable here."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "twin"))
