"""The figure of a path that was followed: where the tool was to be and where the encoders saw it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from rejoint.arms import Arm, Array, tcp_position
from rejoint.control.moving.drive import Followed
from rejoint.control.moving.routes import LEAD_IN
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.logs.runlog import RunLog
from rejoint.pages.report.figures import FONT, WIDE, canvas, heading
from rejoint.pages.report.gallery import Gallery
from rejoint.pages.report.palette import BLUE, INK, RED, Look


def draw_followed(folder: RunFolder, arm: Arm, done: Followed) -> Path:
    """Draw the first and the last time along a path as ``figures/follow-NAME.png``; returns the path of that."""
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
