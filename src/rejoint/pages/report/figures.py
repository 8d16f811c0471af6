"""Figures of trials: paths through targets and errors over time."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, MultipleLocator, NullFormatter
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, tcp_position
from rejoint.logs.runlog import RunLog
from rejoint.pages.html import GROUND, INK, LOOKS, Look
from rejoint.system.files import write_whole


@dataclass(frozen=True, kw_only=True, eq=False)
class TargetSpan:
    """The time of one target."""

    target: Array
    """(3,) [m]"""
    aim: Array
    """(3,) [m] corrected target at the end"""
    time: Array
    """(T,) [s] since the target, from 0"""
    encoder_error: Array
    """(T,) [m] encoder TCP from the corrected target"""
    true_error: Array
    """(T,) [m] true TCP from the target; NaN: unknown"""


def encoder_path(arm: Arm, log: RunLog) -> Array:
    """TCP (T, 3) [m] by the encoders."""
    return tcp_position(arm, log.position)


def visits(arm: Arm, log: RunLog) -> tuple[TargetSpan, ...]:
    """Split a log by target."""
    tcp, aim = encoder_path(arm, log), log.target if log.aim is None else log.aim
    found = []
    for start, stop in _spans(log):
        # The target was set when the last row of the previous one was read.
        rows = np.arange(max(start - 1, 0), stop)
        target, aims = log.target[start], aim[np.maximum(rows, start)]
        found.append(
            TargetSpan(
                target=target,
                aim=aims[-1],
                time=log.time[rows] - log.time[rows[0]],
                encoder_error=np.linalg.norm(tcp[rows] - aims, axis=1),
                true_error=np.linalg.norm(log.true_tcp[rows] - target, axis=1),
            )
        )
    return tuple(found)


def _spans(log: RunLog) -> list[tuple[int, int]]:
    if not len(log):
        return []
    filled = np.nan_to_num(log.target, nan=np.inf)  # NaN differs from itself
    cuts = np.flatnonzero((filled[1:] != filled[:-1]).any(axis=1)) + 1
    edges = [0, *cuts.tolist(), len(log)]
    return [(a, b) for a, b in pairwise(edges) if np.isfinite(log.target[a]).all()]


def error_at(visit: TargetSpan, time: Array) -> Array:
    """Return encoder error (K,) [m] last read at ``time`` (K,) [s]; NaN after the end."""
    rows = np.searchsorted(visit.time, time + 1e-9, side="right") - 1
    error: NDArray[np.float64] = visit.encoder_error[np.clip(rows, 0, None)]
    return np.where(time > visit.time[-1] + _grain(visit), np.nan, error)


def _grain(visit: TargetSpan) -> float:
    return float(np.diff(visit.time).max(initial=0.0))


def spread_over_time(all_visits: Sequence[TargetSpan], time: Array) -> tuple[Array, Array, Array]:
    """Median, 10th and 90th percentile (K,) [m] of encoder errors; NaN once half have ended."""
    errors = np.stack([error_at(visit, time) for visit in all_visits])
    enough = np.isfinite(errors).sum(axis=0) * 2 >= len(errors)
    result = np.full((3, len(time)), np.nan)
    result[:, enough] = np.nanpercentile(errors[:, enough], [50, 10, 90], axis=0)
    return result[0], result[1], result[2]


def bounds(paths: Sequence[Array], margin: float = 0.012) -> Array:
    """Box (3, 2) [m] around ``paths`` (T, 3) [m] (margin chosen)."""
    points = np.concatenate(list(paths))
    return np.stack([points.min(axis=0) - margin, points.max(axis=0) + margin], axis=1)


PNG_DPI = 160
"""[1/inch] (chosen)"""

_ID = re.compile(r'(\bid="|xlink:href="#|url\(#)')
_UNSAFE = re.compile(r"[^A-Za-z0-9_-]+")
_HEAD = re.compile(r"^.*?(?=<svg)", re.DOTALL)
_SIZE = re.compile(r'<svg [^>]*viewBox="([^"]+)"[^>]*>')
_METADATA = re.compile(r"\s*<metadata>.*?</metadata>", re.DOTALL)
_NOISE = re.compile(r" font-family: [^;]*;|\s*<style type=\"text/css\">.*?</style>|(?<=[\dz]) (?=\n)", re.DOTALL)


def inline_svg(figure: Figure, key: str, alt: str) -> Markup:
    """Figure as SVG in the page's colours; ``key`` makes identifiers unique, ``alt`` is read out."""
    buffer = io.StringIO()
    figure.draw_without_rendering()
    figure.set_layout_engine(None)  # the layout is found now; any engine has every file drawn twice
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": key}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = _NOISE.sub("", _METADATA.sub("", _HEAD.sub("", buffer.getvalue())))
    text = _ID.sub(lambda match: f"{match[1]}{key}-", text)
    text = text.replace(INK, "currentColor").replace(GROUND, "var(--ground)")
    for number, look in enumerate(LOOKS):
        text = text.replace(look.colour, f"var(--look-{number})")
    label = str(escape(alt)).replace("\\", "\\\\")
    head = f'<svg class="figure" role="img" aria-label="{label}" viewBox="\\1" style="max-width:{_width(figure)}">'
    return Markup(_SIZE.sub(head, text, count=1))  # noqa: S704  (made by matplotlib, which escapes its text)


def _width(figure: Figure) -> str:
    return f"{figure.get_figwidth() * 96:.0f}px"


def save_png(figure: Figure, path: Path) -> None:
    """Write the figure as PNG on white."""
    write_whole(
        path,
        lambda temporary: figure.savefig(
            temporary, format="png", dpi=PNG_DPI, facecolor="white", metadata={"Software": None}
        ),
    )


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One embedded figure."""

    svg: Markup
    heading: str = ""
    caption: str = ""


class Gallery:
    """Collects the figures of a page; `save` writes them."""

    def __init__(self) -> None:
        self._figures: dict[str, Figure] = {}

    def show(self, key: str, figure: Figure, *, alt: str, heading: str = "", caption: str = "") -> Picture:
        """Add a figure under a unique ``key`` (its file name); returns it for the page."""
        key = _UNSAFE.sub("-", key)
        if key in self._figures:
            raise ValueError(f"two figures are called {key!r}")
        self._figures[key] = figure
        return Picture(svg=inline_svg(figure, key, alt), heading=heading, caption=caption)

    def save(self, folder: Path) -> tuple[Path, ...]:
        """Write figures as ``folder/KEY.png``."""
        paths = tuple(folder / f"{key}.png" for key in self._figures)
        for key, figure in self._figures.items():
            save_png(figure, folder / f"{key}.png")
        return paths


FONT = 9.5
"""[pt] (chosen: legible at half size)"""
WIDE, HALF = 10.4, 5.2
"""[inch] figure widths, one and two columns"""
LEGEND_COLUMNS = 6
REACHED_MM = 10.0
"""[mm] of a reached target; Park et al. 2024, section IV.A"""


TURN = np.linspace(0, 2 * np.pi, 61)
"""[rad] of a circle"""
# Which axes are drawn to the right and upwards; from above x points up, as one sees it over the base
_VIEWS = {"top": (1, 0), "side": (0, 2)}


@dataclass(frozen=True, kw_only=True, eq=False)
class Series:
    """A group of values with name and look."""

    label: str
    look: Look
    value: Array
    """(K,); NaN is omitted"""
    low: Array | None = None
    """(K,) lower end"""
    high: Array | None = None
    """(K,) upper end"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Ways:
    """TCP paths in a panel."""

    title: str
    look: Look
    paths: Sequence[Array]
    """(T, 3) [m] each; NaN is omitted"""
    targets: Array
    """(K, 3) [m]"""
    numbered: bool = True
    """the targets have an order"""
    radius: float = 0.010
    """[m] around targets"""


def canvas(
    size: tuple[float, float], rows: int = 1, columns: int = 1, widths: Sequence[float] | None = None
) -> tuple[Figure, NDArray[Any]]:
    """Figure of ``size`` [inch] with styled axes (rows, columns) that share x by column."""
    figure = Figure(figsize=size, layout="constrained", facecolor="none")
    grid = figure.subplots(rows, columns, squeeze=False, sharex="col", width_ratios=widths)
    for axes in grid.flat:
        style(axes)
    return figure, grid


def style(axes: Axes) -> None:
    """Style axes."""
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
    """Name a panel."""
    axes.set_title(text, loc="left", fontsize=FONT + 0.5, color=INK, fontweight="bold")


def legend(figure: Figure, axes: Axes, order: Sequence[str]) -> None:
    """Put labels above the figure, in order."""
    found = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    labels = [label for label in order if label in found]
    figure.legend(
        [found[label] for label in labels],
        labels,
        loc="outside upper left",
        ncols=min(len(labels), LEGEND_COLUMNS),
        frameon=False,
        fontsize=FONT,
        labelcolor=INK,
        handlelength=2.6,
        columnspacing=1.4,
        borderpad=0.1,
    )


def plain_log(axis: Axis) -> None:
    """Label a logarithmic axis with plain numbers."""
    axis.set_major_locator(LogLocator(base=10, subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def error_per_target(series: Sequence[Series], reference: Series | None = None) -> Figure:
    """Draw TCP errors [mm] at K targets as grouped bars, with success radius and ``reference``."""
    figure, grid = canvas((WIDE, 3.2))
    axes, count = grid[0, 0], len(series[0].value)
    width = 0.8 / len(series)
    for i, one in enumerate(series):
        at = np.arange(1, count + 1) + (i - (len(series) - 1) / 2) * width
        axes.bar(
            at,
            one.value,
            width * 0.92,
            label=one.label,
            color=one.look.colour,
            hatch=one.look.hatch,
            edgecolor=GROUND,
            linewidth=0.0,
            yerr=whiskers(one),
            ecolor=INK,
            error_kw={"elinewidth": 0.7},
        )
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
    """Error bar lengths (2, K), or None."""
    if one.low is None or one.high is None:
        return None
    return np.clip(np.stack([one.value - one.low, one.high - one.value]), 0, None)


def intervals(rows: Sequence[Series], xlabel: str, *, log: bool = False) -> Figure:
    """Draw a row per series: its value with interval; a second one is hollow."""
    figure, grid = canvas((HALF, 0.75 + 0.3 * len(rows)))
    axes = grid[0, 0]
    for y, one in enumerate(rows):
        bars = whiskers(one)
        for k, value in enumerate(one.value):
            axes.errorbar(
                value,
                y,
                xerr=None if bars is None else bars[:, k : k + 1],
                fmt=one.look.marker,
                markersize=6,
                color=one.look.colour,
                markerfacecolor=one.look.colour if k == 0 else GROUND,
                capsize=2.5,
                linewidth=1.6,
            )
    if log:
        axes.set_xscale("log")
        plain_log(axes.xaxis)
    else:
        axes.set_xlim(left=0)
    axes.set_yticks(range(len(rows)), [one.label for one in rows])
    axes.set(xlabel=xlabel, ylim=(len(rows) - 0.5, -0.5))
    return figure


def ways(panels: Sequence[Ways], limits: Array, views: Sequence[str] = ("top", "side")) -> Figure:
    """Draw paths from above and the side, on axes ``limits`` (3, 2) [m]."""
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
            points[:, across],
            points[:, up],
            color=panel.look.colour,
            linewidth=0.8 if thin else 1.1,
            alpha=0.75 if thin else 1.0,
        )
        axes.plot(points[0, across], points[0, up], "s", markersize=4, color=panel.look.colour)
    for number, target in enumerate(1e3 * panel.targets, start=1):
        circle = 1e3 * panel.radius * np.stack([np.cos(TURN), np.sin(TURN)])
        axes.plot(target[across] + circle[0], target[up] + circle[1], color=INK, linewidth=0.7, alpha=0.7)
        axes.plot(target[across], target[up], "+", markersize=4, color=INK, markeredgewidth=0.8)
        if panel.numbered:
            axes.annotate(
                str(number),
                (target[across], target[up]),
                xytext=(5, 5),
                textcoords="offset points",
                fontsize=FONT - 1.5,
                color=INK,
            )


def error_over_time(time: Array, series: Sequence[Series]) -> Figure:
    """Draw encoder errors [mm] over ``time`` (K,) [s], log axis, with spread."""
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


def training_curves(steps: Array, curves: Sequence[tuple[str, Array]], look: Look) -> Figure:
    """Draw named curves (K,) over ``steps`` (K,), one panel each."""
    figure, grid = canvas((WIDE, 0.5 + 1.35 * len(curves)), len(curves))
    for axes, (name, values) in zip(grid[:, 0], curves, strict=True):
        axes.plot(steps / 1e6, values, color=look.colour, linewidth=1.5)
        axes.yaxis.set_major_locator(MaxNLocator(4))
        heading(axes, name)
    grid[-1, 0].set(xlabel="environment steps [million]", xlim=(steps[0] / 1e6, steps[-1] / 1e6))
    return figure
