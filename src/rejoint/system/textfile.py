"""Text with columns, as programs, spreadsheets and people write it: of logs, targets and measurements."""

import codecs
import csv
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rejoint.system.errors import FileError, first_line
from rejoint.system.files import MEGABYTE, read_bounded, reading
from rejoint.system.records import entity

TEXT_MOST = 200 * MEGABYTE
"""[bytes] (chosen)"""
DAMAGED = 0.02
"""Largest share of damaged numbers (chosen)"""
ANGLES = {"deg": np.pi / 180.0, "rad": 1.0, "rev": 2.0 * np.pi}
"""[rad] units of angles in titles"""
LENGTHS = {"mm": 1e-3, "um": 1e-6, "cm": 1e-2, "m": 1.0, "in": 25.4e-3}
"""[m] units of lengths in titles"""
COUNT = {"": 1.0}
"""Of numbers without a unit"""

_SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "spaces"}
# Encodings in the order of the attempts
_CODECS = {"utf-8-sig": "UTF-8", "utf-16": "UTF-16", "utf-16-le": "UTF-16", "utf-16-be": "UTF-16", "latin-1": "Latin-1"}
_CONTROL = re.compile(r"[\x00-\x08\x0e-\x1f]")
# First line by which a spreadsheet is told the separator
_DECLARED = re.compile(r'\s*"?sep=(.)"?\s*')
# Comments, and the line above; a cell may be #N/A
_ASIDE = re.compile(r'\s*(#(?!n/a)|%|//|"?sep=.)', re.IGNORECASE)
# [bytes] of a file that are looked at to tell what it is (chosen)
_HEAD = 65_536
# Lines by which a separator is chosen (chosen)
_LINES = 20
# Titles that an error shows (chosen)
_SHOWN = 24
# Cells that hold no number, in small letters
_EMPTY = ("", "-", "null", "none", "na", "n/a", "#n/a")
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.ASCII | re.IGNORECASE)
_DATE = re.compile(r"\d{4}-\d\d-\d\d[T ]")
_UNIT = re.compile(r"(?P<name>.+?)(?:[_ /]|\s*[\[(]\s*)(?P<unit>[^\W_]+)\s*[\])]?$")
# What spreadsheets of some languages, such as Swedish, write before a negative number
_MINUS = "\N{MINUS SIGN}"
_REMEDY = "mend the line or take another file"


@entity
class Sheet:
    """A table of a text file."""

    path: Path
    titles: tuple[str, ...]
    """of columns, or ``1``, ``2`` and so on"""
    rows: tuple[str, ...]
    lines: NDArray[np.int64]
    """(rows,) in the file"""
    separator: str
    found: str
    """encoding and separator"""
    remarks: tuple[str, ...]
    """how it was read, if not as UTF-8 with commas and titles, and what is left out of it"""
    sound: bool
    """no cell may be damaged"""
    dated: bool
    """the first row holds a date: [s] since 1970"""

    def __len__(self) -> int:
        return len(self.lines)

    def _cells(self) -> Iterator[list[str]]:
        """Trimmed cells, row by row, NaN in a damaged row; FileError."""
        width, wrong = len(self.titles), {}
        rows = csv.reader(self.rows, delimiter=self.separator, skipinitialspace=True, strict=True)
        try:
            for line, row in zip(self.lines, rows, strict=True):
                if len(row) != width and row[width:] != [""]:
                    hint = " (decimal commas need another separator between columns)"
                    hint *= self.separator == "," and len(row) > width
                    wrong[f"line {line}"] = f"{len(row)} columns, the header has {width}{hint}"
                    row = ["nan"] * width
                yield [cell.strip() for cell in row]
            self._refuse(wrong, _REMEDY)
        except (csv.Error, ValueError) as error:
            raise FileError(self.path, f"no table, or a quote does not end ({first_line(error)})", _REMEDY) from error

    def _refuse(self, wrong: dict[str, str], remedy: str) -> None:
        """Raise FileError for what is ``wrong`` where, if that is too much; it names the places of all, up to five."""
        if len(wrong) > (0 if self.sound else DAMAGED * len(self)):
            first, *others = wrong
            more = f", {len(others) - 4} more" * (len(others) > 4)
            also = f" (also wrong: {', '.join(others[:4])}{more})" * bool(others)
            raise FileError(self.path, f"{first}: {wrong[first]}{also}", remedy)

    def words(self, column: int) -> list[str]:
        """Cells of a column; FileError."""
        return [row[column] for row in self._cells()]

    def numbers(self, columns: Sequence[int]) -> NDArray[np.float64]:
        """Columns (rows, columns) as numbers, NaN: empty, inf: damaged; FileError.

        Commas are decimal where no cell has a point.
        """
        taken = [[row[column] for column in columns] for row in self._cells()]
        pointed = any("." in cell for row in taken for cell in row)
        values, wrong = np.full((len(self), len(columns)), np.nan), {}
        for k, row in enumerate(taken):
            for place, cell in enumerate(row):
                if cell.casefold() in _EMPTY:
                    continue
                try:
                    number = cell if pointed else cell.replace(",", ".")
                    dated = _DATE.match(cell)
                    values[k, place] = datetime.fromisoformat(cell).timestamp() if dated else float(number)
                except ValueError:
                    said = f"{cell[:40]!r} is no number"
                    wrong[f"line {self.lines[k]}, column {self.titles[columns[place]]}"] = said
                    values[k, place] = np.inf
        self._refuse(wrong, "mend the cell; dates as ISO 8601 or seconds")
        return values


def shown(titles: Sequence[str]) -> str:
    """Join titles in one short line."""
    short = [re.sub(r"\s+", " ", title)[:120] or "(no name)" for title in titles[:_SHOWN]]
    return (", ".join(short) or "none") + (f" and {len(titles) - _SHOWN} more" if len(titles) > _SHOWN else "")


def split_unit(title: str, units: Collection[str]) -> tuple[str, str | None]:
    """Split ``elbow_deg``, ``elbow deg``, ``elbow/deg`` or ``elbow [DEG]`` into name and unit, or None."""
    found, known = _UNIT.match(title.replace("°", "deg")), {unit.casefold(): unit for unit in units}
    if found and (unit := known.get(found["unit"].casefold())):
        return found["name"], unit
    return title, None


def read_sheet(path: Path, *, whole: bool = True, most: int = TEXT_MOST) -> Sheet:
    """Read a table of at most ``most`` bytes; FileError.

    Unless ``whole``, cells may be damaged, and an incomplete last line is left out.
    """
    with reading(path, "not readable", "check the path and its permissions"):
        data = read_bounded(path, "cut it into several files", most)
    return _parsed(*_decoded(data, path), path, whole=whole)


def read_columns(
    path: Path,
    meanings: Mapping[str, Mapping[str, float] | None],
    needed: Collection[str],
    filled: Collection[str] = (),
    *,
    most: int,
    exact: bool = True,
) -> tuple[dict[str, Any], NDArray[np.int64]]:
    """Columns of a text table by name, and the line of each row.

    ``meanings``: name to SI factors of its units, or None for words. FileError for missing ``needed`` columns, other
    units, and empty cells in those ``filled``. Unless ``exact``, a title without a unit has the first, and other
    columns are refused.
    """
    sheet, found = read_sheet(path, most=most), {}
    names = {name.casefold(): name for name in meanings}
    known = {unit for one in meanings.values() for unit in one or ()}
    usual = {name: next(iter(units or COUNT)) for name, units in meanings.items()}
    titled = {name: f"{name}_{unit}" if unit and exact else name for name, unit in usual.items()}
    for index, title in enumerate(sheet.titles):
        stem, unit = split_unit(title.casefold(), known)
        if stem not in names:
            if exact:
                continue
            raise FileError(path, f"column {title} is not known", f"name it {' or '.join(titled)}, or leave it out")
        name = names[stem]
        units = meanings[name] or COUNT
        unit = unit or ("" if exact else usual[name])
        if unit not in units or name in found:
            raise FileError(
                path, f"column {title} has no unit or another one, or comes twice", f"name it {titled[name]}"
            )
        found[name] = sheet.words(index) if meanings[name] is None else units[unit] * sheet.numbers([index])[:, 0]
        if name in filled and np.isnan(found[name]).any():
            line = sheet.lines[np.argmax(np.isnan(found[name]))]
            raise FileError(path, f"line {line}, column {title} is empty", "mend that line")
    if missing := [titled[name] for name in needed if name not in found]:
        raise FileError(path, f"columns {shown(sheet.titles)}; missing: {', '.join(missing)}", "add them")
    return found, sheet.lines


def head(path: Path) -> Sheet | None:
    """Read the beginning of a table, or None."""
    try:
        with path.open("rb") as file:
            data = file.read(_HEAD)
        cut = len(data) == _HEAD
        text, encoding = _decoded(data, path, cut=cut)
        if text.lstrip().startswith(("{", "[", "<")):
            return None
        sheet = _parsed(text.rpartition("\n")[0] if cut else text, encoding, path)
    except (OSError, FileError):
        return None
    return sheet if len(sheet.titles) > 1 else None


def _decoded(data: bytes, path: Path, *, cut: bool = False) -> tuple[str, str]:
    """Return the text of ``data``, perhaps ``cut`` at its end, and its encoding: the first that gives mostly ASCII."""
    if not data.strip():
        raise FileError(path, "is empty", "fill it, or take another file")
    if data.startswith(b"PK\x03\x04"):
        raise FileError(path, "a spreadsheet or a packed file, expected text with columns", "save it as CSV")
    for codec, name in _CODECS.items():
        with suppress(UnicodeError):
            text = codecs.getincrementaldecoder(codec)().decode(data, final=not cut)
            start = text[:4096]
            if not _CONTROL.search(text) and 2 * sum(map(str.isascii, start)) > len(start):
                return text.replace(_MINUS, "-"), name
    raise FileError(path, "no text: it holds control characters", "save it as text, or take another file")


def _parsed(text: str, encoding: str, path: Path, *, whole: bool = True) -> Sheet:
    lines = text.splitlines()
    ends = len(f"{text}.".splitlines()) > len(lines)
    chosen = [i for i, line in enumerate(lines) if line.strip() and not _ASIDE.match(line)]
    if not chosen:
        raise FileError(path, f"text in {encoding} without a table", "record it again")
    above = lines[: chosen[0]]
    declared = [found[1] for line in above if (found := _DECLARED.fullmatch(line))]
    separator = declared[-1] if declared else _separator([lines[i] for i in chosen[:_LINES]])
    if separator == " ":
        lines = [" ".join(line.split()) for line in lines]
    chosen = [i for i in chosen if lines[i].strip(f"{separator} \t")]
    # headings and what a sketch prints fill one cell, rows of a table several; titles hold no number
    cells = [_split(lines[i], separator) for i in chosen[:_LINES]]
    counts = [sum(map(bool, row)) for row in cells]
    several = [k for k, count in enumerate(counts) if count > 1 < max(counts) - 1]
    full = next((k for k in several if counts[k] == max(counts) and any(map(_plain, cells[k]))), len(cells))
    prints = next((k for k in several if k < full and not any(map(_plain, cells[k]))), min(several, default=0))
    titles = cells[prints] if cells else []
    second = next((row for row in cells[prints + 1 :] if any(map(_plain, row))), [])  # not one of units
    alike = all(_plain(one) >= _plain(other) for one, other in zip(titles, second, strict=False) if one and other)
    named = not (alike and any(map(_plain, titles)))  # a row without titles may hold words
    rows = chosen[prints + named :]
    if not named:
        comment = _split(above[-1].lstrip("#%/ \t"), separator) if above else []
        named = len(comment) == len(titles)
        titles = comment if named else [str(i + 1) for i in range(len(titles))]
    if not (whole or ends):
        rows = rows[:-1] or rows
    # a text without columns has no separator; "one column" keeps an error about it true
    parted = f"columns parted by {_SEPARATORS.get(separator, separator)}" if len(titles) > 1 else "one column"
    untitled = "" if named else ", without a line of titles"
    described = f"{encoding}, {parted}{untitled}" + f", after {prints} other line(s)" * bool(prints)
    remarks = [] if encoding == "UTF-8" and separator == "," and named and not prints else [f"read as {described}"]
    if not ends:
        remarks.append("the last line does not end and may be cut: left out")
    return Sheet(
        path=path,
        titles=tuple(titles),
        rows=tuple(lines[i] for i in rows),
        lines=np.array(rows, dtype=np.int64) + 1,
        separator=separator,
        found=described,
        remarks=tuple(remarks),
        sound=whole,
        dated=any(map(_DATE.match, _split(lines[rows[0]], separator) if rows else [])),
    )


def _plain(cell: str) -> bool:
    return bool(_NUMBER.fullmatch(cell) or _DATE.match(cell))


def _split(line: str, separator: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]
    except csv.Error:
        return [line]


def _separator(lines: list[str]) -> str:
    best, chosen = (0.0, 0), ","
    for separator in _SEPARATORS:
        counts = [len(_split(" ".join(line.split()) if separator == " " else line, separator)) for line in lines]
        usual = max(counts, key=lambda count: (counts.count(count) * (count > 1), count), default=0)
        score = (counts.count(usual) / len(counts), usual)
        # titles and bars have spaces around them
        if usual > 1 and score > best and not (separator == " " and best[0] > 0.5):
            best, chosen = score, separator
    return chosen
