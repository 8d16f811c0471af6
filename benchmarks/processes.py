"""Processes of this machine, by what the kernel tells: who has started whom, processor and memory."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Process:
    """One process of this machine."""

    parent: int
    name: str
    spent: float
    """[s] of processor"""


def processes() -> dict[int, Process]:
    """All processes of this machine."""
    found = {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
            name = (entry / "cmdline").read_bytes().split(b"\0")[0].decode()
        except OSError:  # it has ended
            continue
        spent = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        found[int(entry.name)] = Process(int(fields[1]), name, spent)
    return found


def below(root: int) -> dict[int, Process]:
    """Return a process and all that it has started."""
    known = processes()
    found = {root}
    while more := {child for child, one in known.items() if one.parent in found} - found:
        found |= more
    return {one: known[one] for one in found if one in known}


def memory(process: int) -> float:
    """[MB] that a process has for itself: shared libraries count by their share."""
    try:
        text = (Path("/proc") / str(process) / "smaps_rollup").read_text()
    except OSError:
        return 0.0
    return int(re.search(r"^Pss:\s+(\d+) kB", text, re.MULTILINE)[1]) / 1e3  # type: ignore[index]
