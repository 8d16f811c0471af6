"""`kill -9` at random moments: a few of those of `python -m benchmarks kills`, in a process that may fork."""

import re
from pathlib import Path

from commandline import python


def test_what_is_killed_is_gone_on_with_and_its_log_is_there():
    words = ("-m", "benchmarks", "kills", "2", "--stages", "broad,deploy")
    done = python(*words, cwd=Path(__file__).parents[2])
    assert re.search(r"deployments over TCP: 1 kills, [01] of them while it moved", done.out), done.out
