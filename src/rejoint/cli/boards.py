"""Commands that prepare measurements of where the tool really is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from rejoint.cli.console import Terminal
from rejoint.cli.options import Json
from rejoint.system.errors import InputError
from rejoint.system.extras import require


def board(
    file: Annotated[Path, typer.Argument(help="PDF to write; its description goes beside it, as .toml.")],
    on: Annotated[str, typer.Option(help="Where it is for: tool (20 mm squares) or table (30 mm squares).")] = "tool",
    squares: Annotated[
        str | None, typer.Option(help="Squares along x and y, such as 7x5; by default those of --on.")
    ] = None,
    square: Annotated[float | None, typer.Option(help="Edge of a square in mm; by default that of --on.")] = None,
    page: Annotated[str, typer.Option(help="Page, landscape: A4, A3 or letter.")] = "A4",
    measured_x: Annotated[
        float | None, typer.Option(help="Length in mm that the 100 mm ruler along x has on your print.")
    ] = None,
    measured_y: Annotated[
        float | None, typer.Option(help="Length in mm that the 100 mm ruler along y has on your print.")
    ] = None,
    json: Json = False,
) -> None:
    """Write a ChArUco board as a PDF in true size, with rulers to check the print.

    Print it at 100 %, measure both rulers with a calliper, and run the command again with `--measured-x` and
    `--measured-y`: what is off by more than 0.05 mm matters. Glue it on something flat, stiff and light.

    Example: `rejoint board board.pdf --measured-x 100.2 --measured-y 99.9`
    """
    require("rejoint board", "camera")
    from rejoint.arms.camera.board import ON_TABLE, ON_TOOL, write_board
    from rejoint.arms.camera.drawing import write_pdf

    terminal, kinds = Terminal(json=json), {"tool": ON_TOOL, "table": ON_TABLE}
    if file.suffix.lower() != ".pdf":
        raise InputError(f"{file}: expected a file name that ends in .pdf")
    if on not in kinds:
        raise InputError(f"--on {on!r}: expected one of {', '.join(kinds)}")
    chosen = kinds[on]
    if squares is not None:
        columns, rows = _pair(squares)
        chosen = replace(chosen, columns=columns, rows=rows)
    if square is not None:
        chosen = replace(chosen, square=square / 1e3, marker=chosen.marker / chosen.square * square / 1e3)
    chosen = chosen.printed(measured_x, measured_y)
    write_pdf(file, chosen, page)
    description = file.with_suffix(".toml")
    write_board(description, chosen)
    width, height = 1e3 * chosen.size
    terminal.result(f"Board of {width:.1f} x {height:.1f} mm: {file}; what the fit is to know of it: {description}")
    if measured_x is None or measured_y is None:
        terminal.say("Print it at 100 %, measure both rulers, and run this again with --measured-x and --measured-y.")
    terminal.finish({"pdf": file, "board": description, "width_mm": width, "height_mm": height})


def _pair(text: str) -> tuple[int, int]:
    """Read ``7x5``; InputError for anything else."""
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.strip().isdecimal() for part in parts):
        raise InputError(f"--squares {text!r}: expected two whole numbers such as 7x5")
    return int(parts[0]), int(parts[1])
