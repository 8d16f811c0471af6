"""Which arm a row is about: a name that stays the same while its address, its age or its room changes."""

from __future__ import annotations

import hashlib
import re
from dataclasses import fields

import numpy as np

from rejoint.arms import Arm

_PASSING = re.compile(r"[?&](hours|ambient)=[^&]*")
_HOURS = re.compile(r"[?&]hours=([\d.]+)")
_NOT_A_NAME = re.compile(r"[^\w.-]+")


def name_of(address: str, model: str) -> str:
    """Name an arm by its address and description, where its owner gives no name: ``mycobot280-emulated-worn-seed-3``.

    How long an emulated arm was used, and how warm its room is, does not count: it stays the same arm.
    """
    return plain_name(f"{model}-{_PASSING.sub('', address)}")


def plain_name(text: str) -> str:
    """Return ``text`` as a name that can be part of a path."""
    return _NOT_A_NAME.sub("-", text).strip("-.") or "arm"


def hours_of(address: str) -> float | None:
    """[h] of use that the address of an emulated arm tells; None for all others."""
    found = _HOURS.search(address) if address.startswith("emulated:") else None
    return None if found is None else float(found[1])


def setup_of(arm: Arm) -> str:
    """Fingerprint of an arm's description: with another one, numbers are not to be compared."""
    text = hashlib.sha256()
    for item in fields(arm):
        value = getattr(arm, item.name)
        parts = (value.lower, value.upper) if item.name == "targets" else (value,)
        for part in parts:
            text.update(part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
    return text.hexdigest()[:16]
