"""Figures: one style, a plot for each kind of result, and a gallery that writes them."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle, pairwise
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.container import Container
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import LogLocator, MaxNLocator, MultipleLocator, NullFormatter
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, tcp_position
from rejoint.control.moving.drive import Followed
from rejoint.control.moving.reference import LEAD_IN
from rejoint.control.servogains import own_policy
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.diagnosis import Diagnosis
from rejoint.logs.runfolder import RunFolder
from rejoint.logs.runlog import RunLog
from rejoint.pages import html as palette
from rejoint.pages.html import GROUND, INK, LOOKS, Look, look_of
from rejoint.pages.report.contents import Contents, Curves
from rejoint.pages.report.tables import means
from rejoint.pages.words import MM, cycles, number, plural, short
from rejoint.system.files import write_whole
from rejoint.system.statistics import Estimate
from rejoint.twin.judgement import NO_TWIN, Judgement


def aims(log: RunLog) -> Array:
    """Corrected targets (T, 3) [m] of a log."""
    return log.target if log.aim is None else log.aim


def visits(arm: Arm, log: RunLog) -> Iterator[tuple[Array, Array]]:
    """Time since each target (T,) [s], from 0, and encoder TCP from the corrected target (T,) [m]."""
    tcp, aim = tcp_position(arm, log.position), aims(log)
    filled = np.nan_to_num(log.target, nan=np.inf)  # NaN differs from itself
    cuts = np.flatnonzero((filled[1:] != filled[:-1]).any(axis=1)) + 1
    for start, stop in pairwise([0, *cuts.tolist(), len(log)] if len(log) else []):
        if np.isfinite(log.target[start]).all():
            # The target was set when the last row of the previous one was read.
            rows = np.arange(max(start - 1, 0), stop)
            error = np.linalg.norm(tcp[rows] - aim[np.maximum(rows, start)], axis=1)
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


PNG_DPI = 160
"""[1/inch] (chosen)"""

_ID = re.compile(r'(\bid="|xlink:href="#|url\(#)')
_UNSAFE = re.compile(r"[^A-Za-z0-9_-]+")
_SIZE = re.compile(r'^.*?<svg [^>]*viewBox="([^"]+)"[^>]*>', re.DOTALL)
_NOISE = re.compile(r" font-family: [^;]*;|\s*<style type=\"text/css\">.*?</style>|(?<=[\dz]) (?=\n)", re.DOTALL)


def inline_svg(figure: Figure, key: str, alt: str) -> Markup:
    """Figure as SVG in the page's colours; ``key`` makes identifiers unique, ``alt`` is read out."""
    buffer = io.StringIO()
    figure.draw_without_rendering()
    figure.set_layout_engine(None)  # the layout is found now; any engine has every file drawn twice
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": key}):
        figure.savefig(buffer, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = _ID.sub(lambda match: f"{match[1]}{key}-", _NOISE.sub("", buffer.getvalue()))
    text = text.replace(INK, "currentColor").replace(GROUND, "var(--ground)")
    for i, look in enumerate(LOOKS):
        text = text.replace(look.colour, f"var(--look-{i})")
    label, width = str(escape(alt)).replace("\\", "\\\\"), f"{figure.get_figwidth() * 96:.0f}px"
    head = f'<svg class="figure" role="img" aria-label="{label}" viewBox="\\1" style="max-width:{width}">'
    return Markup(_SIZE.sub(head, text, count=1))  # noqa: S704  (made by matplotlib, which escapes its text)


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One embedded figure."""

    svg: Markup
    caption: str = ""


class Gallery:
    """Collects the figures of a page; `save` writes them."""

    def __init__(self) -> None:
        self._figures: dict[str, Figure] = {}

    def show(self, key: str, figure: Figure, *, alt: str, caption: str = "") -> Picture:
        """Add a figure under a unique ``key`` (its file name); returns it for the page."""
        key = _UNSAFE.sub("-", key)
        if key in self._figures:
            raise ValueError(f"two figures are called {key!r}")
        self._figures[key] = figure
        return Picture(svg=inline_svg(figure, key, alt), caption=caption)

    def save(self, folder: Path) -> list[Path]:
        """Write figures as ``folder/KEY.png``, on white."""
        how = {"format": "png", "dpi": PNG_DPI, "facecolor": "white", "metadata": {"Software": None}}
        found = {folder / f"{key}.png": figure for key, figure in self._figures.items()}
        for path, figure in found.items():
            write_whole(path, lambda temporary, figure=figure: figure.savefig(temporary, **how))  # type: ignore[misc]
        return list(found)


FONT = 9.5
"""[pt] (chosen: legible at half size)"""
WIDE, HALF = 10.4, 5.2
"""[inch] figure widths, one and two columns"""
REACHED_MM = 10.0
"""[mm] of a reached target; Park et al. 2024, section IV.A"""
VIEWS = {"from above": (1, 0), "from the side": (0, 2), "from the front": (1, 2)}
"""Axes drawn to the right and upwards; y points left, as one sees it over the base"""
_DASHED = (0, (4, 3))
TITLE: dict[str, Any] = {"loc": "left", "fontsize": FONT + 0.5, "fontweight": "bold", "color": INK}
LEGEND: dict[str, Any] = {"frameon": False, "fontsize": FONT, "labelcolor": INK}
_STYLE = {
    "axes.axisbelow": True,
    "axes.edgecolor": (INK, 0.45),
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.labelsize": FONT,
    "axes.linewidth": 0.8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "figure.facecolor": "none",
}


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

    @classmethod
    def over(cls, label: str, look: Look, values: Array) -> Series:
        """Means of ``values`` (R, K), with the smallest and the largest."""
        known = np.isfinite(values).any(axis=0)
        mean, low, high = found = np.full((3, values.shape[1]), np.nan)
        found[:, known] = [over(values[:, known], axis=0) for over in (np.nanmean, np.nanmin, np.nanmax)]
        return cls(label=label, look=look, value=mean, low=low, high=high)

    @classmethod
    def of(cls, label: str, look: Look, one: Estimate) -> Series:
        """Estimate (1,) with its ends, if any."""
        value, low, high = np.array([[one.value], [one.low], [one.high]], dtype=float)
        return cls(label=label, look=look, value=value, **({} if one.low is None else {"low": low, "high": high}))

    @property
    def whiskers(self) -> Array | None:
        """Error bar lengths (2, K), or None."""
        if self.low is None or self.high is None:
            return None
        return np.clip([self.value - self.low, self.high - self.value], 0, None)

    def line(self, axes: Axes, across: Array) -> None:
        """Draw a line over ``across`` (K,), and the band between the ends."""
        colour = self.look.colour
        axes.plot(across, self.value, color=colour, linestyle=self.look.dash, linewidth=1.7, label=self.label)
        if self.low is not None and self.high is not None:
            axes.fill_between(across, self.low, self.high, color=colour, alpha=0.16, linewidth=0)


def canvas(
    size: tuple[float, float],
    rows: int = 1,
    columns: int = 1,
    **grid: Any,  # noqa: ANN401 - of Matplotlib
) -> tuple[Figure, NDArray[Any]]:
    """Figure of ``size`` [inch] with styled axes (rows, columns); ``grid`` as for `Figure.subplots`."""
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=size, layout="constrained")
        found = figure.subplots(rows, columns, squeeze=False, **grid)
    for axes in found.flat:
        axes.tick_params(which="both", colors=INK, labelsize=FONT, length=3, width=0.7)
        axes.tick_params(which="both", grid_color=INK, grid_alpha=0.12, grid_linewidth=0.6)
    return figure, found


def legend(figure: Figure, axes: Axes) -> None:
    """Put labels above the figure: bars first, then as drawn."""
    found = zip(*axes.get_legend_handles_labels(), strict=True)
    handles, labels = zip(*sorted(found, key=lambda pair: not isinstance(pair[0], Container)), strict=True)
    figure.legend(
        handles,
        labels,
        loc="outside upper left",
        ncols=min(len(labels), 6),
        handlelength=2.6,
        columnspacing=1.4,
        borderpad=0.1,
        **LEGEND,
    )


def error_per_target(series: Sequence[Series], reference: Series | None = None) -> Figure:
    """Draw TCP errors [mm] at K targets as grouped bars, with success radius and ``reference``."""
    figure, ((axes,),) = canvas((WIDE, 3.2))
    at, width = np.arange(1, len(series[0].value) + 1), 0.8 / len(series)
    for i, one in enumerate(series):
        axes.bar(
            at + (i - (len(series) - 1) / 2) * width,
            one.value,
            width * 0.92,
            label=one.label,
            color=one.look.colour,
            hatch=one.look.hatch,
            edgecolor=GROUND,
            linewidth=0.0,
            yerr=one.whiskers,
            ecolor=INK,
            error_kw={"elinewidth": 0.7},
        )
    if reference is not None:
        look = reference.look
        axes.axhline(reference.value[0], color=look.colour, linewidth=2.0, linestyle=look.dash, label=reference.label)
        if reference.low is not None and reference.high is not None:
            axes.axhspan(reference.low[0], reference.high[0], color=look.colour, alpha=0.15, linewidth=0)
    label = f"counts as reached: {REACHED_MM:g} mm"
    axes.axhline(REACHED_MM, color=INK, linewidth=0.9, linestyle=_DASHED, label=label)
    axes.set(xlabel="target", ylabel="error [mm]", xlim=(0.4, len(at) + 0.6), ylim=(0, None), xticks=at)
    axes.grid(visible=False, axis="x")
    legend(figure, axes)
    return figure


def intervals(rows: Sequence[Series], xlabel: str) -> Figure:
    """Draw a row per series: its first value with interval."""
    figure, ((axes,),) = canvas((HALF, 0.75 + 0.3 * len(rows)))
    for y, one in enumerate(rows):
        look = {"fmt": one.look.marker, "color": one.look.colour, "markersize": 6, "capsize": 2.5, "linewidth": 1.6}
        axes.errorbar(one.value[:1], [y], xerr=one.whiskers, **look)
    axes.set_yticks(range(len(rows)), [one.label for one in rows])
    axes.set(xlabel=xlabel, xlim=(0, None), ylim=(len(rows) - 0.5, -0.5))
    return figure


def curves(
    panels: Mapping[str, Sequence[Series]], across: Array, xlabel: str, size: tuple[float, float], *, rows: bool = False
) -> Figure:
    """Draw lines over ``across`` (K,), a panel for each title; ``rows``: one below the other."""
    figure, grid = canvas(size, *((len(panels), 1) if rows else (1, len(panels))), sharex=True)
    for axes, (title, series) in zip(grid.flat, panels.items(), strict=True):
        for one in series:
            one.line(axes, across)
        axes.set_title(title, **TITLE)
        axes.set_xlim(across[0], across[-1])
        if rows:
            axes.yaxis.set_major_locator(MaxNLocator(4))
    for axes in grid[-1]:
        axes.set_xlabel(xlabel)
    if any(one.label for one in series):
        legend(figure, grid[0, 0])
    return figure


def error_over_time(time: Array, series: Sequence[Series]) -> Figure:
    """Draw encoder errors [mm] over ``time`` (K,) [s], log axis, with spread."""
    figure = curves({"": series}, time, "time since the target was set [s]", (WIDE, 3.8))
    (axes,) = figure.axes
    axes.set(yscale="log", ylabel="encoder error [mm]")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    for level in (10.0, 5.0, 2.0):
        axes.axhline(level, color=INK, linewidth=0.6, alpha=0.5, linestyle=_DASHED)
    return figure


def in_view(points: Array, view: str) -> Array:
    """Return points (..., 3) [m] as seen in one of `VIEWS` (2, ...) [mm]."""
    return np.moveaxis(1e3 * points[..., VIEWS[view]], -1, 0)


def name_view(axes: Axes, view: str, title: str = "") -> None:
    """Label a view and its axes."""
    across, up = VIEWS[view]
    axes.set_title(title, **TITLE)
    axes.set(xlabel=f"{'xyz'[across]} [mm]", ylabel=f"{'xyz'[up]} [mm]", aspect="equal")
    if across == 1:
        axes.invert_xaxis()


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

    def draw(self, axes: Axes, view: str) -> None:
        """Draw them in one of `VIEWS`."""
        colour, thin = self.look.colour, len(self.paths) > 1
        for path in self.paths:
            points = in_view(path[np.isfinite(path).all(axis=-1)], view)
            axes.plot(*points, color=colour, linewidth=0.8 if thin else 1.1, alpha=0.75 if thin else 1.0)
            axes.plot(*points[:, :1], "s", markersize=4, color=colour)
        for i, target in enumerate(in_view(self.targets, view).T, start=1):
            axes.add_patch(Circle(target, 1e3 * self.radius, fill=False, edgecolor=INK, linewidth=0.7, alpha=0.7))
            axes.plot(*target, "+", markersize=4, color=INK, markeredgewidth=0.8)
            if self.numbered:
                how: dict[str, Any] = {"textcoords": "offset points", "fontsize": FONT - 1.5, "color": INK}
                axes.annotate(str(i), target, xytext=(5, 5), **how)


def bounds(paths: Sequence[Array], margin: float = 0.012) -> Array:
    """Box (3, 2) [m] around ``paths`` (T, 3) [m] (margin chosen)."""
    points = np.concatenate(list(paths))
    return np.stack([points.min(axis=0) - margin, points.max(axis=0) + margin], axis=1)


def ways(panels: Sequence[Ways], limits: Array, views: Sequence[str] = ("from above", "from the side")) -> Figure:
    """Draw paths in ``views``, on axes ``limits`` (3, 2) [m]."""
    low, high = (np.array([in_view(end, view) for view in views]) for end in limits.T)
    width, extent = min(WIDE, 3.1 * len(panels) + 0.4), high - low
    heights = (width - 0.7) / len(panels) / extent[:, 0].max() * extent[:, 1]
    size = (width, heights.sum() + 0.55 * len(views) + 0.2)
    figure, grid = canvas(size, len(views), len(panels), height_ratios=heights)
    for (row, column), axes in np.ndenumerate(grid):
        panels[column].draw(axes, views[row])
        axes.set(xlim=(low[row, 0], high[row, 0]), ylim=(low[row, 1], high[row, 1]))
        name_view(axes, views[row], "" if row else panels[column].title)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MultipleLocator(50))
        if column:
            axes.set_ylabel("")
    return figure


STEP, LONGEST = 0.02, 8.0
"""[s] between points of an error curve, and its length (chosen)"""
LONGEST_ARROW = 0.15
"""Longest arrow over the figure (chosen)"""
_SCALES = (1, 2, 5, 10, 20, 50)
_BARS = 3  # controllers in the bar chart: more cannot be told apart at ten targets
WHERE = {"free": "in free space", "contact": "on the table"}


def healthy_error(diagnosis: Diagnosis | None) -> Series | None:
    """Mean and range [mm] of healthy arms' open-loop errors."""
    healthy = None if diagnosis is None else diagnosis.healthy
    return None if healthy is None else Series.of("healthy arm, mean and range", palette.GREEN, healthy.error_mm)


class Pictures:
    """Draws into a gallery."""

    def __init__(self, gallery: Gallery) -> None:
        self.show = gallery.show

    def error_per_target(self, contents: Contents, best: str) -> Picture:
        """Draw settled errors at the first targets: uncorrected arm, recommended controller, policy."""
        comparison = contents.comparison
        assert comparison is not None  # noqa: S101 - the section is about it
        known = comparison.controllers
        wanted = dict.fromkeys(("default", best, own_policy(known), *known))
        names = [name for name in wanted if name in known][:_BARS]
        series = [
            Series.over(short(name), look_of(name), MM * comparison.array("settled", name)[0])
            for name in known
            if name in names
        ]
        words = "; ".join(
            f"{one.label}: {number(np.nanmin(one.value), 2)} to {number(np.nanmax(one.value), 2)} mm"
            for one in series
            if np.isfinite(one.value).any()
        )
        return self.show(
            "error-per-target",
            error_per_target(series, healthy_error(contents.diagnosis)),
            alt=f"Bars: settled encoder error at each target of the first set. {words}. The table has the means.",
            caption="Settled encoder error at each target of the first set; lines: smallest to largest of the "
            "repetitions. Compare Park et al. 2024, Figs. 8 and 9.",
        )

    def tool_places(self, found: Calibration, measured: Measurements) -> Picture | None:
        """Draw the measured tool; None without a whole point."""
        seen, tool = tcp_position(found.arm, measured.position), in_base(found, measured)
        whole = np.isfinite(tool).all(axis=1)
        if not whole.any():
            return None
        wrong = np.isin(np.arange(len(measured)), found.suspects)[whole]
        seen, tool = seen[whole], tool[whole]
        off, figure, scale = MM * np.linalg.norm(tool - seen, axis=1), *arrows(seen, tool, wrong)
        left = "" if whole.all() else f" {plural(int((~whole).sum()), 'point')} without all coordinates left out."
        return self.show(
            "tool-places",
            figure,
            alt=f"Arrows at {len(seen)} points from where the encoders saw the tool to where it was, "
            f"{number(float(off.min()), 2)} to {number(float(off.max()), 2)} mm long.",
            caption="Where the encoders saw the tool (circles) and where it was measured (ends of the arrows), in the "
            f"base frame. Arrows are drawn {scale}.{left}",
        )

    def error_over_time(self, arm: Arm, logs: Mapping[str, RunLog]) -> Picture:
        """Draw the median error after a new target per controller, with 10th and 90th percentile."""
        found = {name: group for name, log in logs.items() if (group := list(visits(arm, log)))}
        longest = max((time[-1] for group in found.values() for time, _ in group), default=0.0)
        time, series, last = np.arange(0.0, min(longest, LONGEST) + STEP / 2, STEP), [], []
        for name, group in found.items():
            middle, low, high = MM * spread_over_time(group, time)
            series.append(Series(label=short(name), look=look_of(name), value=middle, low=low, high=high))
            last.append(f"{short(name)}: {number(next(iter(middle[np.isfinite(middle)][::-1]), None), 2, 'mm')}")
        return self.show(
            "error-over-time",
            error_over_time(time, series),
            alt="Encoder error over the time since a target was set, log axis. Medians at the end of each line: "
            f"{'; '.join(last)}.",
            caption="Encoder error after a new target is set: median over the targets of one trial, and where 80 % of "
            "them lie. By the encoders, from where they are to stand. Dashed levels: 10, 5 and 2 mm.",
        )

    def open_loop(self, diagnosis: Diagnosis) -> Picture:
        """Draw the arm's rest positions in the diagnosis."""
        targets = () if diagnosis.open_loop is None else diagnosis.open_loop.targets
        errors = np.array([(one.error_mm, one.true_error_mm) for one in targets], dtype=float).T
        names = {"by its encoders": palette.GREY, "true error of the tool": palette.BROWN}
        series = [
            Series(label=f"this arm, {name}", look=look, value=values)
            for (name, look), values in zip(names.items(), errors, strict=True)
            if np.isfinite(values).any()
        ]
        values = ", ".join(f"target {i} {number(one.error_mm, 2)}" for i, one in enumerate(targets, start=1))
        return self.show(
            "open-loop",
            error_per_target(series, healthy_error(diagnosis)),
            alt=f"Bars: encoder error in mm at each of {len(targets)} targets, open loop: {values}.",
            caption="Where the arm comes to rest when it is told once where to go.",
        )

    def training(self, found: Curves) -> Picture:
        """Draw training curves."""
        drawn = {
            "reward per control cycle": found.reward,
            "success rate [%]": 100 * found.success_rate,
            "median error at the end of a target [mm]": found.error_mm,
        }
        panels = {name: [Series(label="", look=palette.BLUE, value=values)] for name, values in drawn.items()}
        figure = curves(panels, found.step / 1e6, "environment steps [million]", (WIDE, 4.55), rows=True)
        words = f"Reward, success rate and error over {cycles(found.step[-1])}; at the end: {found.outcome}."
        return self.show("training", figure, alt=words)

    def predictions(self, judgement: Judgement) -> Iterator[Picture]:
        """Draw the mean error of every prediction, free and in contact."""
        order = cycle((palette.BLUE, palette.GREEN, palette.ORANGE, palette.PURPLE, palette.BROWN, palette.RED))
        looks = {name: palette.GREY if name == NO_TWIN else next(order) for name in judgement.mean}
        for kind, where in WHERE.items():
            found = means(judgement, kind)
            if not found:
                continue
            words = ", ".join(f"{name} {number(mean.value, 3)}" for name, mean in found.items())
            series = [Series.of(name, looks[name], mean) for name, mean in found.items()]
            yield self.show(
                f"prediction-{kind}",
                intervals(series, f"error of the tool {where} [mm]"),
                alt=f"Marks: mean prediction error of the tool {where} in mm: {words}.",
                caption=f"Open loop from the first measured posture, {where}: mean over the motions, each counting "
                "the same, with its 95 % interval over motions.",
            )


def in_base(found: Calibration, measured: Measurements) -> Array:
    """Measured points (M, 3) [m] in the base frame; NaN: not measured."""
    return measured.point @ found.frame[:3, :3].T + found.frame[:3, 3]


def arrows(seen: Array, tool: Array, wrong: NDArray[np.bool_]) -> tuple[Figure, str]:
    """Draw arrows from encoder TCP to tool, (M, 3) [m]; ``wrong`` (M,) ones grey. Also returns their scale."""
    most = LONGEST_ARROW * np.ptp(seen, axis=0).max() / np.linalg.norm(tool - seen, axis=1).max()
    scale = max((scale for scale in _SCALES if scale <= most), default=1)
    said = f"{scale} times as long as they are" if scale > 1 else "to scale"
    groups = {"measured point": (~wrong, palette.ORANGE), "does not fit to the others": (wrong, palette.GREY)}
    figure, grid = canvas((WIDE, 0.45 * WIDE), 1, 2)
    hollow = {"markersize": 5, "color": INK, "markerfacecolor": "none"}
    for axes, view in zip(grid[0], ("from above", "from the side"), strict=True):
        axes.plot(*in_view(seen, view), "o", label="where the encoders saw the tool", **hollow)
        for label, (rows, look) in groups.items():
            if rows.any():
                start, away = in_view(seen[rows], view), scale * in_view((tool - seen)[rows], view)
                axes.plot(*(start + away), look.marker, markersize=4, color=look.colour, label=label, linestyle="")
                how = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.0035, "headwidth": 4}
                axes.quiver(*start, *away, color=look.colour, **how)
        axes.margins(0.12)
        axes.set(adjustable="datalim")
        name_view(axes, view, view)
    legend(figure, grid[0, 0])
    figure.supxlabel(f"arrows {said}", fontsize=FONT, color=INK)
    return figure, said


def draw_followed(folder: RunFolder, arm: Arm, done: Followed) -> Path:
    """Draw the first and last repetition of a path as ``figures/follow-NAME.png``; returns its path."""
    logs = [one.log for one in done.passes if one.log is not None]
    several = len(logs) > 1
    chosen = [("first", logs[0], palette.RED)] if several else []
    chosen.append(("last" if several else "arm", logs[-1], palette.BLUE))
    figure, ((*planes, errors),) = canvas((WIDE, 3.6), 1, 3, width_ratios=(1.0, 1.0, 1.6))
    for axes, view in zip(planes, ("from above", "from the front"), strict=True):
        axes.plot(*in_view(aims(logs[-1]), view), color=INK, linewidth=2.2, alpha=0.35)
        for _, log, look in chosen:
            axes.plot(*in_view(tcp_position(arm, log.position), view), color=look.colour, linewidth=1.0)
        name_view(axes, view, view)
    for label, log, look in chosen:
        error = np.linalg.norm(aims(log) - tcp_position(arm, log.position), axis=-1)
        time = log.time - log.time[0] - LEAD_IN
        on = time >= 0.0
        errors.plot(time[on], 1e3 * error[on], color=look.colour, linewidth=0.9, label=label)
    errors.set(xlabel="time [s]", ylabel="encoder error [mm]", ylim=(0.0, None))
    errors.set_title("along the way", **TITLE)
    errors.legend(**LEGEND)
    gallery = Gallery()
    gallery.show(f"follow-{done.path}", figure, alt=f"the path {done.path} and where the arm was")
    return gallery.save(folder.figures)[0]
