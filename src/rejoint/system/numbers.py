"""Checks of numbers that users give, and linear interpolation."""

import operator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rejoint.system.errors import InputError, first_line

SHORTEST_PERIOD, LONGEST_PERIOD = 0.001, 1.0
"""[s] control periods (chosen: faster than any servo bus)"""
FARTHEST = 0.1
"""[m] largest accepted error (chosen: more is in millimetres)"""

FARTHEST_PLACE = 10.0
"""[m] from the base of a place (chosen: what is farther is in millimetres)"""


def as_whole(what: str, given: int, least: int = 0) -> int:
    """Return a whole number of at ``least`` so much; InputError."""
    try:
        found = operator.index(given)
    except TypeError:
        found = least - 1
    if found < least:
        raise InputError(f"{what} {given!r}: expected a whole number from {least} on")
    return found


def as_seed(seed: int | None) -> int:
    """Return a seed, by default 0; InputError."""
    return as_whole("seed", 0 if seed is None else seed)


def as_period(period: ArrayLike | None) -> tuple[float, float] | None:
    """Shortest and longest control period [s]; InputError."""
    if period is None:
        return None
    if np.shape(period) == (2,):
        low, high = as_floats("period", period)
        if SHORTEST_PERIOD <= low <= high <= LONGEST_PERIOD:
            return float(low), float(high)
    raise InputError(
        f"period {period}: expected the shortest and the longest in seconds, such as (0.02, 0.03), between "
        f"{SHORTEST_PERIOD:g} and {LONGEST_PERIOD:g}"
    )


def as_positive(what: str, given: object, expected: str, most: float = np.inf) -> float:
    """Return a positive number of at most ``most``; InputError."""
    found = as_floats(what, np.nan if given is None else given, expected)
    if found.shape == () and 0.0 < found <= most:
        return float(found)
    raise InputError(f"{what}: expected {expected}, got {given}")


def as_within(what: str, given: object) -> float:
    """Distance [m] within which ``what`` counts as reached; InputError."""
    return as_positive(what, given, f"a positive distance in metres, at most {FARTHEST:g}", FARTHEST)


def as_seconds(what: str, given: object) -> float:
    """Return a positive, finite duration [s]; InputError."""
    return as_positive(what, given, "a positive, finite duration in seconds", 1e300)


def as_place(
    what: str,
    given: object,
    expected: str = "a point (3,) in metres",
    axes: tuple[int, ...] = (1,),
    most: float = FARTHEST_PLACE,
) -> NDArray[np.float64]:
    """Return a point (3,) [m], or points of so many ``axes``; InputError for anything else, and for millimetres."""
    place = as_floats(what, given, expected)
    if place.size and place.ndim in axes and place.shape[-1] == 3 and np.all(np.abs(place) <= most):  # no NaN is
        return place
    raise InputError(
        f"{what}: expected {expected}, of at most {most:g} m ({1e3 * most:g} millimetres), got {repr(given)[:80]}"
    )


def as_floats(what: str, given: object, expected: str = "numbers") -> NDArray[np.float64]:
    """Array of floats; InputError for text, dates, and ragged rows."""
    try:
        array = np.asarray(given)
        if array.dtype.kind in "biufO":  # the last: numbers of other kinds, such as Decimal
            return array.astype(float, copy=False)
        found = "text" if array.dtype.kind in "SU" else f"values of type {array.dtype.name}"
    except (TypeError, ValueError, RuntimeError) as error:  # the last: a tensor of PyTorch with its gradient
        found = f"rows of different length, or no numbers ({first_line(error)})"
    raise InputError(f"{what}: expected {expected}, found {found}")


def interpolated(
    time: NDArray[np.float64] | float, at: NDArray[np.float64], places: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Linear interpolation (..., n) of ``places`` (K, n) at ``at`` (K,) for ``time`` (...)."""
    return np.stack([np.interp(time, at, column) for column in places.T], axis=-1)
