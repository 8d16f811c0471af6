"""Commands as their user finds them: in this process with the fixture `cli`, or in one of their own."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

JUDGE = Path(os.environ.get("REJOINT_JUDGE", Path(__file__).parents[1] / ".judge"))
"""Where `make judge` puts other programs"""


class Told(NamedTuple):
    code: int
    out: str
    err: str

    @property
    def last(self):
        """The JSON on the last line."""
        return json.loads(self.out.splitlines()[-1])

    @property
    def error(self):
        """The only line that begins as an error; it is the last one."""
        lines = self.err.splitlines()
        assert [line for line in lines if line.startswith("error: ")] == lines[-1:]
        return lines[-1]


def python(*words, code=0, **options):
    """Run Python in a process of its own, which ends with ``code``."""
    done = subprocess.run([sys.executable, *map(str, words)], capture_output=True, text=True, check=False, **options)
    assert done.returncode == code, done.stdout + done.stderr
    return Told(code, done.stdout, done.stderr)
