"""The section about the motion itself: ways through the targets, and errors over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.logs.runlog import RunLog
from rejoint.pages.report.figures import Path3, Series, error_over_time, trajectory
from rejoint.pages.report.gallery import Gallery
from rejoint.pages.report.motion import TargetSpan, bounds, encoder_path, spread_over_time, visits
from rejoint.pages.report.numerals import number
from rejoint.pages.report.palette import look_of
from rejoint.pages.report.view import Part, Picture, Section
from rejoint.pages.report.words import short

KEY, SHORT, HEADING = "motion", "Motion", "How the arm moved"

MM = 1e3
STEP = 0.02
"""[s] between points of an error curve (chosen: the shortest control period)"""
LONGEST = 8.0
"""[s] shown of an error curve (chosen: slow controllers have settled by then)"""


def motion_section(arm: Arm, crossing: Mapping[str, RunLog], hold: Mapping[str, RunLog], gallery: Gallery) -> Section:
    """Build the section from one log per controller of each protocol; either may be empty."""
    parts = []
    if crossing or hold:
        parts.append(_paths(arm, crossing or hold, gallery))
    if hold or crossing:
        parts.append(_errors(arm, hold or crossing, gallery))
    return Section(key=KEY, short=SHORT, heading=HEADING, parts=tuple(parts))


def _paths(arm: Arm, logs: Mapping[str, RunLog], gallery: Gallery) -> Part:
    paths = {name: _path(arm, name, log) for name, log in logs.items()}
    limits = bounds([np.concatenate([path.tcp, path.targets]) for path in paths.values()])
    pictures = tuple(_path_picture(name, path, limits, gallery) for name, path in paths.items())
    text = (
        "The tool's way as the encoders tell it, from above and from the side, through the same targets in the same "
        "order. Square: start. Circle: the radius of 10 mm that counts as reached, about where the encoders are to "
        "stand (beside the target where a calibration says so). Compare Park et al. 2024, Fig. 13."
    )
    return Part(heading="Ways through the targets", texts=(text,), figures=pictures, columns=2)


def _path(arm: Arm, name: str, log: RunLog) -> Path3:
    rows = np.isfinite(log.target).all(axis=1)
    return Path3(
        label=short(name), look=look_of(name), tcp=encoder_path(arm, log)[rows],
        targets=np.array([visit.aim for visit in visits(arm, log)]).reshape(-1, 3),
    )  # fmt: skip


def _path_picture(name: str, path: Path3, limits: Array, gallery: Gallery) -> Picture:
    nearest = [float(np.linalg.norm(path.tcp - target, axis=1).min()) * MM for target in path.targets]
    reached = sum(distance < path.radius * MM for distance in nearest)
    return gallery.show(
        f"path-{name}", trajectory(path, limits), heading=path.label,
        alt=f"Way of the tool under {path.label} from above and from the side: it came within "
        f"{path.radius * MM:g} mm of {reached} of {len(path.targets)} targets.",
    )  # fmt: skip


def _errors(arm: Arm, logs: Mapping[str, RunLog], gallery: Gallery) -> Part:
    found = {name: visits(arm, log) for name, log in logs.items()}
    longest = max((float(v.time[-1]) for group in found.values() for v in group), default=0.0)
    time = np.arange(0.0, min(longest, LONGEST) + STEP / 2, STEP)
    series: Sequence[Series] = [_curve(name, group, time) for name, group in found.items() if group]
    words = "; ".join(f"{one.label}: {number(_last(one.value), 2, 'mm')}" for one in series)
    picture = gallery.show(
        "error-over-time", error_over_time(time, series),
        alt=f"Encoder error over the time since a target was set, log axis. Medians at the end of each line: {words}.",
        caption="Encoder error after a new target is set: median over the targets of one trial, and where 80 % of them "
        "lie. By the encoders, from where they are to stand. Dashed levels: 10, 5 and 2 mm.",
    )  # fmt: skip
    return Part(heading="Error over time", figures=(picture,))


def _curve(name: str, group: Sequence[TargetSpan], time: Array) -> Series:
    middle, low, high = spread_over_time(group, time)
    return Series(label=short(name), look=look_of(name), value=middle * MM, low=low * MM, high=high * MM)


def _last(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known[-1]) if len(known) else float("nan")
