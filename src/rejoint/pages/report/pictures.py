"""Figures of the report, with alternative texts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import cycle
from pathlib import Path

import numpy as np
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
from rejoint.pages.html import INK, Look, look_of
from rejoint.pages.report import figures
from rejoint.pages.report.contents import Contents, Curves
from rejoint.pages.report.figures import WIDE, Gallery, Picture, Series, aims, canvas, in_view, name_view
from rejoint.pages.report.tables import means
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


def series_of(label: str, look: Look, one: Estimate) -> Series:
    """Estimate (1,) with its ends, if any."""
    value, low, high = np.array([[one.value], [one.low], [one.high]], dtype=float)
    ends = {} if one.low is None else {"low": low, "high": high}
    return Series(label=label, look=look, value=value, **ends)


def healthy_error(diagnosis: Diagnosis | None) -> Series | None:
    """Mean and range [mm] of healthy arms' open-loop errors."""
    healthy = None if diagnosis is None else diagnosis.healthy
    return None if healthy is None else series_of("healthy arm, mean and range", palette.GREEN, healthy.error_mm)


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
        series = [_bars(comparison, name) for name in known if name in names]
        words = "; ".join(
            f"{one.label}: {number(np.nanmin(one.value), 2)} to {number(np.nanmax(one.value), 2)} mm"
            for one in series
            if np.isfinite(one.value).any()
        )
        return self.show(
            "error-per-target",
            figures.error_per_target(series, healthy_error(contents.diagnosis)),
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
        found = {name: group for name, log in logs.items() if (group := list(figures.visits(arm, log)))}
        longest = max((time[-1] for group in found.values() for time, _ in group), default=0.0)
        time, series, last = np.arange(0.0, min(longest, LONGEST) + STEP / 2, STEP), [], []
        for name, group in found.items():
            middle, low, high = MM * figures.spread_over_time(group, time)
            series.append(Series(label=short(name), look=look_of(name), value=middle, low=low, high=high))
            last.append(f"{short(name)}: {number(next(iter(middle[np.isfinite(middle)][::-1]), None), 2, 'mm')}")
        return self.show(
            "error-over-time",
            figures.error_over_time(time, series),
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
            figures.error_per_target(series, healthy_error(diagnosis)),
            alt=f"Bars: encoder error in mm at each of {len(targets)} targets, open loop: {values}.",
            caption="Where the arm comes to rest when it is told once where to go.",
        )

    def training(self, curves: Curves) -> Picture:
        """Draw training curves."""
        drawn = {
            "reward per control cycle": curves.reward,
            "success rate [%]": 100 * curves.success_rate,
            "median error at the end of a target [mm]": curves.error_mm,
        }
        words = f"Reward, success rate and error over {cycles(curves.step[-1])}; at the end: {curves.outcome}."
        return self.show("training", figures.training_curves(curves.step, drawn, palette.BLUE), alt=words)

    def predictions(self, judgement: Judgement) -> Iterator[Picture]:
        """Draw the mean error of every prediction, free and in contact."""
        order = cycle((palette.BLUE, palette.GREEN, palette.ORANGE, palette.PURPLE, palette.BROWN, palette.RED))
        looks = {name: palette.GREY if name == NO_TWIN else next(order) for name in judgement.mean}
        for kind, where in WHERE.items():
            found = means(judgement, kind)
            if not found:
                continue
            words = ", ".join(f"{name} {number(mean.value, 3)}" for name, mean in found.items())
            series = [series_of(name, looks[name], mean) for name, mean in found.items()]
            yield self.show(
                f"prediction-{kind}",
                figures.intervals(series, f"error of the tool {where} [mm]"),
                alt=f"Marks: mean prediction error of the tool {where} in mm: {words}.",
                caption=f"Open loop from the first measured posture, {where}: mean over the motions, each counting "
                "the same, with its 95 % interval over motions.",
            )


def _bars(comparison: Comparison, name: str) -> Series:
    values = comparison.array("settled", name)[0] * MM  # (R, K)
    known = np.isfinite(values).any(axis=0)
    mean, low, high = found = np.full((3, values.shape[1]), np.nan)
    found[:, known] = [over(values[:, known], axis=0) for over in (np.nanmean, np.nanmin, np.nanmax)]
    return Series(label=short(name), look=look_of(name), value=mean, low=low, high=high)


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
        axes.set_title(view, **figures.TITLE)
        name_view(axes, view)
    figures.legend(figure, grid[0, 0])
    figure.supxlabel(f"arrows {said}", fontsize=figures.FONT, color=INK)
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
        axes.set_title(view, **figures.TITLE)
        name_view(axes, view)
    for label, log, look in chosen:
        error = np.linalg.norm(aims(log) - tcp_position(arm, log.position), axis=-1)
        time = log.time - log.time[0] - LEAD_IN
        on = time >= 0.0
        errors.plot(time[on], 1e3 * error[on], color=look.colour, linewidth=0.9, label=label)
    errors.set(xlabel="time [s]", ylabel="encoder error [mm]", ylim=(0.0, None))
    errors.set_title("along the way", **figures.TITLE)
    errors.legend(**figures.LEGEND)
    gallery = Gallery()
    gallery.show(f"follow-{done.path}", figure, alt=f"the path {done.path} and where the arm was")
    return gallery.save(folder.figures)[0]
