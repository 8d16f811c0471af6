"""`kill -9` at random moments: a few of those of `python -m benchmarks kills`, in a process that may fork."""

import re
import subprocess
import sys
from pathlib import Path


def test_what_is_killed_is_gone_on_with_and_its_log_is_there() -> None:
    words = [sys.executable, "-m", "benchmarks.kills", "4", "--stages", "broad,deploy"]
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"deployments over TCP: 2 kills, [12] of them while it moved", done.stdout), done.stdout
