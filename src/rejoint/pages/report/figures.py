"""Figures as pure functions from arrays to a matplotlib `Figure`.

Nothing here knows where the numbers come from. Figures are made without pyplot, hence without
global state. Each keeps to a size that stays readable on a phone: wide matter is split into
several figures, which the page places side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, MultipleLocator, NullFormatter
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.pages.report.palette import GROUND, INK, Look

FONT = 9.5
"""[pt] chosen: 13 px on the page, about the size of its small print, and still legible at half that"""
WIDE, HALF, THIRD = 10.4, 5.2, 3.4
"""[inch] widths of figures that stand alone, in two and in three columns"""
LEGEND_COLUMNS = 6
LETTERS = 36
"""letters that fit side by side below a figure of a third of the page"""
REACHED_MM = 10.0
"""[mm] radius within which a target counts as reached; Park et al. 2024, section IV.A"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Series:
    """One group of values with its name and look."""

    label: str
    look: Look
    value: Array
    """(K,) centre; NaN is left out"""
    low: Array | None = None
    """(K,) lower end of the interval or spread"""
    high: Array | None = None
    """(K,) upper end"""
    hollow: NDArray[np.bool_] | None = None
    """(K,) values to be drawn hollow, such as those that are assumed and not measured"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Path3:
    """The way of a TCP through a sequence of targets."""

    label: str
    look: Look
    tcp: Array
    """(T, 3) [m]"""
    targets: Array
    """(K, 3) [m] in the order of the visit"""
    radius: float = REACHED_MM / 1e3
    """[m] drawn around each target"""


def canvas(
    size: tuple[float, float], rows: int = 1, columns: int = 1, widths: Sequence[float] | None = None
) -> tuple[Figure, NDArray[Any]]:
    """Make an empty figure of ``size`` [inch] with a grid of styled axes (rows, columns) that share x by column."""
    figure = Figure(figsize=size, layout="constrained", facecolor="none")
    grid = figure.subplots(rows, columns, squeeze=False, sharex="col", width_ratios=widths)
    for axes in grid.flat:
        style(axes)
    return figure, grid


def style(axes: Axes) -> None:
    """Give axes the look of all figures."""
    axes.set_facecolor("none")
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set(color=INK, alpha=0.45, linewidth=0.8)
    axes.tick_params(which="both", colors=INK, labelsize=FONT, length=3, width=0.7)
    axes.grid(visible=True, color=INK, alpha=0.12, linewidth=0.6)
    for text in (axes.xaxis.label, axes.yaxis.label, axes.title):
        text.set(color=INK, fontsize=FONT)


def heading(axes: Axes, text: str) -> None:
    """Write the name of a panel."""
    axes.set_title(text, loc="left", fontsize=FONT + 0.5, color=INK, fontweight="bold")


def legend(figure: Figure, axes: Axes, order: Sequence[str]) -> None:
    """Put the labels above the figure in the given order."""
    found = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    labels = [label for label in order if label in found]
    figure.legend(
        [found[label] for label in labels], labels, loc="outside upper left", ncols=min(len(labels), LEGEND_COLUMNS),
        frameon=False, fontsize=FONT, labelcolor=INK, handlelength=2.6, columnspacing=1.4, borderpad=0.1,
    )  # fmt: skip


def plain_log(axis: Axis, digits: tuple[float, ...] = (1.0, 2.0, 5.0)) -> None:
    """Label a logarithmic axis with plain numbers."""
    axis.set_major_locator(LogLocator(base=10, subs=digits))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def error_per_target(series: Sequence[Series], reference: Series | None = None) -> Figure:
    """Draw the TCP error [mm] at each of K targets as grouped bars, with the success radius.

    ``reference`` (one value, with or without a range) is drawn across all targets.
    """
    figure, grid = canvas((WIDE, 3.2))
    axes, count = grid[0, 0], len(series[0].value)
    width = 0.8 / len(series)
    for i, one in enumerate(series):
        at = np.arange(1, count + 1) + (i - (len(series) - 1) / 2) * width
        axes.bar(
            at, one.value, width * 0.92, label=one.label, color=one.look.colour, hatch=one.look.hatch,
            edgecolor=GROUND, linewidth=0.0, yerr=whiskers(one), ecolor=INK, error_kw={"elinewidth": 0.7},
        )  # fmt: skip
    if reference is not None:
        colour = reference.look.colour
        axes.axhline(
            reference.value[0], color=colour, linewidth=2.0, linestyle=reference.look.dash, label=reference.label
        )
        if reference.low is not None and reference.high is not None:
            axes.axhspan(reference.low[0], reference.high[0], color=colour, alpha=0.15, linewidth=0)
    reached = f"counts as reached: {REACHED_MM:g} mm"
    axes.axhline(REACHED_MM, color=INK, linewidth=0.9, linestyle=(0, (4, 3)), label=reached)
    axes.set(xlabel="target", ylabel="error [mm]", xlim=(0.4, count + 0.6), ylim=(0, None))
    axes.set_xticks(np.arange(1, count + 1))
    axes.grid(visible=False, axis="x")
    legend(figure, axes, [one.label for one in (*series, *([reference] if reference else []))] + [reached])
    return figure


def whiskers(one: Series) -> Array | None:
    """Lengths (2, K) of the error bars below and above; None without an interval."""
    if one.low is None or one.high is None:
        return None
    return np.clip(np.stack([one.value - one.low, one.high - one.value]), 0, None)


def intervals(rows: Sequence[Series], xlabel: str, *, log: bool = False) -> Figure:
    """Draw one row per series: its first value with its interval, on a common axis.

    A second value of a series, where there is one, is drawn hollow in the same row.
    """
    figure, grid = canvas((HALF, 0.75 + 0.3 * len(rows)))
    axes = grid[0, 0]
    for y, one in enumerate(rows):
        bars = whiskers(one)
        for k, value in enumerate(one.value):
            axes.errorbar(
                value, y, xerr=None if bars is None else bars[:, k : k + 1], fmt=one.look.marker, markersize=6,
                color=one.look.colour, markerfacecolor=one.look.colour if k == 0 else GROUND, capsize=2.5,
                linewidth=1.6,
            )  # fmt: skip
    if log:
        axes.set_xscale("log")
        plain_log(axes.xaxis)
    else:
        axes.set_xlim(left=0)
    axes.set_yticks(range(len(rows)), [one.label for one in rows])
    axes.set(xlabel=xlabel, ylim=(len(rows) - 0.5, -0.5))
    return figure


def trajectory(path: Path3, limits: Array) -> Figure:
    """Draw one path from above (x up, y to the left, as one sees it over the base) and from the side (x, z).

    ``limits`` (3, 2) [m] are the same for every path that is to be compared.
    """
    low, high = limits[:, 0] * 1e3, limits[:, 1] * 1e3
    spans = high - low
    scale = (HALF - 1.6) / (spans[1] + spans[0])
    figure, grid = canvas((HALF, 0.78 + scale * max(spans[0], spans[2])), 1, 2, (spans[1], spans[0]))
    views = (("from above", 1, 0), ("from the side", 0, 2))
    for axes, (name, across, up) in zip(grid[0], views, strict=True):
        _path(axes, path, across, up)
        axes.set(xlim=(low[across], high[across]), ylim=(low[up], high[up]), aspect="equal", anchor="N")
        axes.set(xlabel="xyz"[across] + " [mm]", ylabel="xyz"[up] + " [mm]")
        for axis, span in ((axes.xaxis, spans[across]), (axes.yaxis, spans[up])):
            axis.set_major_locator(MultipleLocator(50 if span < 400 else 100))
        heading(axes, name)
    grid[0, 0].invert_xaxis()
    return figure


def _path(axes: Axes, path: Path3, across: int, up: int) -> None:
    points, goals = path.tcp * 1e3, path.targets * 1e3
    axes.plot(points[:, across], points[:, up], color=path.look.colour, linewidth=1.1, label=path.label)
    axes.plot(points[0, across], points[0, up], "s", markersize=4.5, color=path.look.colour)
    angle = np.linspace(0, 2 * np.pi, 41)
    for number, goal in enumerate(goals, start=1):
        axes.plot(
            goal[across] + path.radius * 1e3 * np.cos(angle), goal[up] + path.radius * 1e3 * np.sin(angle),
            color=INK, linewidth=0.7, alpha=0.7,
        )  # fmt: skip
        axes.plot(goal[across], goal[up], "+", markersize=4, color=INK, markeredgewidth=0.8)
        axes.annotate(
            str(number), (goal[across], goal[up]), xytext=(5, 5), textcoords="offset points", fontsize=FONT - 1.5,
            color=INK,
        )  # fmt: skip


def error_over_time(time: Array, series: Sequence[Series]) -> Figure:
    """Draw the encoder error [mm] over ``time`` (K,) [s] since the target was set, log axis, with its spread."""
    figure, grid = canvas((WIDE, 3.8))
    axes = grid[0, 0]
    for one in series:
        axes.plot(time, one.value, color=one.look.colour, linestyle=one.look.dash, linewidth=1.7, label=one.label)
        if one.low is not None and one.high is not None:
            axes.fill_between(time, one.low, one.high, color=one.look.colour, alpha=0.16, linewidth=0)
    axes.set_yscale("log")
    plain_log(axes.yaxis)
    for level in (10.0, 5.0, 2.0):
        axes.axhline(level, color=INK, linewidth=0.6, alpha=0.5, linestyle=(0, (4, 3)))
    axes.set(xlabel="time since the target was set [s]", ylabel="encoder error [mm]", xlim=(time[0], time[-1]))
    legend(figure, axes, [one.label for one in series])
    return figure


def by_joint(
    title: str, joints: Sequence[str], measured: Series, reference: Series | None = None, *, log: bool = False
) -> Figure:
    """Draw one quantity per joint with its interval over a reference value or range.

    ``reference`` gives a value per joint (a line), a range (a pale bar), or both; NaN is left out.
    """
    figure, grid = canvas((THIRD, 2.4))
    axes, at = grid[0, 0], np.arange(len(joints))
    if reference is not None:
        _reference(axes, at, reference)
    hollow = np.zeros(len(joints), dtype=bool) if measured.hollow is None else measured.hollow
    bars = whiskers(measured)
    for chosen, face in ((~hollow, measured.look.colour), (hollow, GROUND)):
        if chosen.any():
            axes.errorbar(
                at[chosen], measured.value[chosen], yerr=None if bars is None else bars[:, chosen],
                fmt=measured.look.marker, color=measured.look.colour, markerfacecolor=face, markersize=5.5, capsize=2.5,
                linewidth=1.4,
            )  # fmt: skip
    crowded = max(map(len, joints)) * len(joints) > LETTERS
    slant = {"rotation": 35, "ha": "right", "rotation_mode": "anchor"} if crowded else {}
    axes.set_xticks(at, list(joints), **slant)
    axes.set_xlim(-0.6, len(joints) - 0.4)
    axes.use_sticky_edges = False
    axes.margins(y=0.12)
    if log:
        axes.set_yscale("log")
        plain_log(axes.yaxis, (1.0, 2.0, 3.0, 5.0))
    else:
        axes.yaxis.set_major_locator(MaxNLocator(5))
        if axes.get_ylim()[0] > 0 or _none_negative(measured):
            axes.set_ylim(bottom=0)
    axes.grid(visible=False, axis="x")
    heading(axes, title)
    return figure


def _none_negative(one: Series) -> bool:
    parts = [part for part in (one.value, one.low) if part is not None]
    return not any((part < 0).any() for part in parts)


def _reference(axes: Axes, at: NDArray[np.intp], reference: Series) -> None:
    colour = reference.look.colour
    if reference.low is not None and reference.high is not None:
        span = reference.high - reference.low
        axes.bar(at, span, bottom=reference.low, width=0.62, color=colour, alpha=0.22, linewidth=0)
    known = np.isfinite(reference.value)
    axes.hlines(reference.value[known], at[known] - 0.31, at[known] + 0.31, color=colour, linewidth=2.2)


def ranked_bars(labels: Sequence[str], values: Array, looks: Sequence[Look], xlabel: str) -> Figure:
    """Draw horizontal bars with their values (K,) written at the end."""
    figure, grid = canvas((HALF, 0.6 + 0.34 * len(labels)))
    axes = grid[0, 0]
    for y, (value, look) in enumerate(zip(values, looks, strict=True)):
        axes.barh(y, value, height=0.62, color=look.colour, hatch=look.hatch, edgecolor=GROUND, linewidth=0)
        if np.isfinite(value):
            axes.annotate(
                f"{value:.3g}", (value, y), xytext=(4, 0), textcoords="offset points", va="center", fontsize=FONT,
                color=INK,
            )  # fmt: skip
    axes.set_yticks(range(len(labels)), list(labels))
    axes.set(xlabel=xlabel, ylim=(len(labels) - 0.5, -0.5), xlim=(0, 1.15 * np.nanmax(values)))
    axes.grid(visible=False, axis="y")
    return figure


def training_curves(steps: Array, curves: Sequence[tuple[str, Array]], look: Look) -> Figure:
    """Draw each named curve (K,) over environment ``steps`` (K,), one panel above the other."""
    figure, grid = canvas((WIDE, 0.5 + 1.35 * len(curves)), len(curves))
    for axes, (name, values) in zip(grid[:, 0], curves, strict=True):
        axes.plot(steps / 1e6, values, color=look.colour, linewidth=1.5)
        axes.yaxis.set_major_locator(MaxNLocator(4))
        heading(axes, name)
    grid[-1, 0].set(xlabel="environment steps [million]", xlim=(steps[0] / 1e6, steps[-1] / 1e6))
    return figure
