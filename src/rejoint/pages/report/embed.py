"""Figures as PNG files and as inline SVG that follows the page's light or dark theme."""

from __future__ import annotations

import io
import re
from pathlib import Path

import matplotlib as mpl
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from rejoint.pages.report.palette import GROUND, INK, LOOKS
from rejoint.system.files import write_whole

PNG_DPI = 160
"""[1/inch] chosen: sharp in a slide or a printed letter"""

_ID = re.compile(r'(\bid="|xlink:href="#|url\(#)')
_HEAD = re.compile(r"^.*?(?=<svg)", re.DOTALL)
_SIZE = re.compile(r'<svg [^>]*viewBox="([^"]+)"[^>]*>')
_METADATA = re.compile(r"\s*<metadata>.*?</metadata>", re.DOTALL)
_NOISE = re.compile(r" font-family: [^;]*;|\s*<style type=\"text/css\">.*?</style>|(?<=[\dz]) (?=\n)", re.DOTALL)


def inline_svg(figure: Figure, key: str, alt: str) -> Markup:
    """Return the figure as SVG that needs nothing from outside.

    Text stays text in the page's own font, ink becomes the text colour of the page, and the colours
    of the palette become the variables that `theme_css` sets. ``key`` keeps identifiers apart from
    those of other figures on the page; ``alt`` is read out in place of the picture.
    """
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
    """Write the figure on white ground as PNG."""
    write_whole(
        path,
        lambda temporary: figure.savefig(
            temporary, format="png", dpi=PNG_DPI, facecolor="white", metadata={"Software": None}
        ),
    )


def theme_css() -> dict[str, str]:
    """Return the palette as CSS declarations for the light and the dark theme."""
    return {
        theme: "".join(f"--look-{i}:{getattr(look, name)};" for i, look in enumerate(LOOKS))
        for theme, name in (("light", "colour"), ("dark", "dark"))
    }
