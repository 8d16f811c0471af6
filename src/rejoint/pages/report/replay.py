"""The page of a replay: twins judged on logs, without a run folder."""

from __future__ import annotations

from pathlib import Path

from rejoint.pages.report.gallery import Gallery
from rejoint.pages.report.page import render
from rejoint.pages.report.sections.trust import trust_section
from rejoint.pages.report.trust import answer
from rejoint.pages.report.view import Page
from rejoint.pages.report.words import plural
from rejoint.system.files import write_json, write_whole
from rejoint.system.version import __version__
from rejoint.twin.judgement import Judgement

CAVEAT = "A motion that a twin was fitted to flatters it; which those are, neither the twin nor the logs tell."


def write_replay(folder: Path, judgement: Judgement, *, twin: str, logs: str) -> Path:
    """Write ``replay.html``, ``replay.json`` and ``figures/*.png`` into a folder and return the page's path.

    ``twin`` and ``logs`` name what was judged and on what.
    """
    gallery = Gallery()
    section = trust_section(judgement, gallery)
    page = Page(
        title=f"Replay: {judgement.arm}",
        subtitle=f"{twin} on {plural(len(judgement.motions), 'motion')} of {logs}",
        verdict=(*answer(judgement)[:2], CAVEAT),
        sections=(section,),
        footer=f"Made by rejoint {__version__}.",
    )
    html = render(page)
    write_json(folder / "replay.json", judgement)
    gallery.save(folder / "figures")
    path = folder / "replay.html"
    write_whole(path, lambda temporary: temporary.write_text(html, encoding="utf-8"))
    return path
