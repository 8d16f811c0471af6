"""The page: every experiment with our numbers beside the paper's, its readings and its figures, as Markdown."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path

from rejoint.research.reproduction.campaign import finished_file
from rejoint.research.reproduction.experiment import Bench, Drawing, Finished, Number
from rejoint.research.reproduction.registry import EXPERIMENTS
from rejoint.system.files import read_json, write_whole

PAPER = "https://doi.org/10.1109/ACCESS.2024.3359268"


def write_page(bench: Bench, page: Path) -> Path:
    """Write all finished experiments of the bench to ``page``, its figures to a folder beside it; returns the page."""
    found = {
        one.name: read_json(finished_file(bench, one), Finished)
        for one in EXPERIMENTS
        if finished_file(bench, one).exists()
    }
    pictures = page.with_suffix("")
    drawings = [drawing for one in found.values() for drawing in one.findings.drawings]
    if drawings:
        pictures.mkdir(parents=True, exist_ok=True)
    for drawing in drawings:
        shutil.copyfile(bench.folder / "figures" / f"{drawing.key}.png", pictures / f"{drawing.key}.png")
    lines = [*_head(bench, list(found.values())), *_sections(found, pictures.name)]
    text = "\n".join(lines).rstrip() + "\n"
    write_whole(page, lambda temporary: temporary.write_text(text, encoding="utf-8"))
    return page


def _head(bench: Bench, found: Sequence[Finished]) -> list[str]:
    options = (" --quick" if bench.quick else "") + (f" --seed {bench.seed}" if bench.seed else "")
    lines = [
        "# The paper, run again",
        "",
        "Park, Lee, Kim and Ahn, [*Enhancement of Control Performance for Degraded Robot Manipulators Using Digital "
        f"Twin and Proximal Policy Optimization*]({PAPER}), IEEE Access 2024: its experiments in its order, with its "
        "numbers beside ours and the reading that was run wherever its text leaves room. The paper measured a real "
        "arm; everything here is simulation. The worn arm (`emulated:worn`) stands for theirs; its wear was tuned to "
        "the error of their default controller, so agreement there is a fit. Training happens in the twin alone, "
        "which shares no physics with it.",
        "",
        f"Written by `rejoint reproduce{options}`. Ranges in brackets are 95 % intervals or, where it is said, go "
        "from the lowest seed to the highest. Training times are wall-clock times of the machine that wrote this page.",
        "",
    ]
    if bench.quick:
        lines += ["**A quick run: every step is tried, nothing is worth reading as a result.**", ""]
    titles = {one.name: one.title for one in EXPERIMENTS}
    lines += [f"* [{titles[one.experiment]}](#{_anchor(titles[one.experiment])})" for one in found]
    return [*lines, ""]


def _sections(found: dict[str, Finished], pictures: str) -> Iterable[str]:
    for experiment in EXPERIMENTS:
        yield from (f"## {experiment.title}", "")
        if experiment.name not in found:
            yield from (f"Not run yet: `rejoint reproduce {experiment.name}`.", "")
            continue
        findings = found[experiment.name].findings
        for paragraph in findings.text:
            yield from (paragraph, "")
        yield from _numbers(findings.numbers)
        for drawing in findings.drawings:
            yield from _picture(drawing, pictures)
        for grid in findings.grids:
            yield from (f"**{grid.title}**", "", *table(grid.headers, grid.rows), "")
        if findings.readings:
            yield from ("Readings:", "", *(f"* {reading}" for reading in findings.readings), "")


def _numbers(numbers: Sequence[Number]) -> Iterable[str]:
    if not numbers:
        return
    rows = [(number.what, number.ours, number.paper or "-") for number in numbers]
    yield from (*table(("", "ours", "paper"), rows), "")


def _picture(drawing: Drawing, pictures: str) -> Iterable[str]:
    yield from (f"![{drawing.alt}]({pictures}/{drawing.key}.png)", "", f"*{drawing.caption}*", "")


def table(headers: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return a Markdown table; bars inside of cells are kept as text."""
    lines = [headers, ["---"] * len(headers), *rows]
    return ["| " + " | ".join(str(cell).replace("|", "\\|") for cell in line) + " |" for line in lines]


def _anchor(title: str) -> str:
    """Return the anchor that Markdown viewers give a heading."""
    kept = "".join(letter for letter in title.lower() if letter.isalnum() or letter in " -")
    return kept.replace(" ", "-")
