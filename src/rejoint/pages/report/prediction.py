"""Figures of predictions, motion by motion and over time, and of what a fit cannot tell apart. Pure functions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.pages.report.figures import FONT, HALF, WIDE, Series, canvas, legend, plain_log, whiskers
from rejoint.pages.report.palette import BLUE, INK, ORANGE, Look
from rejoint.pages.report.words import short

FLOOR_MM = 0.1
"""[mm] below which an error over time is not drawn: less than an encoder step makes of it (chosen)"""


SPANS = 60
"""Parts of a motion that an error over time is averaged over (chosen: a line of the figure stays a line)"""


def per_motion(names: Sequence[str], series: Sequence[Series], own: Series | None, xlabel: str) -> Figure:
    """Draw one row per motion (K) with a mark per series, on a logarithmic axis.

    ``own`` is what the arm itself varies by: one value with its range, drawn across all rows.
    """
    figure, grid = canvas((WIDE, 1.2 + 0.23 * len(names)))
    axes, rows = grid[0, 0], np.arange(len(names))
    for one in series:
        axes.plot(
            one.value, rows, one.look.marker, color=one.look.colour, markersize=6, linestyle="none", label=one.label
        )
    labels = [one.label for one in series]
    if own is not None:
        axes.axvline(own.value[0], color=INK, linewidth=1.0, linestyle=(0, (4, 3)), label=own.label)
        if own.low is not None and own.high is not None:
            axes.axvspan(own.low[0], own.high[0], color=INK, alpha=0.08, linewidth=0)
        labels.append(own.label)
    axes.set_xscale("log")
    plain_log(axes.xaxis)
    axes.set_yticks(rows, [short(name, 34) for name in names])
    axes.set(xlabel=xlabel, ylim=(len(names) - 0.5, -0.5))
    legend(figure, axes, labels)
    return figure


def means(series: Sequence[Series], xlabel: str) -> Figure:
    """Draw one bar per series with its value and its interval."""
    figure, grid = canvas((HALF, 0.7 + 0.36 * len(series)))
    axes = grid[0, 0]
    for y, one in enumerate(series):
        axes.barh(
            y, one.value[0], height=0.6, color=one.look.colour, hatch=one.look.hatch, edgecolor="#ffffff", linewidth=0,
            xerr=whiskers(one), ecolor=INK, error_kw={"elinewidth": 0.8, "capsize": 2.5},
        )  # fmt: skip
        end = one.value[0] if one.high is None else max(one.high[0], one.value[0])
        axes.annotate(
            f"{one.value[0]:.3g}", (end, y), xytext=(5, 0), textcoords="offset points", va="center", fontsize=FONT,
            color=INK,
        )  # fmt: skip
    axes.set_yticks(range(len(series)), [short(one.label, 30) for one in series])
    widest = max(float(np.nanmax([one.value[0], *(one.high if one.high is not None else [])])) for one in series)
    axes.set(xlabel=xlabel, ylim=(len(series) - 0.5, -0.5), xlim=(0, 1.18 * widest))
    axes.grid(visible=False, axis="y")
    return figure


def tool_over_time(time: Array, series: Sequence[Series], shaded: NDArray[np.bool_]) -> Figure:
    """Draw the tool's prediction error [mm] of each series (T,) over ``time`` (T,) [s]; ``shaded`` (T,) is contact.

    Several lines that jump in every control cycle cannot be told apart, so each is a root mean square over
    a sixtieth of the time, or a second if that is more.
    """
    figure, grid = canvas((WIDE, 3.4))
    axes, span = grid[0, 0], max(1.0, float(time[-1] - time[0]) / SPANS)
    for one in series:
        axes.plot(
            time, np.maximum(running_rms(time, one.value, span), FLOOR_MM), color=one.look.colour,
            linestyle=one.look.dash, linewidth=1.2, label=one.label,
        )  # fmt: skip
    axes.set_yscale("log")
    plain_log(axes.yaxis)
    axes.set(xlabel="time [s]", ylabel=f"error of the tool [mm], rms over {span:.0f} s", xlim=(time[0], time[-1]))
    labels = [one.label for one in series]
    labels += _shade(axes, time, shaded)
    legend(figure, axes, labels)
    return figure


def running_rms(time: Array, values: Array, span: float) -> Array:
    """Root mean square (T,) of what lies within half a ``span`` [s] of each time."""
    total = np.concatenate([[0.0], np.cumsum(values**2)])
    first = np.searchsorted(time, time - span / 2, side="left")
    last = np.searchsorted(time, time + span / 2, side="right")
    return np.asarray(np.sqrt((total[last] - total[first]) / (last - first)))


def joints_over_time(
    time: Array, names: Sequence[str], residual: Array, look: Look, shaded: NDArray[np.bool_]
) -> Figure:
    """Draw predicted minus measured positions (n, T) [deg] over ``time`` (T,) [s], one panel per joint."""
    figure, grid = canvas((WIDE, 0.5 + 1.0 * len(names)), len(names))
    for axes, name, values in zip(grid[:, 0], names, residual, strict=True):
        axes.plot(time, values, color=look.colour, linewidth=1.0)
        axes.axhline(0.0, color=INK, linewidth=0.6, alpha=0.6)
        axes.yaxis.set_major_locator(MaxNLocator(3))
        axes.set_title(f"{name} [deg]", loc="left", fontsize=FONT, color=INK)
        _shade(axes, time, shaded)
    grid[-1, 0].set(xlabel="time [s]", xlim=(time[0], time[-1]))
    return figure


def correlations(names: Sequence[str], groups: Sequence[str], matrix: Array) -> Figure:
    """Draw correlations (k, k) as squares whose side is the size and whose colour and fill the sign.

    ``groups`` (k,) name what belongs together, such as the joint of each parameter; equal neighbours form a block.
    """
    k = len(names)
    size = min(max(2.2 + 0.2 * k, HALF), WIDE)
    figure, grid = canvas((size, size - 0.3))
    axes = grid[0, 0]
    for i in range(k):
        for j in range(k):
            value, look = float(matrix[i, j]), BLUE if matrix[i, j] >= 0 else ORANGE
            side = 0.92 * min(abs(value), 1.0) ** 0.5
            axes.add_patch(
                Rectangle(
                    (j - side / 2, i - side / 2), side, side, facecolor=look.colour if value >= 0 else "none",
                    edgecolor=look.colour, linewidth=1.0,
                )
            )  # fmt: skip
    for edge in [i - 0.5 for i in range(1, k) if groups[i] != groups[i - 1]]:
        axes.axhline(edge, color=INK, linewidth=0.6, alpha=0.5)
        axes.axvline(edge, color=INK, linewidth=0.6, alpha=0.5)
    axes.set_xticks(range(k), list(names), rotation=90)
    axes.set_yticks(range(k), [f"{group}  {name}" for group, name in zip(groups, names, strict=True)])
    axes.tick_params(labelsize=FONT - 1.5, length=0)
    axes.set(xlim=(-0.5, k - 0.5), ylim=(k - 0.5, -0.5), aspect="equal")
    axes.grid(visible=False)
    return figure


def _shade(axes: Axes, time: Array, shaded: NDArray[np.bool_]) -> list[str]:
    """Shade the time in contact; returns its label where there is any."""
    if not shaded.any():
        return []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], shaded, [False]]).astype(int)))
    for number, (first, last) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
        span = axes.axvspan(time[first], time[min(last, len(time) - 1)], color=INK, alpha=0.10, linewidth=0)
        if number == 0:
            span.set_label("on the table")
    return ["on the table"]
