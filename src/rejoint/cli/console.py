"""What the person at the terminal sees: stages, progress, tables, errors.

Results go to standard output, everything else to standard error, so that results can be piped.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich import progress as bars
from rich.console import Console
from rich.table import Table

from rejoint.system.errors import UnsavedError
from rejoint.system.progress import Progress

_PLAIN_INTERVAL = 10.0  # [s] between lines where the output is a file and a bar would only be noise


class Terminal:
    """Where a command writes. One per command."""

    def __init__(self, *, json: bool = False) -> None:
        self.json = json
        self.results = Console(file=sys.stdout, highlight=False, soft_wrap=True)
        self.notes = Console(file=sys.stderr, highlight=False, soft_wrap=True)

    def say(self, text: str) -> None:
        """Tell what is going on."""
        self.notes.print(text, markup=False)

    def stage(self, text: str) -> None:
        """Announce a stage of a chain."""
        self.notes.print(f"\n[bold]{text}[/bold]")

    def result(self, text: str) -> None:
        """Print a line of the result."""
        self.results.print(text, markup=False)

    def table(self, title: str, headers: Sequence[str], rows: Sequence[Sequence[str]], bold: int | None = None) -> None:
        """Print a table; the row ``bold`` is set off."""
        table = Table(title=title, title_justify="left", header_style="bold")
        for index, header in enumerate(headers):
            table.add_column(header, justify="left" if index == 0 else "right", overflow="fold")
        for index, row in enumerate(rows):
            table.add_row(*row, style="bold" if index == bold else None)
        wide = self.results if self.results.is_terminal else Console(file=sys.stdout, width=160, highlight=False)
        wide.print(table)

    def finish(self, value: object) -> None:
        """Print ``value`` as one JSON object on the last line, if ``--json`` was given."""
        if self.json:
            sys.stdout.write(msgspec.json.encode(value, enc_hook=_plain).decode() + "\n")
            sys.stdout.flush()

    @contextmanager
    def unsaved(self, show: Callable[[Any], object]) -> Iterator[None]:
        """Show the result of a stage that could not write it, by ``show``, before the error goes on."""
        try:
            yield
        except UnsavedError as error:
            show(error.result)
            raise

    @contextmanager
    def progress(self, title: str) -> Iterator[Progress]:
        """Show a bar on a terminal, and a line now and then elsewhere."""
        if not self.notes.is_terminal:
            yield _plain_progress(self, title)
            return
        columns = (
            bars.TextColumn("{task.description}"), bars.BarColumn(), bars.TextColumn("{task.percentage:>3.0f} %"),
            bars.TimeElapsedColumn(), bars.TimeRemainingColumn(), bars.TextColumn("{task.fields[what]}"),
        )  # fmt: skip
        with bars.Progress(*columns, console=self.notes, transient=True) as bar:
            task = bar.add_task(title, total=None, what="")

            def update(share: float, what: str) -> None:
                bar.update(task, completed=share, total=1.0, what=what)

            yield update


def _plain(value: object) -> object:
    """Turn what JSON does not know into what it does."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"a {type(value).__name__} has no place in JSON")


def _plain_progress(terminal: Terminal, title: str) -> Progress:
    last = time.monotonic()

    def update(share: float, what: str) -> None:
        nonlocal last
        if time.monotonic() - last >= _PLAIN_INTERVAL:
            last = time.monotonic()
            terminal.say(f"{title}: {100 * share:.0f} % {what}".rstrip())

    return update
