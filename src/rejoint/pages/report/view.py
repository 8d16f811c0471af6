"""What the page's template shows: words, tables and pictures, nothing that still needs computing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from markupsafe import Markup


class Cell(NamedTuple):
    """One cell of a table."""

    text: str
    note: str = ""
    """small print below; may have several lines"""
    whole: bool = False
    """whether it stays on one line in a table of words: a date, say"""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One row of a table; its first cell is the row's header."""

    cells: tuple[Cell, ...]
    look: int | None = None
    """number of the palette's look shown beside the header"""
    badge: str = ""
    emphasis: bool = False


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table with headers; every row has as many cells as there are headers."""

    caption: str
    headers: tuple[str, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    words: bool = False
    """whether the cells hold words rather than numbers"""

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row.cells) != len(self.headers):
                raise ValueError(f"table {self.caption!r}: {len(row.cells)} cells under {len(self.headers)} headers")


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One embedded figure."""

    svg: Markup
    heading: str = ""
    caption: str = ""


class Command(NamedTuple):
    """A command line and what it does."""

    what: str
    line: str


@dataclass(frozen=True, kw_only=True)
class Part:
    """A piece of a section, shown in the order of its fields."""

    heading: str = ""
    texts: tuple[str, ...] = ()
    lines: tuple[str, ...] = ()
    figures: tuple[Picture, ...] = ()
    columns: int = 1
    tables: tuple[Table, ...] = ()
    facts: tuple[tuple[str, str], ...] = ()
    commands: tuple[Command, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Section:
    """A section of the page; `missing` says why it is empty where it is."""

    key: str
    short: str
    heading: str
    parts: tuple[Part, ...] = ()
    missing: str = ""


class KeyNumber(NamedTuple):
    """A number that the owner should see first."""

    name: str
    value: str
    note: str = ""


class Summary(NamedTuple):
    """A list under a heading, beside the verdict."""

    heading: str
    lines: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Page:
    """The whole page."""

    title: str
    subtitle: str
    verdict: tuple[str, ...]
    keys: tuple[KeyNumber, ...] = ()
    summaries: tuple[Summary, ...] = ()
    sections: tuple[Section, ...] = ()
    footer: str = ""
