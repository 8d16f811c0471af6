"""The figures of one report: embedded in the page and kept for PNG files."""

from __future__ import annotations

import re
from pathlib import Path

from matplotlib.figure import Figure

from rejoint.pages.report.embed import inline_svg, save_png
from rejoint.pages.report.view import Picture

_UNSAFE = re.compile(r"[^A-Za-z0-9_-]+")


class Gallery:
    """Collects figures while the page is made; `save` writes them all."""

    def __init__(self) -> None:
        self._figures: dict[str, Figure] = {}

    def show(self, key: str, figure: Figure, *, alt: str, heading: str = "", caption: str = "") -> Picture:
        """Take in a figure under a unique ``key`` (its file name) and return it ready for the page.

        Characters of the key that do not belong into a file name become dashes.
        """
        key = _UNSAFE.sub("-", key)
        if key in self._figures:
            raise ValueError(f"two figures are called {key!r}")
        self._figures[key] = figure
        return Picture(svg=inline_svg(figure, key, alt), heading=heading, caption=caption)

    def save(self, folder: Path) -> tuple[Path, ...]:
        """Write every figure as ``folder/KEY.png``."""
        paths = tuple(folder / f"{key}.png" for key in self._figures)
        for key, figure in self._figures.items():
            save_png(figure, folder / f"{key}.png")
        return paths
