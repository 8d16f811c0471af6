"""Numbers as a reader wants them: rounded to what they are worth, with units, never `nan`."""

from __future__ import annotations

import math

UNKNOWN = "not known"
NEVER = "never"
MOST_PLACES = 5
"""Decimals at most: with the units of the page, what is smaller is rounding noise and shown as 0 (chosen)"""


def number(value: float | None, digits: int = 3, unit: str = "") -> str:
    """Return the value with ``digits`` significant digits and its unit; `UNKNOWN` if there is none."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    return f"{_significant(value, digits)}{_suffix(unit)}"


def spread(mean: float | None, std: float | None, digits: int = 3, unit: str = "") -> str:
    """Return ``mean ± std`` with the decimals of the mean's significant digits."""
    if mean is None or not math.isfinite(mean):
        return UNKNOWN
    places = _places(mean, digits)
    text = f"{mean:.{places}f}"
    if std is not None and math.isfinite(std):
        text += f" ± {std:.{places}f}"
    return text + _suffix(unit)


def interval(low: float | None, high: float | None, digits: int = 3, unit: str = "", factor: float = 1.0) -> str:
    """Return ``low to high`` times ``factor``; both with the decimals of the larger one.

    Empty if an end is missing, or if both are the same: earlier versions wrote such ends where there was a single
    result, which says nothing about another one.
    """
    if low is None or high is None or low == high or not (math.isfinite(low) and math.isfinite(high)):
        return ""
    low, high = low * factor, high * factor
    places = _places(max(abs(low), abs(high)), digits)
    return f"{_zero(low, places)} to {_zero(high, places)}{_suffix(unit)}"


def _significant(value: float, digits: int) -> str:
    return _zero(value, _places(value, digits))


def _zero(value: float, places: int) -> str:
    text = f"{value:.{places}f}"
    return text.removeprefix("-") if float(text) == 0 else text


def _places(value: float, digits: int) -> int:
    """Return how many decimals show ``digits`` significant digits of the value."""
    if abs(value) < 10.0**-MOST_PLACES:
        return digits - 1
    rounded = float(f"{value:.{digits - 1}e}")
    return min(max(0, digits - 1 - math.floor(math.log10(abs(rounded)))), MOST_PLACES)


def _suffix(unit: str) -> str:
    return f"\N{NO-BREAK SPACE}{unit}" if unit else ""
