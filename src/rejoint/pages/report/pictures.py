"""Figures of the report, with alternative texts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, tcp_position
from rejoint.control.comparison.result import Comparison
from rejoint.control.moving.drive import Followed
from rejoint.control.moving.reference import LEAD_IN
from rejoint.control.servogains import own_policy
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.diagnosis import Diagnosis
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.logs.runlog import RunLog
from rejoint.pages import html as palette
from rejoint.pages.html import BLUE, INK, RED, Look, look_of
from rejoint.pages.report.contents import Contents, Curves
from rejoint.pages.report.figures import (
    FONT,
    HALF,
    WIDE,
    Gallery,
    Picture,
    Series,
    canvas,
    error_over_time,
    error_per_target,
    heading,
    intervals,
    legend,
    spread_over_time,
    training_curves,
    visits,
)
from rejoint.pages.report.tables import scores
from rejoint.pages.words import MM, cycles, number, plural, short
from rejoint.system.statistics import Estimate
from rejoint.twin.judgement import NO_TWIN, Judgement

STEP, LONGEST = 0.02, 8.0
"""[s] between points of an error curve, and its length (chosen)"""
LONGEST_ARROW = 0.15
"""Longest arrow over the figure (chosen)"""
_SCALES = (1, 2, 5, 10, 20, 50)
_BARS = 3  # controllers in the bar chart: more cannot be told apart at ten targets
WHERE = {"free": "in free space", "contact": "on the table"}


def series_of(label: str, look: Look, *estimates: Estimate | None, factor: float = 1.0) -> Series:
    """Estimates (K,) with ends, times ``factor``; NaN: none."""
    ends = [(one.value, one.low, one.high) if one is not None else (None,) * 3 for one in estimates]
    value, low, high = factor * np.array(ends, dtype=float).T
    return Series(label=label, look=look, value=value, low=low, high=high)


def healthy_error(diagnosis: Diagnosis | None) -> Series | None:
    """Mean and range [mm] of healthy arms' open-loop errors."""
    if diagnosis is None or diagnosis.healthy is None:
        return None
    found = series_of("healthy arm, mean and range", palette.GREEN, diagnosis.healthy.error_mm)
    return found if diagnosis.healthy.error_mm.low is not None else replace(found, low=None, high=None)


class Pictures:
    """Draws into a gallery."""

    def __init__(self, gallery: Gallery) -> None:
        self.show = gallery.show

    def error_per_target(self, contents: Contents, best: str) -> Picture:
        """Draw settled errors at the first targets: uncorrected arm, recommended controller, policy."""
        comparison = contents.comparison
        assert comparison is not None  # noqa: S101 - the section is about it
        known = comparison.controllers
        wanted = [name for name in dict.fromkeys(("default", best, own_policy(known))) if name in known]
        names = [*wanted, *(name for name in known if name not in wanted)][:_BARS]
        series = [_bars(comparison, name) for name in known if name in names]
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
        scale, off = arrow_scale(seen, tool), np.linalg.norm(tool - seen, axis=1) * MM
        left = "" if whole.all() else f" {plural(int((~whole).sum()), 'point')} without all coordinates left out."
        return self.show(
            "tool-places",
            arrows(seen, tool, wrong),
            alt=f"Arrows at {len(seen)} points from where the encoders saw the tool to where it was, "
            f"{number(float(off.min()), 2)} to {number(float(off.max()), 2)} mm long.",
            caption="Where the encoders saw the tool (circles) and where it was measured (ends of the arrows), in the "
            f"base frame. Arrows are drawn {_length(scale)}.{left}",
        )

    def error_over_time(self, arm: Arm, logs: Mapping[str, RunLog]) -> Picture:
        """Draw the median error after a new target per controller, with 10th and 90th percentile."""
        found = {name: group for name, log in logs.items() if (group := visits(arm, log))}
        longest = max((float(visit.time[-1]) for group in found.values() for visit in group), default=0.0)
        time, series, last = np.arange(0.0, min(longest, LONGEST) + STEP / 2, STEP), [], []
        for name, group in found.items():
            middle, low, high = (MM * one for one in spread_over_time(group, time))
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
        names = (("by its encoders", palette.GREY), ("true error of the tool", palette.BROWN))
        series = [
            Series(label=f"this arm, {name}", look=look, value=values)
            for (name, look), values in zip(names, errors, strict=True)
            if np.isfinite(values).any()
        ]
        values = ", ".join(f"target {i} {number(one.error_mm, 2)}" for i, one in enumerate(targets, start=1))
        return self.show(
            "open-loop",
            error_per_target(series, healthy_error(diagnosis)),
            alt=f"Bars: encoder error in mm at each of {len(targets)} targets, open loop: {values}.",
            caption="Where the arm comes to rest when it is told once where to go.",
        )

    def training(self, curves: Curves) -> Picture:
        """Draw training curves."""
        drawn = (
            ("reward per control cycle", curves.reward),
            ("success rate [%]", 100 * curves.success_rate),
            ("median error at the end of a target [mm]", curves.error_mm),
        )
        words = f"Reward, success rate and error over {cycles(curves.step[-1])}; at the end: {curves.outcome}."
        return self.show("training", training_curves(curves.step, drawn, palette.BLUE), alt=words)

    def predictions(self, judgement: Judgement) -> Iterator[Picture]:
        """Draw the mean error of every prediction, free and in contact."""
        found, looks = scores(judgement), _looks(judgement)
        for kind, where in WHERE.items():
            means = {score.name: mean for score in found if (mean := score.mean(kind)) is not None}
            if not means:
                continue
            series = [series_of(name, looks[name], mean) for name, mean in means.items()]
            words = ", ".join(f"{name} {number(mean.value, 3)}" for name, mean in means.items())
            yield self.show(
                f"prediction-{kind}",
                intervals(series, f"error of the tool {where} [mm]"),
                alt=f"Marks: mean prediction error of the tool {where} in mm: {words}.",
                caption=f"Open loop from the first measured posture, {where}: mean over the motions, each counting "
                "the same, with its 95 % interval over motions.",
            )


def _bars(comparison: Comparison, name: str) -> Series:
    values = comparison.array("settled", name)[0] * MM  # (R, K)
    found = np.full((3, values.shape[1]), np.nan)
    known = np.isfinite(values).any(axis=0)
    found[:, known] = [over(values[:, known], axis=0) for over in (np.nanmean, np.nanmin, np.nanmax)]
    return Series(label=short(name), look=look_of(name), value=found[0], low=found[1], high=found[2])


def _looks(judgement: Judgement) -> dict[str, Look]:
    order = cycle((palette.BLUE, palette.GREEN, palette.ORANGE, palette.PURPLE, palette.BROWN, palette.RED))
    return {name: palette.GREY if name == NO_TWIN else next(order) for name in judgement.mean}


def in_base(found: Calibration, measured: Measurements) -> Array:
    """Measured points (M, 3) [m] in the base frame; NaN: not measured."""
    return measured.point @ found.frame[:3, :3].T + found.frame[:3, 3]


def arrow_scale(seen: Array, tool: Array) -> int:
    """Scale of arrows from ``seen`` to ``tool`` (M, 3) [m]."""
    extent = float(np.ptp(seen, axis=0).max())
    longest = float(np.linalg.norm(tool - seen, axis=1).max())
    return max((scale for scale in _SCALES if scale * longest <= LONGEST_ARROW * extent), default=1)


def _length(scale: int) -> str:
    return f"{scale} times as long as they are" if scale > 1 else "to scale"


def arrows(seen: Array, tool: Array, wrong: NDArray[np.bool_]) -> Figure:
    """Draw arrows from encoder TCP to tool, (M, 3) [m]; ``wrong`` (M,) ones grey."""
    scale, start = arrow_scale(seen, tool), "where the encoders saw the tool"
    groups = {"measured point": (~wrong, palette.ORANGE), "does not fit to the others": (wrong, palette.GREY)}
    figure, grid = canvas((WIDE, 0.45 * WIDE), 1, 2)
    for axes, (name, across, up) in zip(grid[0], (("from above", 1, 0), ("from the side", 0, 2)), strict=True):
        for label, (rows, look) in groups.items():
            if rows.any():
                _draw(axes, MM * seen[rows][:, [across, up]], MM * tool[rows][:, [across, up]], scale, look, label)
        axes.set(xlabel="xyz"[across] + " [mm]", ylabel="xyz"[up] + " [mm]", aspect="equal", adjustable="datalim")
        axes.margins(0.12)
        heading(axes, name)
    grid[0, 0].invert_xaxis()
    grid[0, 0].plot([], [], "o", markersize=5, color=INK, markerfacecolor="none", label=start)
    legend(figure, grid[0, 0], (start, *groups))
    figure.supxlabel(f"arrows {_length(scale)}", fontsize=FONT, color=INK)
    return figure


def _draw(axes: Axes, seen: Array, tool: Array, scale: int, look: Look, label: str) -> None:
    """Draw points and arrows (m, 2) [mm]."""
    away = scale * (tool - seen)
    axes.plot(*seen.T, "o", markersize=5, color=INK, markerfacecolor="none", linewidth=0)
    axes.plot(*(seen + away).T, look.marker, markersize=4, color=look.colour, label=label)
    axes.quiver(
        *seen.T,
        *away.T,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        color=look.colour,
        width=0.0035 * HALF / WIDE * 2,
        headwidth=4,
    )


def draw_followed(folder: RunFolder, arm: Arm, done: Followed) -> Path:
    """Draw the first and last repetition of a path as ``figures/follow-NAME.png``; returns its path."""
    logs = [one.log for one in done.passes if one.log is not None]
    chosen = [("last" if len(logs) > 1 else "arm", logs[-1], BLUE)]
    chosen = ([("first", logs[0], RED)] if len(logs) > 1 else []) + chosen
    figure, grid = canvas((WIDE, 3.6), 1, 3, (1.0, 1.0, 1.6))
    above, side, errors = grid[0]
    for axes, across, up, name in ((above, 1, 0, "from above"), (side, 1, 2, "from the front")):
        _plane(axes, _aims(logs[-1]), across, up, INK, "path", 2.2)
        for label, log, look in chosen:
            _plane(axes, tcp_position(arm, log.position), across, up, look.colour, label, 1.0)
        axes.set(aspect="equal", xlabel=f"{'xyz'[across]} [mm]", ylabel=f"{'xyz'[up]} [mm]")
        axes.invert_xaxis()
        heading(axes, name)
    for label, log, look in chosen:
        _error(errors, arm, log, look, label)
    errors.set(xlabel="time [s]", ylabel="encoder error [mm]", ylim=(0.0, None))
    errors.legend(fontsize=FONT - 1.0, frameon=False, labelcolor=INK)
    heading(errors, "along the way")
    gallery = Gallery()
    gallery.show(f"follow-{done.path}", figure, alt=f"the path {done.path} and where the arm was")
    return gallery.save(folder.figures)[0]


def _aims(log: RunLog) -> Array:
    return log.target if log.aim is None else log.aim


def _plane(axes: Axes, points: Array, across: int, up: int, colour: str, label: str, width: float) -> None:
    alpha = 0.35 if colour == INK else 1.0
    axes.plot(1e3 * points[:, across], 1e3 * points[:, up], color=colour, linewidth=width, alpha=alpha, label=label)


def _error(axes: Axes, arm: Arm, log: RunLog, look: Look, label: str) -> None:
    error = np.linalg.norm(_aims(log) - tcp_position(arm, log.position), axis=-1)
    time = log.time - log.time[0] - LEAD_IN
    axes.plot(time[time >= 0.0], 1e3 * error[time >= 0.0], color=look.colour, linewidth=0.9, label=label)
