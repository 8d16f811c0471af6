"""Tables that people, spreadsheets and trackers write: which column is which, in which unit, and what its cells say.

A title is a name and its unit, ``x_mm`` or ``X [mm]``. Separators, decimal commas, encodings and comments are those of
`rejoint.logs.textfile`. Columns that mean something else, such as a number or a note, are left alone.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rejoint.arms import Array
from rejoint.logs.textfile import Sheet, has_decimal_commas, number, read_sheet
from rejoint.system.errors import FileError
from rejoint.system.files import MEGABYTE, require_file

SHEET_MOST = 4 * MEGABYTE
"""Largest such file that is read (chosen: ten thousand rows)"""
ANGLES = {"deg": np.pi / 180.0, "rad": 1.0}
"""[rad] units of angles"""
LENGTHS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 25.4e-3}
"""[m] units of lengths"""
COUNT = {"": 1.0}
"""What has no unit"""
EMPTY = ("", "-")
"""Cells of what was not measured"""

_BRACKETS = re.compile(r"^(.*?)\s*[\[(]\s*(\w+)\s*[\])]$")
_ROOT = re.compile(r"[^a-z0-9]")

Units = Mapping[str, float]
"""Endings of titles, and what is one of each in SI units"""


@dataclass(frozen=True, kw_only=True)
class Columns:
    """The columns of a sheet that have a meaning."""

    sheet: Sheet
    places: Mapping[str, tuple[int, float]]
    """name to column and unit"""
    commas: bool
    """whether numbers have decimal commas"""

    def __len__(self) -> int:
        """Count the rows."""
        return len(self.sheet.rows)

    def line(self, row: int) -> int:
        """Return the line of a row in the file."""
        return self.sheet.numbers[row]

    def words(self, name: str) -> list[str]:
        """Return the cells of a column."""
        return [row[self.places[name][0]].strip() for row in self.sheet.rows]

    def numbers(self, name: str) -> Array:
        """Return a column (rows,) in SI units, NaN for an empty cell; FileError for what is no finite number."""
        column, unit = self.places[name]
        title, values = self.sheet.titles[column], []
        for line, cell in zip(self.sheet.numbers, self.words(name), strict=True):
            value = number("" if cell in EMPTY else cell, (self.sheet, line, title), commas=self.commas)
            if np.isinf(value):
                raise FileError(self.sheet.path, f"line {line}, column {title}: an infinite number", "mend the cell")
            values.append(unit * value)
        return np.array(values, dtype=float)

    def filled(self, name: str) -> Array:
        """Return a column in which no cell may be empty."""
        values = self.numbers(name)
        if np.isnan(values).any():
            row = int(np.argmax(np.isnan(values)))
            title = self.sheet.titles[self.places[name][0]]
            raise FileError(self.sheet.path, f"line {self.line(row)}, column {title} is empty", "mend that line")
        return values


def read_columns(path: Path, meanings: Mapping[str, Units | None], needed: Collection[str]) -> Columns:
    """Read a table whose columns may have ``meanings``: name to units, or None for words.

    FileError where a ``needed`` one is missing, a title is there twice, or one of ours has no unit that is known.
    """
    require_file(path, SHEET_MOST, "give fewer rows")
    sheet = read_sheet(path)
    places: dict[str, tuple[int, float]] = {}
    for index, title in enumerate(sheet.titles):
        found = _meaning(path, title, meanings)
        if found is None:
            continue
        if found[0] in places:
            other = sheet.titles[places[found[0]][0]]
            raise FileError(path, f"columns {other} and {title} are both {found[0]}", "leave one of them out")
        places[found[0]] = (index, found[1])
    if missing := [_titled(name, meanings[name]) for name in needed if name not in places]:
        wanted = ", ".join(_titled(name, meanings[name]) for name in needed)
        raise FileError(path, f"columns {sheet.shown}; missing: {', '.join(missing)}", f"name them {wanted}")
    numeric = [column for name, (column, _) in places.items() if meanings[name] is not None]
    return Columns(sheet=sheet, places=places, commas=has_decimal_commas(sheet, numeric))


def _meaning(path: Path, title: str, meanings: Mapping[str, Units | None]) -> tuple[str, float] | None:
    """Return which of the ``meanings`` a title has, and its unit; None for something else."""
    bracket = _BRACKETS.match(title)
    plain = (f"{bracket[1]}_{bracket[2]}" if bracket else title).casefold()
    for name, units in meanings.items():
        for ending, unit in (units or COUNT).items():
            if plain == (f"{name}_{ending}" if ending else name).casefold():
                return name, unit
    roots = {_ROOT.split(name.casefold())[0] for name in meanings}
    if _ROOT.split(plain)[0] not in roots:
        return None
    known = [_titled(name, units) for name, units in meanings.items() if plain == name.casefold()]
    if known:
        raise FileError(path, f"column {title} does not say its unit", f"name it {known[0]}")
    raise FileError(path, f"column {title} is not known", f"name it as one of {_examples(meanings)}, or otherwise")


def _titled(name: str, units: Units | None) -> str:
    ending = next(iter(units or COUNT))
    return f"{name}_{ending}" if ending else name


def _examples(meanings: Mapping[str, Units | None]) -> str:
    """Name one column of each kind."""
    first: dict[str, str] = {}
    for name, units in meanings.items():
        first.setdefault(_ROOT.split(name.casefold())[0], _titled(name, units))
    return ", ".join(first.values())
