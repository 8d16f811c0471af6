"""What the panel of the page says: short texts in HTML, made of numbers in millimetres, degrees and seconds."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np

from rejoint.pages.live.ring import Records

RED, AMBER, GREEN, GREY = "#c92a2a", "#b35c00", "#2b8a3e", "#868e96"
HOT = 55.0
"""[deg C] from which a temperature is set off (chosen: 10 below the guard's limit)"""


@dataclass(frozen=True, kw_only=True)
class Doing:
    """What is being done, and how far it is."""

    title: str = ""
    """the command, or the stage of a repair"""
    what: str = ""
    """in a few words"""
    share: float = 0.0
    """that is done, 0 to 1"""
    since: float = 0.0
    """[s] for which it lasts"""

    @property
    def left(self) -> float | None:
        """[s] that it will still take; None before there is enough to say."""
        return self.since * (1.0 - self.share) / self.share if 0.02 < self.share < 1.0 and self.since > 2.0 else None


def head(robot: str, controller: str, doing: Doing) -> str:
    """Say which arm it is, what is being done, and how long it will take."""
    left = "" if doing.left is None else f" · about {duration(doing.left)} left"
    share = f"{100 * doing.share:.0f} % done{left}" if doing.share else ""
    lines = [
        f"<b>{escape(robot)}</b>" + (f" · {escape(controller)}" if controller else ""),
        f"<b>{escape(doing.title)}</b>" + (f" · {escape(doing.what)}" if doing.what not in ("", doing.title) else ""),
        f"<span style='color:{GREY}'>{share}</span>",
    ]
    return _box("<br>".join(lines))


def duration(seconds: float) -> str:
    """``40 s``, ``3 min`` or ``1 h 20 min``."""
    if seconds < 90.0:
        return f"{5 * np.ceil(seconds / 5):.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def error(errors: tuple[float, float], within: float) -> str:
    """Give encoder error and true error [m] in millimetres, in the colour of whether they are accepted."""
    encoder, true = errors
    if not np.isfinite(encoder):
        return _box(f"<span style='color:{GREY}'>no target now</span>")
    colour = GREEN if encoder < within else AMBER
    told = f"; the tool itself {_mm(true)} mm off" if np.isfinite(true) else ""
    return _box(
        f"<span style='font-size:1.5em;color:{colour}'><b>{_mm(encoder)} mm</b></span> "
        f"<span style='color:{GREY}'>off by its encoders{told}; {1e3 * within:g} mm are accepted</span>"
    )


def guard(words: tuple[str, ...], stopped: str) -> str:
    """Say what the guard does: nothing, limits, or that the motion has ended, and why."""
    if stopped:
        return _box(f"<b style='color:{RED}'>Stopped, the arm holds.</b> {escape(stopped)}", RED)
    if not words:
        return _box(f"<b style='color:{GREEN}'>Guard:</b> every command passes", GREEN)
    return _box(f"<b style='color:{AMBER}'>Guard:</b> " + "<br>".join(map(escape, words)), AMBER)


def joints(names: tuple[str, ...], records: Records) -> str:
    """Table of the joints: where each is, how far its command is ahead, load, temperature."""
    if not len(records):
        return ""
    q, lead = np.degrees(records.position[-1]), np.degrees(records.command[-1] - records.position[-1])
    load, heat = records.load[-1], records.temperature[-1]
    rows = [
        f"<tr><td>{escape(name)}</td><td style='{_RIGHT}'>{q[j]:.1f}</td><td style='{_RIGHT}'>{lead[j]:+.1f}</td>"
        f"<td>{_bar(float(load[j]))}</td><td style='{_RIGHT}'>{_heat(float(heat[j]))}</td></tr>"
        for j, name in enumerate(names)
    ]
    titles = "".join(
        f"<th style='{align};font-weight:normal;color:{GREY}'>{title}</th>"
        for title, align in (
            ("joint", "text-align:left"),
            ("at deg", _RIGHT),
            ("lead deg", _RIGHT),
            ("load", "text-align:center"),
            ("°C", _RIGHT),
        )
    )
    return _box(f"<table style='width:100%;border-spacing:0'><tr>{titles}</tr>{''.join(rows)}</table>")


def legend(entries: tuple[tuple[str, str], ...]) -> str:
    """Say what the colours mean: pairs of a CSS colour and a text."""
    spots = (
        f"<span style='white-space:nowrap'><span style='color:{colour}'>&#9679;</span> {escape(text)}</span>"
        for colour, text in entries
    )
    return _box(f"<span style='color:{GREY}'>{' &nbsp; '.join(spots)}</span>")


_RIGHT = "text-align:right"


def _mm(metres: float) -> str:
    value = 1e3 * metres
    return f"{value:.2f}" if value < 10.0 else f"{value:.1f}"


def _bar(load: float) -> str:
    """Bar of a load, a share of the largest: to the right where it is positive."""
    if not np.isfinite(load):
        return f"<div style='text-align:center;color:{GREY}'>–</div>"
    wide, colour = 50.0 * min(abs(load), 1.0), RED if abs(load) > 0.9 else "#4c6ef5"
    start = 50.0 if load >= 0.0 else 50.0 - wide
    return (
        f"<div title='{100 * load:.0f} %' style='position:relative;height:0.6em;margin:0 0.4em;background:#e9ecef'>"
        f"<div style='position:absolute;left:{start:.0f}%;width:{wide:.0f}%;height:100%;background:{colour}'></div>"
        "</div>"
    )


def _heat(celsius: float) -> str:
    if not np.isfinite(celsius):
        return f"<span style='color:{GREY}'>–</span>"
    return f"<b style='color:{RED}'>{celsius:.0f}</b>" if celsius > HOT else f"{celsius:.0f}"


def _box(content: str, edge: str = "transparent") -> str:
    return (
        f"<div style='font-size:0.85em;line-height:1.45;margin:0 0.6em 0.4em;padding-left:0.5em;"
        f"border-left:3px solid {edge}'>{content}</div>"
    )
