"""Figures of the reproduction, in the report's style."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from PIL import Image

from rejoint.arms import Array
from rejoint.pages.report.figures import FONT, REACHED_MM, WIDE, canvas, heading, style
from rejoint.pages.report.palette import GROUND, INK, Look
from rejoint.system.files import write_whole

DPI = 120
COLOURS = 64
"""of a page's figure (chosen: enough for lines with soft edges; a third of the bytes)"""

CLOSE_MM = 45.0
"""[mm] half of the edge of a close-up"""
_TURN = np.linspace(0, 2 * np.pi, 61)

_VIEWS = {"top": (1, 0), "side": (0, 2)}
"""Which axes are drawn to the right and upwards; from above x points up, as one sees it over the base"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Ways:
    """One or more TCP paths in a panel of their own."""

    title: str
    look: Look
    paths: Sequence[Array]
    """each (T, 3) [m]; NaN rows are left out"""
    targets: Array
    """(K, 3) [m]"""
    numbered: bool = True
    """whether the targets are visited in their order"""
    radius: float = 0.010
    """[m] drawn around each target"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """A quantity over a training, with its range over several."""

    label: str
    look: Look
    value: Array
    """(K,) mean"""
    low: Array
    high: Array


def save(figure: Figure, path: Path) -> None:
    """Write a small PNG: few colours, no metadata."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, facecolor="white", metadata={"Software": None})
    small = Image.open(buffer).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    write_whole(path, lambda temporary: small.save(temporary, format="png", optimize=True))


def ways(panels: Sequence[Ways], limits: Array, views: Sequence[str] = ("top", "side")) -> Figure:
    """Draw every panel's paths from above and from the side, all on the same axes ``limits`` (3, 2) [m]."""
    low, high = 1e3 * limits.T
    columns = len(panels)
    width = min(WIDE, 3.1 * columns + 0.4)
    per_mm = (width - 0.7) / columns / max(high[_VIEWS[v][0]] - low[_VIEWS[v][0]] for v in views)
    heights = [per_mm * (high[_VIEWS[v][1]] - low[_VIEWS[v][1]]) for v in views]
    figure = Figure(figsize=(width, sum(heights) + 0.55 * len(views) + 0.2), layout="constrained", facecolor="none")
    grid = figure.subplots(len(views), columns, squeeze=False, height_ratios=heights)
    for column, panel in enumerate(panels):
        for row, view in enumerate(views):
            axes = grid[row, column]
            style(axes)
            across, up = _VIEWS[view]
            _ways(axes, panel, across, up)
            axes.set(xlim=(low[across], high[across]), ylim=(low[up], high[up]), aspect="equal")
            axes.xaxis.set_major_locator(MultipleLocator(50))
            axes.yaxis.set_major_locator(MultipleLocator(50))
            axes.set_xlabel(f"{'xyz'[across]} [mm]")
            if column == 0:
                axes.set_ylabel(f"{'xyz'[up]} [mm]")
            if view == "top":
                axes.invert_xaxis()
            if row == 0:
                heading(axes, panel.title)
    return figure


def _ways(axes: Axes, panel: Ways, across: int, up: int) -> None:
    thin = len(panel.paths) > 1
    for path in panel.paths:
        points = 1e3 * path[np.isfinite(path).all(axis=-1)]
        axes.plot(
            points[:, across], points[:, up], color=panel.look.colour, linewidth=0.8 if thin else 1.1,
            alpha=0.75 if thin else 1.0,
        )  # fmt: skip
        axes.plot(points[0, across], points[0, up], "s", markersize=4, color=panel.look.colour)
    for number, target in enumerate(1e3 * panel.targets, start=1):
        circle = 1e3 * panel.radius * np.stack([np.cos(_TURN), np.sin(_TURN)])
        axes.plot(target[across] + circle[0], target[up] + circle[1], color=INK, linewidth=0.7, alpha=0.7)
        axes.plot(target[across], target[up], "+", markersize=4, color=INK, markeredgewidth=0.8)
        if panel.numbered:
            axes.annotate(
                str(number), (target[across], target[up]), xytext=(5, 5), textcoords="offset points",
                fontsize=FONT - 1.5, color=INK,
            )  # fmt: skip


def over_training(steps: Array, panels: Sequence[tuple[str, Sequence[Curve]]]) -> Figure:
    """Draw curves with bands over the ``steps`` (K,) of each agent; one panel per named group of curves."""
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
        handles, labels, loc="outside upper left", ncols=len(labels), frameon=False, fontsize=FONT, labelcolor=INK,
        handlelength=2.8, columnspacing=1.6, borderpad=0.1,
    )  # fmt: skip
    return figure


def postures(arms: Sequence[tuple[str, Look, Array]], target: Array) -> Figure:
    """Draw arms at one target (3,) [m] from the side as lines through their joints (n + 1, 3) [m], whole and close up.

    The horizontal axis is the distance from the base's axis towards the target.
    """
    figure, grid = canvas((0.72 * WIDE, 3.9), 1, 2)
    heading_to = target[:2] / np.linalg.norm(target[:2])
    at = 1e3 * np.array([target[:2] @ heading_to, target[2]])
    circle = REACHED_MM * np.array([np.cos(_TURN), np.sin(_TURN)])
    for axes, name in zip(grid[0], ("the arms", "their tools"), strict=True):
        for label, look, joints in arms:
            out, height = 1e3 * joints[:, :2] @ heading_to, 1e3 * joints[:, 2]
            axes.plot(
                out, height, "-", color=look.colour, linewidth=4.0, alpha=0.75, label=label, solid_capstyle="round"
            )
            axes.plot(out[:-1], height[:-1], "o", color=look.colour, markersize=6, markerfacecolor=GROUND)
            axes.plot(out[-1], height[-1], look.marker, color=look.colour, markersize=8)
        axes.plot(*at, "+", color=INK, markersize=13, markeredgewidth=1.6, label="target, circle of 10 mm")
        axes.plot(at[0] + circle[0], at[1] + circle[1], color=INK, linewidth=0.9)
        axes.set(xlabel="distance from the base's axis [mm]", aspect="equal")
        heading(axes, name)
    grid[0, 0].axhline(0.0, color=INK, linewidth=0.9, alpha=0.6)
    grid[0, 0].set(ylabel="height [mm]")
    grid[0, 1].set(xlim=(at[0] - CLOSE_MM, at[0] + CLOSE_MM), ylim=(at[1] - CLOSE_MM, at[1] + CLOSE_MM))
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=3, frameon=False, fontsize=FONT, labelcolor=INK)
    return figure
