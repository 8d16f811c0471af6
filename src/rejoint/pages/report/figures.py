"""Figures: one style, a plot for each kind of result, and a gallery that writes them."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from markupsafe import Markup, escape
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, Mask, tcp_position
from rejoint.control.moving.drive import Followed
from rejoint.control.moving.reference import LEAD_IN
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.procedure import in_base
from rejoint.logs.runfolder import RunFolder
from rejoint.logs.runlog import RunLog
from rejoint.pages.html import INK, LOOKS, Look, look_of
from rejoint.pages.words import MM, cycles, number, short
from rejoint.system.files import write_whole
from rejoint.system.records import entity, value_type

if TYPE_CHECKING:
    from rejoint.pages.report.page import Curves


def aims(log: RunLog) -> Array:
    """Corrected targets (T, 3) [m] of a log."""
    return log.target if log.aim is None else log.aim


def visits(arm: Arm, log: RunLog) -> Iterator[tuple[Array, Array]]:
    """Time since each target (T,) [s], from 0, and encoder TCP from the corrected target (T,) [m]."""
    tcp, aim = tcp_position(arm, log.position), aims(log)
    for visit in log.visits():
        if len(visit) and np.isfinite(log.target[visit[0]]).all():
            # The target was set when the last row of the previous one was read.
            rows = np.arange(max(visit[0] - 1, 0), visit[-1] + 1)
            error = np.linalg.norm(tcp[rows] - aim[np.maximum(rows, visit[0])], axis=1)
            yield log.time[rows] - log.time[rows[0]], error


def spread_over_time(found: Sequence[tuple[Array, Array]], time: Array) -> Array:
    """Median, 10th and 90th percentile (3, K) [m] of `visits` at ``time`` (K,); NaN once half have ended."""
    result, errors, now = np.full((3, len(time)), np.nan), [], time + 1e-9
    for at, error in found:
        last = error[np.searchsorted(at, now, side="right") - 1]
        errors.append(np.where(now <= at[-1] + np.diff(at).max(initial=0.0) + 1e-8, last, np.nan))
    enough = np.isfinite(errors).mean(axis=0) >= 0.5
    result[:, enough] = np.nanpercentile(np.stack(errors)[:, enough], [50, 10, 90], axis=0)
    return result


STYLED = style.context(Path(__file__).with_suffix(".mplstyle"))
"""Decorates functions in which Matplotlib draws in the style of the page"""
PNG_DPI = 160
"""[1/inch] (chosen)"""

_ID = re.compile(r'(\bid="|xlink:href="#|url\(#)')
_UNSAFE = re.compile(r"[^A-Za-z0-9_-]+")
_SIZE = re.compile(r'^.*?<svg [^>]*viewBox="([^"]+)"[^>]*>', re.DOTALL)
_NOISE = re.compile(r" font-family: [^;]*;|\s*<style type=\"text/css\">.*?</style>|(?<=[\dz]) (?=\n)", re.DOTALL)


def lay_out(figure: Figure) -> None:
    """Find the layout of a figure for good: any engine would draw it twice for every file."""
    figure.draw_without_rendering()
    figure.set_layout_engine(None)


@STYLED
def inline_svg(figure: Figure, key: str, alt: str) -> Markup:
    """Figure as SVG in the page's colours; ``key`` makes identifiers unique, ``alt`` is read out."""
    buffer = io.StringIO()
    lay_out(figure)
    with mpl.rc_context({"svg.hashsalt": key}):
        figure.savefig(buffer, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = _ID.sub(lambda match: f"{match[1]}{key}-", _NOISE.sub("", buffer.getvalue()))
    text = text.replace(INK, "currentColor")
    for i, look in enumerate(LOOKS.values()):
        text = text.replace(look.colour, f"var(--look-{i})")
    label, width = str(escape(alt)).replace("\\", "\\\\"), f"{figure.get_figwidth() * 96:.0f}px"
    head = f'<svg class="figure" role="img" aria-label="{label}" viewBox="\\1" style="max-width:{width}">'
    return Markup(_SIZE.sub(head, text, count=1))  # noqa: S704  (made by matplotlib, which escapes its text)


WIDE = 10.4
"""[inch] figure width"""
VIEWS = {"from above": (1, 0), "from the side": (0, 2), "from the front": (1, 2)}
"""Axes drawn to the right and upwards; y points left, as one sees it over the base"""
_DASHED = (0, (4, 3))


@entity
class Series:
    """A group of values with name and look."""

    label: str
    look: Look
    value: Array
    """(K,); NaN is omitted"""
    band: Sequence[Array] = ()
    """lower and upper end, (K,) each, if any"""


@STYLED
def canvas(
    size: tuple[float, float],
    rows: int,
    columns: int,
    **grid: Any,  # noqa: ANN401 - of Matplotlib
) -> tuple[Figure, NDArray[Any]]:
    """Figure of ``size`` [inch] with styled axes (rows, columns); ``grid`` as for `Figure.subplots`."""
    figure = Figure(figsize=size, layout="compressed")
    return figure, figure.subplots(rows, columns, squeeze=False, **grid)


@STYLED
def legend(figure: Figure, axes: Axes) -> None:
    """Put labels above the figure."""
    handles, labels = axes.get_legend_handles_labels()
    spacing = {"handlelength": 2.6, "columnspacing": 1.4, "borderpad": 0.1}
    figure.legend(handles, labels, loc="outside upper left", ncols=min(len(labels), 6), **spacing)


@STYLED
def curves(
    panels: Mapping[str, Sequence[Series]], across: Array, xlabel: str, size: tuple[float, float], *, rows: bool = False
) -> Figure:
    """Draw lines over ``across`` (K,), a panel for each title; ``rows``: one below the other."""
    figure, grid = canvas(size, *((len(panels), 1) if rows else (1, len(panels))), sharex=True)
    for axes, (title, series) in zip(grid.flat, panels.items(), strict=True):
        for one in series:
            colour = one.look.colour
            axes.plot(across, one.value, color=colour, linestyle=one.look.dash, linewidth=1.7, label=one.label)
            if one.band:
                axes.fill_between(across, *one.band, color=colour, alpha=0.16, linewidth=0)
        axes.set_title(title)
        axes.set_xlim(across[0], across[-1])
        if rows:
            axes.yaxis.set_major_locator(MaxNLocator(4))
    for axes in grid[-1]:
        axes.set_xlabel(xlabel)
    if any(one.label for one in series):
        legend(figure, grid[0, 0])
    return figure


Stroke = tuple[Array, dict[str, Any]]
"""Points (T, 3) [m], and their look as for `Axes.plot`"""


@STYLED
def plane(axes: Axes, view: str, strokes: Sequence[Stroke], title: str) -> None:
    """Draw strokes as seen in one of `VIEWS`."""
    across, up = VIEWS[view]
    for points, look in strokes:
        axes.plot(*(MM * points[:, VIEWS[view]].T), **look)
    axes.set_title(title)
    axes.set(xlabel=f"{'xyz'[across]} [mm]", ylabel=f"{'xyz'[up]} [mm]", aspect="equal")
    if across == 1 and not axes.xaxis_inverted():
        axes.invert_xaxis()


@STYLED
def write_png(path: Path, figure: Figure) -> Path:
    """Write a figure on white, whole or not at all; returns its ``path``."""
    how: dict[str, Any] = {"format": "png", "dpi": PNG_DPI, "facecolor": "white", "metadata": {"Software": None}}
    write_whole(path, lambda temporary: figure.savefig(temporary, **how))
    return path


STEP, LONGEST = 0.02, 8.0
"""[s] between points of an error curve, and its length (chosen)"""
LONGEST_ARROW = 0.15
"""Longest arrow over the figure (chosen)"""


@value_type
class Picture:
    """One embedded figure."""

    svg: Markup
    caption: str


class Gallery:
    """Draws the figures of a page and collects them; `save` writes them."""

    def __init__(self) -> None:
        self.figures: dict[str, Figure] = {}
        """by key"""

    def show(self, key: str, figure: Figure, *, alt: str, caption: str = "") -> Picture:
        """Add a figure under a unique ``key`` (its file name); returns it for the page."""
        self.figures[key] = figure
        return Picture(svg=inline_svg(figure, key, alt), caption=caption)

    def save(self, folder: Path) -> None:
        """Write figures as ``folder/KEY.png``."""
        for key, figure in self.figures.items():
            write_png(folder / f"{key}.png", figure)

    def tool_places(self, found: Calibration, measured: Measurements) -> Picture | None:
        """Draw arrows from the encoders' tool to the measured one; None without a whole point."""
        tool = in_base(found, measured)
        whole = np.isfinite(tool).all(axis=1)
        if not whole.any():
            return None
        wrong = np.isin(np.arange(len(measured)), found.suspects)[whole]
        seen, tool = tcp_position(found.arm, measured.position)[whole], tool[whole]
        off = np.linalg.norm(tool - seen, axis=1)
        scale = max(1, int(LONGEST_ARROW * np.ptp(seen, axis=0).max() / off.max()))
        low, high = (number(MM * end, 2) for end in (off.min(), off.max()))
        return self.show(
            "tool-places",
            arrows(seen, scale * (tool - seen), wrong),
            alt=f"Lines at {len(seen)} points from the tool by the encoders to the measured one, {low} to {high} mm.",
            caption="Where the encoders saw the tool (circles) and where it was measured (squares), in the base "
            f"frame. Lines are drawn {scale} times as long as they are. Points without all coordinates are left out.",
        )

    @STYLED
    def error_over_time(self, arm: Arm, logs: Mapping[str, RunLog]) -> Picture:
        """Draw the median error after a new target per controller, with 10th and 90th percentile."""
        found = {name: list(visits(arm, log)) for name, log in logs.items()}
        longest = max((time[-1] for group in found.values() for time, _ in group), default=0.0)
        time, series = np.arange(0.0, min(longest, LONGEST) + STEP / 2, STEP), []
        for name, group in found.items():
            middle, *band = MM * spread_over_time(group, time)
            series.append(Series(label=short(name), look=look_of(name), value=middle, band=band))
        figure = curves({"": series}, time, "time since the target was set [s]", (WIDE, 3.8))
        (axes,) = figure.axes
        axes.set(yscale="log", ylabel="encoder error [mm]")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
        for level in (10.0, 5.0, 2.0):
            axes.axhline(level, color=INK, linewidth=0.6, alpha=0.5, linestyle=_DASHED)
        return self.show(
            "error-over-time",
            figure,
            alt="Encoder error over the time since a target was set, log axis, by controller; the table has the ends.",
            caption="Encoder error after a new target is set: median over the targets of one trial, and where 80 % of "
            "them lie. By the encoders, from where they are to stand. Dashed levels: 10, 5 and 2 mm.",
        )

    def training(self, found: Curves) -> Picture:
        """Draw training curves."""
        drawn = {
            "reward per control cycle": found.reward,
            "success rate [%]": 100 * found.success_rate,
            "median error at the end of a target [mm]": found.error_mm,
        }
        panels = {name: [Series(label="", look=LOOKS["blue"], value=values)] for name, values in drawn.items()}
        figure = curves(panels, found.step / 1e6, "environment steps [million]", (WIDE, 4.55), rows=True)
        words = f"Reward, success rate and error over {cycles(found.step[-1])}; at the end: {found.outcome}."
        return self.show("training", figure, alt=words)


def arrows(seen: Array, way: Array, wrong: Mask) -> Figure:
    """Draw lines ``way`` from encoder TCP ``seen``, (M, 3) [m]; ``wrong`` (M,) ones grey."""
    point = {"linestyle": "", "markersize": 4}
    hollow = point | {"marker": "o", "color": INK, "markerfacecolor": "none"}
    strokes = [(seen, hollow | {"label": "where the encoders saw the tool"})]
    for label, rows, look in (
        ("measured point", ~wrong, LOOKS["orange"]),
        ("does not fit to the others", wrong, LOOKS["grey"]),
    ):
        if rows.any():
            ends = seen[rows] + way[rows]
            lines = np.stack([seen[rows], ends, np.full_like(ends, np.nan)], axis=1).reshape(-1, 3)
            strokes.append((lines, {"color": look.colour, "linewidth": 1.2}))
            strokes.append((ends, point | {"marker": "s", "color": look.colour, "label": label}))
    figure, grid = canvas((WIDE, 0.45 * WIDE), 1, 2)
    for axes, view in zip(grid[0], ("from above", "from the side"), strict=True):
        plane(axes, view, strokes, view)
        axes.set(adjustable="datalim")
    legend(figure, grid[0, 0])
    return figure


@STYLED
def draw_followed(folder: RunFolder, arm: Arm, done: Followed) -> Path:
    """Draw the first and last repetition of a path as ``figures/follow-NAME.png``; returns its path."""
    logs = [one.log for one in done.passes if one.log is not None]
    figure, ((*planes, errors),) = canvas((WIDE, 3.6), 1, 3, width_ratios=(1.0, 1.0, 1.6))
    strokes = [(aims(logs[-1]), {"color": INK, "linewidth": 2.2, "alpha": 0.35})]
    for label, log, look in [("first", logs[0], LOOKS["red"]), ("last", logs[-1], LOOKS["blue"])][-len(logs) :]:
        tool, time, line = tcp_position(arm, log.position), log.time - log.time[0] - LEAD_IN, {"color": look.colour}
        strokes.append((tool, line | {"linewidth": 1.0}))
        error = MM * np.linalg.norm(aims(log) - tool, axis=-1)
        errors.plot(time[time >= 0.0], error[time >= 0.0], linewidth=0.9, label=label, **line)
    for axes, view in zip(planes, ("from above", "from the front"), strict=True):
        plane(axes, view, strokes, view)
    errors.set(xlabel="time [s]", ylabel="encoder error [mm]", ylim=(0.0, None))
    errors.set_title("along the way")
    errors.legend()
    lay_out(figure)
    return write_png(folder.figures / f"{_UNSAFE.sub('-', f'follow-{done.path}')}.png", figure)
