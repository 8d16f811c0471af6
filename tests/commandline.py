"""The command line as its user finds it, in this process."""

import sys
from pathlib import Path

import pytest

from rejoint.cli import main


def run_cli(
    *words: str | Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> tuple[int, str, str]:
    """Run `rejoint WORDS`; returns the exit code, standard output and standard error."""
    monkeypatch.setattr(sys, "argv", ["rejoint", *map(str, words)])
    with pytest.raises(SystemExit) as stopped:
        main()
    told = capsys.readouterr()
    return int(stopped.value.code or 0), told.out, told.err
