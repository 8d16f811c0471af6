"""The figure of where the tool was and where the encoders saw it."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.pages.report.figures import FONT, HALF, WIDE, canvas, heading, legend
from rejoint.pages.report.palette import GREY, INK, ORANGE, Look

LONGEST = 0.15
"""Share of the figure that the longest arrow takes at most (chosen: arrows stay apart)"""
_SCALES = (1, 2, 5, 10, 20, 50)


def arrow_scale(seen: Array, tool: Array) -> int:
    """Return how many times larger than the figure arrows from ``seen`` to ``tool`` (M, 3) [m] are best drawn."""
    extent = float(np.ptp(seen, axis=0).max())
    longest = float(np.linalg.norm(tool - seen, axis=1).max())
    fits = [scale for scale in _SCALES if scale * longest <= LONGEST * extent]
    return fits[-1] if fits else 1


def arrows(seen: Array, tool: Array, wrong: NDArray[np.bool_]) -> Figure:
    """Draw arrows from where the encoders saw the tool to where it was, (M, 3) [m] each, from above and from the side.

    Arrows are `arrow_scale` times as long as they are; points that are ``wrong`` (M,) have another look.
    """
    scale = arrow_scale(seen, tool)
    figure, grid = canvas((WIDE, 0.45 * WIDE), 1, 2)
    views = (("from above", 1, 0), ("from the side", 0, 2))
    for axes, (name, across, up) in zip(grid[0], views, strict=True):
        for label, rows, look in (("measured point", ~wrong, ORANGE), ("does not fit to the others", wrong, GREY)):
            if rows.any():
                _draw(axes, 1e3 * seen[rows][:, [across, up]], 1e3 * tool[rows][:, [across, up]], scale, look, label)
        axes.set(xlabel="xyz"[across] + " [mm]", ylabel="xyz"[up] + " [mm]", aspect="equal", adjustable="datalim")
        axes.margins(0.12)
        heading(axes, name)
    axes = grid[0, 0]
    axes.invert_xaxis()
    axes.plot([], [], "o", markersize=5, color=INK, markerfacecolor="none", label="where the encoders saw the tool")
    order = ("where the encoders saw the tool", "measured point", "does not fit to the others")
    legend(figure, axes, order)
    figure.supxlabel(
        f"arrows {scale} times as long as they are" if scale > 1 else "arrows to scale", fontsize=FONT, color=INK
    )
    return figure


def _draw(axes: Axes, seen: Array, tool: Array, scale: int, look: Look, label: str) -> None:
    """Draw points and arrows (m, 2) [mm]."""
    away = scale * (tool - seen)
    axes.plot(*seen.T, "o", markersize=5, color=INK, markerfacecolor="none", linewidth=0)
    axes.plot(*(seen + away).T, look.marker, markersize=4, color=look.colour, label=label)
    axes.quiver(
        *seen.T, *away.T, angles="xy", scale_units="xy", scale=1.0, color=look.colour, width=0.0035 * HALF / WIDE * 2,
        headwidth=4,
    )  # fmt: skip
