"""Numbers as users give them: lists, tuples, arrays."""

from __future__ import annotations

import numpy as np

from rejoint.arms.arm import Array
from rejoint.system.errors import InputError

_SHOWN = 80  # letters of what was given that an error shows


def numbers(given: object, expected: str) -> Array:
    """Return an array of floats of any shape; InputError for what holds no numbers, after what was ``expected``."""
    try:
        return np.asarray(given, dtype=float)
    except (TypeError, ValueError) as error:  # words, None, generators, rows of different lengths
        raise InputError(f"{expected}, got {given!r:.{_SHOWN}}") from error
