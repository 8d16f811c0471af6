"""Figures of the reproduction."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

from rejoint.arms import Array
from rejoint.pages.html import INK
from rejoint.pages.report.figures import FONT, WIDE, Series, canvas, heading
from rejoint.system.files import write_whole

DPI = 120
COLOURS = 64
"""of a figure; chosen"""


def save(figure: Figure, path: Path) -> None:
    """Write a small PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, facecolor="white", metadata={"Software": None})
    small = Image.open(buffer).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    write_whole(path, lambda temporary: small.save(temporary, format="png", optimize=True))


def over_training(steps: Array, panels: Sequence[tuple[str, Sequence[Series]]]) -> Figure:
    """Draw curves with bands over ``steps`` (K,); a panel per group."""
    figure, grid = canvas((WIDE, 3.5), 1, len(panels))
    for axes, (name, curves) in zip(grid[0], panels, strict=True):
        for curve in curves:
            look = curve.look
            axes.plot(steps, curve.value, color=look.colour, linestyle=look.dash, linewidth=1.8, label=curve.label)
            axes.fill_between(steps, curve.low, curve.high, color=look.colour, alpha=0.18, linewidth=0)
        axes.set(xlabel="time steps of each agent", xlim=(steps[0], steps[-1]))
        heading(axes, name)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="outside upper left",
        ncols=len(labels),
        frameon=False,
        fontsize=FONT,
        labelcolor=INK,
        handlelength=2.8,
        columnspacing=1.6,
        borderpad=0.1,
    )
    return figure
