"""Memory that is free, given back to the system."""

from __future__ import annotations

import ctypes
import sys
from functools import cache
from typing import Any


def give_back() -> None:
    """Give free memory back, where the C library can (glibc); elsewhere nothing happens.

    What a stage has worked with is freed at its end, but glibc keeps it for later, in holes that a later stage with
    larger arrays does not fill: the process grows by it. It takes some milliseconds.
    """
    trim = _trim()
    if trim is not None:
        trim(0)


@cache
def _trim() -> Any:  # noqa: ANN401
    """Return glibc's `malloc_trim`; None where the C library is another one."""
    try:
        return ctypes.CDLL(None).malloc_trim if sys.platform == "linux" else None
    except (OSError, AttributeError):
        return None
