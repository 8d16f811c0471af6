"""One look per controller, the same in every figure, table and theme.

Colours are the colour-blind-safe set of Okabe and Ito, "Color Universal Design" (2008), and indigo, teal and olive, on
a light ground; the dark variants are lightened by eye to keep a contrast of at least 4.5 : 1. No figure relies
on colour alone: marker, dash and hatch differ as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from rejoint.control.geared import RIVALS, inner_name

INK = "#1b1f24"
"""Text and axes; becomes the text colour of the page."""
GROUND = "#ffffff"
"""Inside of hollow markers and lines of hatches; becomes the ground of the page."""


@dataclass(frozen=True, kw_only=True)
class Look:
    """How one series is drawn."""

    colour: str
    """on a light ground"""
    dark: str
    """on a dark ground"""
    marker: str
    dash: str | tuple[float, tuple[float, ...]]
    hatch: str


GREY = Look(colour="#6b7280", dark="#a3abb8", marker="o", dash=(0, (1, 1.4)), hatch="")
ORANGE = Look(colour="#c47a00", dark="#f0ad33", marker="s", dash=(0, (5, 1.5)), hatch="///")
RED = Look(colour="#c44e00", dark="#f57c3a", marker="D", dash=(0, (4, 1.2, 1, 1.2)), hatch="xxx")
GREEN = Look(colour="#00815f", dark="#2cc79b", marker="^", dash=(0, (7, 1.5)), hatch="...")
PURPLE = Look(colour="#a8487c", dark="#df8fbb", marker="v", dash=(0, (3, 1, 1, 1, 1, 1)), hatch="\\\\\\")
BLUE = Look(colour="#0069a8", dark="#56b4e9", marker="P", dash="-", hatch="")
BROWN = Look(colour="#7a5c2e", dark="#c9a56b", marker="X", dash=(0, (2, 1)), hatch="+++")
INDIGO = Look(colour="#5a52c4", dark="#a9a3f5", marker="*", dash=(0, (6, 1, 1, 1)), hatch="ooo")
TEAL = Look(colour="#0f7c86", dark="#4cc3cd", marker="p", dash=(0, (2, 1, 4, 1)), hatch="---")
OLIVE = Look(colour="#6f7a00", dark="#bcc73e", marker="h", dash=(0, (5, 1, 1, 1, 5, 1)), hatch="**")

LOOKS = (GREY, ORANGE, RED, GREEN, PURPLE, BLUE, BROWN, INDIGO, TEAL, OLIVE)

CONTROLLERS = {
    "default": GREY,
    "pid-sum": ORANGE,
    "pid-literal": RED,
    "integrator": GREEN,
    "feedforward": PURPLE,
    "push": OLIVE,
    "shelf": INDIGO,
    "policy": BLUE,
    "predictive": TEAL,
}

UNDER_GAINS = {
    name: replace(CONTROLLERS[inner_name(name)], marker="*", dash=(0, (9, 2, 1.5, 2))) for name in RIVALS
}  # fmt: skip
"""Controllers under tuned gains of the servos: the colours of the same ones without, and stars"""


def look_of(controller: str) -> Look:
    """Return the look of a controller; one that is unknown is brown."""
    return UNDER_GAINS.get(controller) or CONTROLLERS.get(controller, BROWN)


def colour_number(controller: str) -> int:
    """Return which of `LOOKS` has the colours of a controller."""
    return [look.colour for look in LOOKS].index(look_of(controller).colour)
