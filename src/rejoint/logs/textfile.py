"""Tables in text files as programs really write them: encodings, separators, comments, decimal commas.

What is found is kept in words, for errors and notes: nobody has to believe that a file was read as it was meant.
"""

from __future__ import annotations

import codecs
import csv
import re
from dataclasses import dataclass
from pathlib import Path

from rejoint.system.errors import FileError
from rejoint.system.files import MEGABYTE, read_bounded

TEXT_MOST = 200 * MEGABYTE
"""Largest text file that is read (chosen: two hours of six joints at 100 Hz; takes ten times the memory)"""

_BOMS = (
    (codecs.BOM_UTF8, "utf-8-sig", "UTF-8"), (codecs.BOM_UTF32_LE, "utf-32", "UTF-32"),
    (codecs.BOM_UTF32_BE, "utf-32", "UTF-32"), (codecs.BOM_UTF16_LE, "utf-16", "UTF-16"),
    (codecs.BOM_UTF16_BE, "utf-16", "UTF-16"),
)  # fmt: skip
_SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "spaces"}
_COMMENTS = ("#", "%", "//")
_CONTROL = re.compile(r"[\x00-\x08\x0e-\x1f]")
_DECLARED = re.compile(r'^"?sep=(.)"?$')
"""First line by which a spreadsheet is told the separator"""
_HEAD = 65_536
"""[bytes] of a file that are looked at to tell what it is (chosen)"""
_LINES = 20
"""Lines by which a separator is chosen (chosen)"""
_SHOWN = 24
"""Titles that an error shows (chosen)"""
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.ASCII | re.IGNORECASE)
_DATE = re.compile(r"^\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}|^\d{1,2}:\d{2}")
_MINUS = "\N{MINUS SIGN}"
"""What spreadsheets of some languages, such as Swedish, write before a negative number"""
_REMEDY = "mend the line or take another file"


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """The cells of a table in a text file."""

    path: Path
    titles: tuple[str, ...]
    """of the columns; ``1``, ``2`` and so on where the file names none"""
    rows: list[list[str]]
    numbers: list[int]
    """line of each row"""
    found: str
    """encoding, separator and decimal sign in words"""
    plain: bool
    """UTF-8 with commas, decimal points and a header: nothing to speak of"""
    ends: bool
    """whether the last line is a whole one"""

    @property
    def shown(self) -> str:
        """The titles for an error."""
        return shown(self.titles)


def shown(titles: tuple[str, ...]) -> str:
    """Join titles for an error: on one line, and not all of a thousand."""
    short = [re.sub(r"\s+", " ", title)[:40] or "(no name)" for title in titles[:_SHOWN]]
    more = f" and {len(titles) - _SHOWN} more" if len(titles) > _SHOWN else ""
    return (", ".join(short) or "none") + more


def read_sheet(path: Path) -> Sheet:
    """Read a table; FileError where the file is no text, or its rows do not fit to its header."""
    try:
        data = read_bounded(path, TEXT_MOST, "cut it into several files")
    except FileNotFoundError as error:
        raise FileError(path, "no such file", "check the path") from error
    except OSError as error:
        raise FileError(path, f"not readable ({error.strerror or error})", "check its permissions") from error
    text, encoding = _decoded(data, path)
    return _parsed(text, encoding, path)


def head(path: Path) -> Sheet | None:
    """Read the beginning of a table; None where it is none: no text, or one without columns."""
    try:
        with path.open("rb") as file:
            data = file.read(_HEAD)
        whole = len(data) < _HEAD
        text, encoding = _decoded(data if whole else data[: len(data) // 4 * 4], path, cut=not whole)
        lines = text.splitlines(keepends=True)
        sheet = _parsed("".join(lines if whole else lines[:-1]), encoding, path, strict=False)
    except (OSError, FileError):
        return None
    return sheet if len(sheet.titles) > 1 and not text.lstrip().startswith(("{", "[", "<")) else None


def _decoded(data: bytes, path: Path, *, cut: bool = False) -> tuple[str, str]:
    """Return the text of a file and the name of its encoding; ``cut`` for the beginning of a longer one."""
    if not data.strip():
        raise FileError(path, "is empty", "record it again")
    for mark, codec, name in _BOMS:
        if data.startswith(mark):
            return _text(data, codec, name, path, cut=cut), name
    zeros = [data[i:4096:2].count(0) for i in (0, 1)]
    if max(zeros) > 0.4 * len(data[:4096:2]):
        codec = "utf-16-le" if zeros[1] > zeros[0] else "utf-16-be"
        return _text(data, codec, "UTF-16", path, cut=cut), "UTF-16"
    try:
        text, name = codecs.getincrementaldecoder("utf-8")().decode(data, final=not cut), "UTF-8"
    except UnicodeDecodeError:
        text, name = data.decode("latin-1"), "Latin-1"
    return _checked(text, name, path), name


def _text(data: bytes, codec: str, name: str, path: Path, *, cut: bool) -> str:
    try:
        text = codecs.getincrementaldecoder(codec)().decode(data, final=not cut)
    except UnicodeDecodeError as error:
        raise FileError(path, f"text in {name} that is damaged at byte {error.start}", "save it again") from error
    return _checked(text.removeprefix("\ufeff"), name, path)


def _checked(text: str, name: str, path: Path) -> str:
    found = _CONTROL.search(text)
    if found:
        line = text.count("\n", 0, found.start()) + 1
        raise FileError(
            path, f"no text: read as {name}, line {line} holds the control character {ord(found[0])}",
            "save it as text, or take another file",
        )  # fmt: skip
    return text


def _parsed(text: str, encoding: str, path: Path, *, strict: bool = True) -> Sheet:
    lines = text.splitlines()
    first, comment, separator = _asides(lines)
    if first == len(lines):
        raise FileError(path, f"text in {encoding} without a table", "record it again")
    separator = separator or _separator([line for line in lines[first : first + _LINES] if line.strip()])
    rows, numbers = _rows(lines, first, separator, path)
    prints = _prints(rows)
    del rows[:prints], numbers[:prints]
    titles, named = tuple(title.strip() for title in rows[0]), True
    if all(_NUMBER.fullmatch(title) for title in titles if title):
        before: list[str] = [] if comment is None else next(_reader([comment], separator), [])
        named = len(before) == len(titles)
        titles = tuple(title.strip() for title in before) if named else tuple(str(i + 1) for i in range(len(titles)))
    else:
        del rows[0], numbers[0]
        if strict:
            _require_titles(titles, first + 1, path)
    if strict:
        rows = _same_width(rows, numbers, titles, separator, path)
    # a text without columns has no separator; "none" keeps an error about it true
    parted = f"columns parted by {_SEPARATORS.get(separator, repr(separator))}" if len(titles) > 1 else "one column"
    return Sheet(
        path=path, titles=titles, rows=rows, numbers=numbers,
        found=f"{encoding}, {parted}{'' if named else ', without a line of titles'}"
        + (f", after {prints} other line(s)" if prints else ""),
        plain=encoding == "UTF-8" and separator == "," and named and not prints, ends=text.endswith(("\n", "\r")),
    )  # fmt: skip


def _asides(lines: list[str]) -> tuple[int, str | None, str | None]:
    """Count the lines before a table that are empty, comments or ``sep=``; the last comment and that separator."""
    first, comment, separator = 0, None, None
    while first < len(lines) and (not lines[first].strip() or _is_aside(lines[first])):
        declared = _DECLARED.match(lines[first].strip())
        if declared:
            separator = declared[1]
        elif lines[first].strip():
            comment = lines[first].lstrip().lstrip("#%/").strip()
        first += 1
    return first, comment, separator


def _require_titles(titles: tuple[str, ...], line: int, path: Path) -> None:
    """Raise FileError where what should be titles, at least one of them a word, holds values."""
    values = [title for title in titles if _NUMBER.fullmatch(title)]
    if len(values) > 1:
        word = next(title for title in titles if not _NUMBER.fullmatch(title))
        raise FileError(
            path, f"line {line} has no titles, but values such as {values[0]} and words such as {word[:40]!r}",
            "put titles first",
        )  # fmt: skip


def _prints(rows: list[list[str]]) -> int:
    """Count the rows before a table that are no part of it: what a program prints when it starts, or a heading."""
    cells = [sum(bool(cell.strip()) for cell in row) for row in rows[:_LINES]]
    first = next((index for index, count in enumerate(cells) if count > 1), 0)
    return first if cells[first:] and max(cells[first:]) > 2 else 0


def _is_aside(line: str) -> bool:
    return line.lstrip().startswith(_COMMENTS) or _DECLARED.match(line.strip()) is not None


def _separator(lines: list[str]) -> str:
    """Choose what parts the columns: what finds the same number of them in most lines, and more than one."""
    best, chosen = (0.0, 0), ","
    for separator in _SEPARATORS:
        try:
            counts = [len(row) for row in _reader(lines, separator)]
        except csv.Error:
            continue
        usual = max(counts, key=lambda count: (counts.count(count) * (count > 1), count), default=0)
        if usual < 2:
            continue
        score = (counts.count(usual) / len(counts), usual)
        if score > best and not (separator == " " and best[0] > 0.5):  # titles and bars have spaces around them
            best, chosen = score, separator
    return chosen


def _reader(lines: list[str], separator: str) -> csv._reader:  # type: ignore[name-defined] # typeshed calls it so
    if separator == " ":
        lines, separator = [re.sub(r"[ \t]+", " ", line.strip()) for line in lines], " "
    return csv.reader((line + "\n" for line in lines), delimiter=separator, strict=True, skipinitialspace=True)


def _rows(lines: list[str], first: int, separator: str, path: Path) -> tuple[list[list[str]], list[int]]:
    """Split lines into cells, blank lines and comments left out."""
    csv.field_size_limit(1 << 20)  # (chosen) a cell of a megabyte is no number, but an error of ours
    reader = _reader(lines[first:], separator)
    rows: list[list[str]] = []
    numbers: list[int] = []
    try:
        for row in reader:
            if not any(cell.strip() for cell in row):
                continue
            aside = row[0].lstrip().startswith(_COMMENTS)  # a cell such as #N/A in a whole row is none
            if not (aside and (not rows or len(row) != len(rows[0]))):
                rows.append(row)
                numbers.append(first + reader.line_num)
    except csv.Error as error:
        raise FileError(path, f"line {first + reader.line_num}: {error}", _REMEDY) from error
    return rows, numbers


def _same_width(
    rows: list[list[str]], numbers: list[int], titles: tuple[str, ...], separator: str, path: Path
) -> list[list[str]]:
    """Return the rows, which must have as many cells as there are titles; a separator at the end of a row is none."""
    width = len(titles)
    for index, row in enumerate(rows):
        if len(row) == width + 1 and not row[-1].strip():
            rows[index] = row[:-1]
        elif len(row) != width:
            hint = ""
            if separator == "," and len(row) > width:
                hint = " (decimal commas need another separator between columns)"
            raise FileError(path, f"line {numbers[index]}: {len(row)} columns, the header has {width}{hint}", _REMEDY)
    return rows


def has_decimal_commas(sheet: Sheet, needed: list[int]) -> bool:
    """Tell whether the numbers in some columns have decimal commas; FileError where some have points."""
    first: dict[str, tuple[int, str]] = {}
    for row, line in zip(sheet.rows, sheet.numbers, strict=True):
        for column in needed:
            for sign in ",.":
                if sign in row[column]:
                    first.setdefault(sign, (line, row[column]))
        if len(first) == 2:
            break
    if len(first) == 2:
        (comma_line, comma), (point_line, point) = first[","], first["."]
        raise FileError(
            sheet.path, f"{comma.strip()[:40]!r} in line {comma_line} has a comma, {point.strip()[:40]!r} in line "
            f"{point_line} a point: which is the decimal sign is not clear", "write all numbers with decimal points",
        )  # fmt: skip
    return "," in first


def number(text: str, place: tuple[Sheet, int, str], *, commas: bool) -> float:
    """Read a cell as a number, NaN if it is empty; FileError names line and column."""
    text = text.strip().replace(_MINUS, "-")
    if not text:
        return float("nan")
    if _NUMBER.fullmatch(text) is None:
        sheet, line, title = place
        if _DATE.search(text):
            raise FileError(
                sheet.path, f"line {line}, column {title}: {text[:40]!r} is a date or time of day, expected a number",
                "write seconds",
            )  # fmt: skip
        raise FileError(sheet.path, f"line {line}, column {title}: {text[:40]!r} is no number", "mend the cell")
    return float(text.replace(",", ".") if commas else text)
