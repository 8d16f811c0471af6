"""Recordings that were copied: they look like more evidence than there is, and like motion that a fit has not seen."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from hashlib import sha256

import numpy as np

from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError


def copies(logs: Iterable[tuple[str, RunLog]]) -> dict[str, str]:
    """Find the names of logs that hold the readings of an earlier one, by whose name; logs without motion are none."""
    first: dict[bytes, str] = {}
    found: dict[str, str] = {}
    for name, log in logs:
        if not np.ptp(log.position, axis=0).any():
            continue
        key = sha256(np.concatenate([log.position, log.command]).tobytes()).digest()
        if key in first:
            found[name] = first[key]
        else:
            first[key] = name
    return found


def refuse_copies(logs: Sequence[RunLog], what: str) -> None:
    """Raise InputError of ``what``, such as "identification", where one log is a copy of another."""
    found = copies((log.label, log) for log in logs)
    if found:
        name, original = next(iter(found.items()))
        more = f" (and {len(found) - 1} more)" * (len(found) > 1)
        raise InputError(
            f"{what}: {name} holds the same readings as {original}{more}, and would count as evidence of its own; "
            "remove the copies"
        )
