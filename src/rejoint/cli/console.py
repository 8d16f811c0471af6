"""What the user sees at the terminal: stages, progress, tables, errors.

Results on standard output, the rest on standard error.
"""

import errno
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from io import StringIO
from pathlib import Path
from queue import Empty, Queue
from threading import Thread
from typing import IO, Any, Literal, TextIO, cast

import msgspec
import numpy as np
from rich import progress as bars
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from rejoint.system.progress import Progress
from rejoint.system.shell import is_loopback
from rejoint.system.stopping import check, raise_again

WIDTH = 80
"""Characters of a line of a table where the terminal does not say its own"""
# Characters of a cell up to which it stands on one line (chosen)
_CELL = 24
_PLAIN_INTERVAL = 10.0  # [s] between lines where the output is a file and a bar would only be noise


class _OutputFile:
    """A file whose reader may leave, as ``head`` does: the rest is lost, and the command goes on.

    A ``lossy`` one also loses what finds no space.
    """

    def __init__(self, file: TextIO, *, lossy: bool = False) -> None:
        self._file, self._lossy = file or StringIO(), lossy  # None: it was closed

    def write(self, text: str) -> int:
        """Write ``text``."""
        self._do(self._file.write, text)
        return len(text)

    def flush(self) -> None:
        """Flush."""
        self._do(self._file.flush)

    def _do(self, act: Callable[..., object], *given: str) -> None:
        try:
            act(*given)
        except OSError as error:
            if error.errno in (errno.EPIPE, errno.EIO):  # so the system calls a terminal that was closed
                into_nothing(self._file)
            elif not self._lossy:
                raise

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - whatever that file has
        return getattr(self._file, name)


def into_nothing(file: IO[str]) -> None:
    """Lose what is still written to a ``file`` that takes nothing any more."""
    with suppress(OSError, ValueError):  # no file of the system
        os.dup2(os.open(os.devnull, os.O_WRONLY), file.fileno())


Shown = Iterable[str | tuple[Any, ...]]
"""Lines, and tables as `Terminal.table` takes them"""


class Terminal:
    """Where a command writes. One per command."""

    def __init__(self, *, json: bool = False, dry: bool = False) -> None:
        """Take whether the command ends with JSON, and whether it simulates."""
        self.json, self._dry, self._of = json, dry, "In the simulation: " if dry else ""
        self.results = Console(file=cast(TextIO, _OutputFile(sys.stdout)), highlight=False, soft_wrap=True)
        if not self.results.is_terminal:
            self.results.width = WIDTH
        notes = cast(TextIO, _OutputFile(sys.stderr, lossy=True))
        self.notes = Console(file=notes, highlight=False, soft_wrap=True)
        """standard error, for what is no result"""
        self.bars = ExitStack()
        """bars that are shown; closed where something else is to be seen"""

    def message(self, line: str) -> None:
        """Tell what is going on."""
        self.notes.print(line, markup=False)

    def say_open(self, host: str) -> None:
        """Tell that other computers reach what listens at ``host``, if they do."""
        if not is_loopback(host):
            self.message(f"Other computers can use it too, without a password: it listens on {host}.")

    def result(self, text: str) -> None:
        """Print a line of the result."""
        self.results.print(f"{self._of}{text}", markup=False)

    def show(self, parts: Shown) -> None:
        """Print lines and tables of the result."""
        for part in parts:
            if isinstance(part, tuple):
                self.table(*part)
            else:
                self.result(part)

    def next(self, text: str) -> None:
        """Print the command that comes next; a dry run leads to none."""
        if not self._dry:
            self.message(f"Next: {text}")

    def table(self, title: str, headers: Sequence[str], rows: Sequence[Sequence[str]], bold: int | None = None) -> None:
        """Print a table with the row ``bold`` set off.

        A column without text is left out; a wide table is split.
        """
        title, width = f"{self._of}{title}", self.results.width
        columns = [column for column in zip(headers, *rows, strict=True) if any(column[1:])]
        for part in _parts(columns, width):
            table = Table(title=Text(title), title_justify="left", header_style="bold")
            spare = max(width - 1 - sum(_least(column) + 3 for column in part), 0)
            for index, column in enumerate(part):
                wide = min(max(map(cell_len, column)), _least(column) + spare)
                spare -= wide - _least(column)
                # as text: square brackets are units here, and no markup
                justify: Literal["left", "right"] = "right" if index else "left"
                table.add_column(Text(column[0]), justify=justify, overflow="fold", width=wide)
            for number, row in enumerate(zip(*(column[1:] for column in part), strict=True)):
                table.add_row(*map(Text, row), style="bold" if number == bold else None)
            self.results.print(table, soft_wrap=False)
            title = ""

    def finish(self, value: object) -> None:
        """Print ``value`` as one JSON object on the last line, if ``--json`` was given."""
        if self.json:
            value = {**value, "dry_run": True} if self._dry and isinstance(value, dict) else value
            self.results.file.write(msgspec.json.encode(value, enc_hook=_plain).decode() + "\n")
            self.results.file.flush()

    @contextmanager
    def bar(self, title: str) -> Iterator[Progress]:
        """Show a bar on a terminal, and a line now and then elsewhere."""
        if not self.notes.is_terminal:
            last = time.monotonic()

            def tell(share: float, what: str) -> None:
                nonlocal last
                raise_again()
                if time.monotonic() - last >= _PLAIN_INTERVAL:
                    last = time.monotonic()
                    self.message(f"{title}: {f'{100 * share:.0f} % ' if share >= 0.005 else ''}{what}".rstrip())

            yield tell
            return
        columns = (*bars.Progress.get_default_columns(), bars.TextColumn("{task.fields[what]}"))
        with bars.Progress(*columns, console=self.notes, transient=True) as bar:
            task = bar.add_task(title, total=None, what="")

            def update(share: float, what: str) -> None:
                raise_again()
                bar.update(task, completed=share, total=1.0 if share else None, what=what)  # none: it only moves

            yield update


LOOK = 0.05
"""[s] between two looks for signals (chosen)"""


def typed(meanwhile: Callable[[], object] = lambda: None) -> Iterator[bytes]:
    """Yield the lines of standard input; waiting for one blocks neither signals nor ``meanwhile``."""
    came, handle = Queue[bytes](1), sys.stdin.fileno()

    def read() -> None:
        with open(handle, "rb", closefd=False) as file, suppress(OSError):
            for line in file:
                came.put(line)
        came.put(b"")

    Thread(target=read, daemon=True).start()
    while True:
        check()
        meanwhile()
        with suppress(Empty):
            if not (line := came.get(timeout=LOOK)):
                return
            yield line


def _parts(columns: Sequence[Sequence[str]], most: int) -> list[list[Sequence[str]]]:
    parts = [list(columns[:1])]
    for column in columns[1:]:
        if len(parts[-1]) > 1 and sum(_least(one) + 3 for one in [*parts[-1], column]) >= most:
            parts.append([columns[0]])
        parts[-1].append(column)
    return parts


def _least(column: Sequence[str]) -> int:
    words = [cell_len(word) for cell in column for word in cell.split()]
    whole = [min(cell_len(cell), _CELL) for cell in column[1:]]
    return min(max([*words, *whole]), WIDTH // 2)


def picked(value: object, *names: str) -> dict[str, Any]:
    """Return some fields of a result by name."""
    return {name: getattr(value, name) for name in names}


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"a {type(value).__name__} has no place in JSON")


OPTION = "--live"
HERE = "127.0.0.1:8080"
"""Where the page is unless something else is said: this computer alone reaches it"""
_PLACE = re.compile(r"[A-Za-z0-9_.-]+:\d{1,5}|\d{4,5}")


def with_place(words: Sequence[str]) -> list[str]:
    """Give a bare ``--live`` its place: what follows belongs to it where it reads HOST:PORT, or PORT."""
    return [
        f"{OPTION}={HERE}" if word == OPTION and not _PLACE.fullmatch("".join(words[k + 1 : k + 2])) else word
        for k, word in enumerate(words)
    ]
