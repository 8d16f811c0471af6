"""Text with columns, as programs, spreadsheets and people write it."""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
from numpy.typing import NDArray

from rejoint.system.errors import FileError, first_line
from rejoint.system.files import MEGABYTE, read_bounded

TEXT_MOST = 200 * MEGABYTE
"""[bytes] (chosen)"""

_SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "spaces"}
_COMMENTS = ("#", "%", "//")
_CONTROL = re.compile(r"[\x00-\x08\x0e-\x1f]")
# First line by which a spreadsheet is told the separator
_DECLARED = re.compile(r'^"?sep=(.)"?$')
# [bytes] of a file that are looked at to tell what it is (chosen)
_HEAD = 65_536
# Lines by which a separator is chosen (chosen)
_LINES = 20
# Titles that an error shows (chosen)
_SHOWN = 24
# Cells that hold no number, in small letters
_EMPTY = ("", "-", "null", "none", "na", "n/a", "#n/a")
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.ASCII | re.IGNORECASE)
_UNIT = re.compile(r"^(?P<name>.*?)(?:_(?P<ending>[^\W_]+)|\s*[\[(]\s*(?P<bracket>\w+|°)\s*[\])])$")
# What spreadsheets of some languages, such as Swedish, write before a negative number
_MINUS = "\N{MINUS SIGN}"
_REMEDY = "mend the line or take another file"


@dataclass(frozen=True, kw_only=True, eq=False)
class Sheet:
    """A table of a text file."""

    path: Path
    titles: tuple[str, ...]
    """of columns, or ``1``, ``2`` and so on"""
    cells: pa.Table
    """strings in columns ``0``, ``1`` and so on"""
    lines: NDArray[np.int64]
    """(rows,)"""
    found: str
    """encoding and separator"""
    plain: bool
    """UTF-8 with commas and titles"""
    ends: bool
    """the last line is complete"""

    def __len__(self) -> int:
        return len(self.lines)

    @property
    def shown(self) -> str:
        """Titles for an error."""
        return shown(self.titles)

    def words(self, column: int) -> list[str]:
        """Cells of a column."""
        return [str(cell) for cell in pc.utf8_trim_whitespace(self.cells[str(column)]).to_pylist()]

    def commas(self, columns: Sequence[int]) -> bool:
        """Whether columns have decimal commas."""
        comma, point = (
            any(pc.any(pc.match_substring(self.cells[str(i)], sign)).as_py() for i in columns) for sign in ",."
        )
        return comma and not point

    def numbers(self, columns: Sequence[int]) -> NDArray[np.float64]:
        """Columns (rows, columns) as numbers, NaN: empty; FileError."""
        commas = self.commas(columns)
        values = np.empty((len(self), len(columns)))
        for place, column in enumerate(columns):
            cells = pc.utf8_trim_whitespace(self.cells[str(column)])
            cells = pc.if_else(pc.is_in(pc.utf8_lower(cells), pa.array(_EMPTY)), None, cells)
            cells = pc.replace_substring(cells, ",", ".") if commas else cells
            try:
                values[:, place] = pc.cast(cells, pa.float64()).fill_null(np.nan).to_numpy()
            except pa.ArrowInvalid:
                self._refuse(column, commas=commas)
        return values

    def _refuse(self, column: int, *, commas: bool) -> None:
        words = [cell.lower() for cell in self.words(column)]
        read = [_NUMBER.fullmatch(cell) is not None and (commas or "," not in cell) for cell in words]
        row = next(i for i, cell in enumerate(words) if cell not in _EMPTY and not read[i])
        place = f"line {self.lines[row]}, column {self.titles[column]}"
        raise FileError(self.path, f"{place}: {words[row][:40]!r} is no number", "mend the cell; dates as seconds")


def shown(titles: Sequence[str]) -> str:
    """Join titles in one short line."""
    short = [re.sub(r"\s+", " ", title)[:40] or "(no name)" for title in titles[:_SHOWN]]
    more = f" and {len(titles) - _SHOWN} more" if len(titles) > _SHOWN else ""
    return (", ".join(short) or "none") + more


def split_unit(title: str, units: Collection[str]) -> tuple[str, str | None]:
    """Split ``elbow_deg``, ``elbow [deg]`` or ``elbow (deg)`` into name and unit, or None."""
    found = _UNIT.match(title)
    unit = "" if found is None else (found["ending"] or found["bracket"]).replace("°", "deg")
    return (found["name"], unit) if found is not None and found["name"] and unit in units else (title, None)


def read_sheet(path: Path, *, names: Sequence[str] | None = None, whole: bool = True) -> Sheet:
    """Read a table; FileError.

    ``names``: titles of a file without them. Unless ``whole``, an incomplete last line is dropped.
    """
    try:
        data = read_bounded(path, TEXT_MOST, "cut it into several files")
    except FileNotFoundError as error:
        raise FileError(path, "no such file", "check the path") from error
    except OSError as error:
        raise FileError(path, f"not readable ({error.strerror or error})", "check its permissions") from error
    text, encoding = _decoded(data, path)
    sheet = _parsed(text, encoding, path, names)
    if whole or sheet.ends or len(sheet) < 2:
        return sheet
    return replace(sheet, cells=sheet.cells.slice(0, len(sheet) - 1), lines=sheet.lines[:-1])


def head(path: Path) -> Sheet | None:
    """Read the beginning of a table, or None."""
    try:
        with path.open("rb") as file:
            data = file.read(_HEAD)
        cut = len(data) == _HEAD
        text, encoding = _decoded(data[: len(data) // 4 * 4] if cut else data, path, cut=cut)
        if text.lstrip().startswith(("{", "[", "<")):
            return None
        sheet = _parsed(text.rpartition("\n")[0] if cut else text, encoding, path, None, strict=False)
    except (OSError, FileError):
        return None
    return sheet if len(sheet.titles) > 1 else None


def _decoded(data: bytes, path: Path, *, cut: bool = False) -> tuple[str, str]:
    if not data.strip():
        raise FileError(path, "is empty", "record it again")
    codec, name = "utf-8-sig", "UTF-8"
    zeros = [data[i:4096:2].count(0) for i in (0, 1)]
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        codec, name = "utf-16", "UTF-16"
    elif max(zeros) > 0.4 * len(data[:4096:2]):
        codec, name = "utf-16-le" if zeros[1] > zeros[0] else "utf-16-be", "UTF-16"
    try:
        text = codecs.getincrementaldecoder(codec)().decode(data, final=not cut)
    except UnicodeDecodeError as error:
        if name != "UTF-8":
            raise FileError(path, f"text in {name} that is damaged at byte {error.start}", "save it again") from error
        text, name = data.decode("latin-1"), "Latin-1"
    found = _CONTROL.search(text)
    if found:
        raise FileError(
            path,
            f"no text: read as {name}, line {text.count(chr(10), 0, found.start()) + 1} holds the control "
            f"character {ord(found[0])}",
            "save it as text, or take another file",
        )
    return text.replace(_MINUS, "-"), name


def _parsed(text: str, encoding: str, path: Path, names: Sequence[str] | None, *, strict: bool = True) -> Sheet:
    lines = text.splitlines()
    before = [i for i, line in enumerate(lines) if line.strip() and not _is_aside(line)][:1]
    if not before:
        raise FileError(path, f"text in {encoding} without a table", "record it again")
    asides = lines[: before[0]]
    declared = [found[1] for line in asides if (found := _DECLARED.match(line.strip()))]
    sample = [line for line in lines[before[0] :] if line.strip()][:_LINES]
    separator = declared[-1] if declared else _separator(sample)
    if separator == " ":
        lines = [re.sub(r"[ \t]+", " ", line.strip()) for line in lines]
    prints = _prints(lines, before[0], separator)
    first = before[0] + prints
    prints = sum(bool(line.strip(f"{separator} \t")) for line in lines[before[0] : first])
    comments = [line.lstrip().lstrip("#%/").strip() for line in asides if line.strip().startswith(_COMMENTS)]
    titles, named, skipped = _titles(lines[first], comments, separator, names)
    if strict and skipped:
        _require_titles(titles, first + 1, path)
    rows = _rows(lines, first + skipped, separator, len(titles))
    cells = _cells([lines[i] for i in rows], titles, separator, path, np.array(rows) + 1) if strict else pa.table({})
    # a text without columns has no separator; "one column" keeps an error about it true
    parted = f"columns parted by {_SEPARATORS.get(separator, repr(separator))}" if len(titles) > 1 else "one column"
    return Sheet(
        path=path,
        titles=titles,
        cells=cells,
        lines=np.array(rows, dtype=np.int64) + 1,
        ends=len(f"{text}.".splitlines()) > len(lines),
        found=f"{encoding}, {parted}{'' if named else ', without a line of titles'}"
        + f", after {prints} other line(s)" * bool(prints),
        plain=encoding == "UTF-8" and separator == "," and named and not prints,
    )


def _is_aside(line: str) -> bool:
    return line.lstrip().startswith(_COMMENTS) or _DECLARED.match(line.strip()) is not None


def _split(line: str, separator: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]
    except csv.Error:
        return [line]


def _separator(lines: list[str]) -> str:
    best, chosen = (0.0, 0), ","
    for separator in _SEPARATORS:
        parts = [re.sub(r"[ \t]+", " ", line.strip()) if separator == " " else line for line in lines]
        counts = [len(_split(line, separator)) for line in parts]
        usual = max(counts, key=lambda count: (counts.count(count) * (count > 1), count), default=0)
        score = (counts.count(usual) / len(counts), usual)
        # titles and bars have spaces around them
        if usual > 1 and score > best and not (separator == " " and best[0] > 0.5):
            best, chosen = score, separator
    return chosen


def _prints(lines: list[str], first: int, separator: str) -> int:
    counts = [sum(map(bool, _split(line, separator))) for line in lines[first : first + _LINES]]
    start = next((index for index, count in enumerate(counts) if count > 1), 0)
    return start if max(counts[start:], default=0) > 2 else 0


def _titles(
    line: str, comments: list[str], separator: str, names: Sequence[str] | None
) -> tuple[tuple[str, ...], bool, int]:
    cells = _split(line, separator)
    if not all(_NUMBER.fullmatch(cell) for cell in cells if cell):
        return tuple(cells), True, 1
    above = _split(comments[-1], separator) if comments else []
    if len(above) == len(cells):
        return tuple(above), True, 0
    given = names if names and len(names) == len(cells) else [str(i) for i in range(1, len(cells) + 1)]
    return tuple(given), False, 0


def _require_titles(titles: tuple[str, ...], line: int, path: Path) -> None:
    values = [title for title in titles if _NUMBER.fullmatch(title)]
    if len(values) > 1:
        word = next(title for title in titles if not _NUMBER.fullmatch(title))
        raise FileError(
            path,
            f"line {line} has no titles, but values such as {values[0]} and words such as {word[:40]!r}",
            "put titles first",
        )


def _rows(lines: list[str], first: int, separator: str, width: int) -> list[int]:
    nothing = f"{separator} \t"
    return [
        i
        for i in range(first, len(lines))
        if lines[i].strip(nothing)
        and not (lines[i].lstrip().startswith(_COMMENTS) and lines[i].count(separator) < width - 1)
    ]


def _cells(
    lines: list[str], titles: tuple[str, ...], separator: str, path: Path, numbers: NDArray[np.int64]
) -> pa.Table:
    width = len(titles)
    wider = bool(lines) and len(row := _split(lines[0], separator)) == width + 1 and not row[-1]
    columns = [str(i) for i in range(width + wider)]
    if not lines:
        return pa.table({name: pa.array([], pa.string()) for name in columns})
    odd: list[pacsv.InvalidRow] = []

    def skip(row: pacsv.InvalidRow) -> str:
        odd.append(row)
        return "skip"

    try:
        table = pacsv.read_csv(
            io.BytesIO("\n".join(lines).encode()),
            read_options=pacsv.ReadOptions(column_names=columns, use_threads=False, block_size=1 << 24),
            parse_options=pacsv.ParseOptions(delimiter=separator, invalid_row_handler=skip, ignore_empty_lines=False),
            convert_options=pacsv.ConvertOptions(column_types=dict.fromkeys(columns, pa.string())),
        )
    except pa.ArrowInvalid as error:
        raise FileError(path, f"no table ({first_line(error)})", _REMEDY) from error
    if odd:
        hint = " (decimal commas need another separator between columns)"
        more = separator == "," and odd[0].actual_columns > width
        raise FileError(
            path,
            f"line {numbers[odd[0].number - 1]}: {odd[0].actual_columns} columns, the header has {width}" + hint * more,
            _REMEDY,
        )
    if table.num_rows != len(lines):
        raise FileError(path, f"{len(lines)} lines hold {table.num_rows} rows: a quote does not end", _REMEDY)
    return table.select(columns[:width])
