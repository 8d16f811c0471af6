"""TOML files that people write: read with bounds, and whatever cannot be used is named with its line."""

from __future__ import annotations

import difflib
import re
import sys
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rejoint.system.errors import FileError
from rejoint.system.files import TOML_MOST, read_bounded


def read_toml(path: Path, known: tuple[str, ...], remedy: str) -> TomlTable:
    """Read a TOML file whose top may have the keys ``known``; FileError, with ``remedy`` where there is none."""
    try:
        text = read_bounded(path, TOML_MOST, remedy).decode("utf-8-sig")
        data = tomllib.loads(text)
    except FileNotFoundError as error:
        raise FileError(path, "there is no such file", remedy) from error
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(path, f"it cannot be read ({error})", remedy) from error
    except (RecursionError, ValueError) as error:  # of a number with thousands of digits it says no more than that
        raise FileError(path, f"it is not TOML: {error}", "correct the file") from error
    return TomlTable(path=path, text=text, data=data, header="", index=0, known=known)


@dataclass(frozen=True, kw_only=True)
class TomlTable:
    """One table of a TOML file; its readers name the key and the line of a value that cannot be used."""

    path: Path
    text: str
    data: dict[str, object]
    header: str
    """name of the table, empty for the top of the file"""
    index: int
    """which of several tables with that header, from 0"""
    known: tuple[str, ...]
    """keys that it may have"""
    numbered: bool = False
    """whether it is one of several with that header"""

    def __post_init__(self) -> None:
        for key in self.data:
            if key not in self.known:
                close = difflib.get_close_matches(key, self.known, n=1)
                hint = f"did you mean {close[0]}" if close else f"known keys: {', '.join(self.known)}"
                raise self.error(key, f"there is no such key; {hint}")

    def error(self, key: str, problem: str) -> FileError:
        """Return the FileError for a key, with the line on which it stands."""
        where = f"{self.header} {self.index + 1}: " if self.numbered else f"{self.header}: " * bool(self.header)
        line = _line_of(self.text, self.header, self.index if self.numbered else None, key)
        return FileError(self.path, f"line {line}: {where}{key}: {problem}", "correct the file")

    def string(self, key: str) -> str:
        """Return a text that must be there."""
        value = self.data.get(key)
        if not isinstance(value, str) or not value:
            raise self.error(key, f"expected a text, found {_shown(value)}")
        return value

    def boolean(self, key: str) -> bool | None:
        """Return true or false; None where it is not given."""
        value = self.data.get(key)
        if value is not None and not isinstance(value, bool):
            raise self.error(key, f"expected true or false, found {_shown(value)}")
        return value

    def texts(self, key: str) -> tuple[str, ...] | None:
        """Return a list of texts that is not empty; None where it is not given."""
        value = self.data.get(key)
        if value is None:
            return None
        if not isinstance(value, list) or not value or not all(isinstance(one, str) for one in value):
            raise self.error(key, f"expected a list of one text or more, found {_shown(value)}")
        return tuple(value)

    def number(self, key: str, *, above: float = -np.inf) -> float | None:
        """Return a finite number greater than ``above``; None where it is not given."""
        value = self.data.get(key)
        if value is None:
            return None
        if not _is_number(value) or not float(value) > above:  # type: ignore[arg-type]
            bound = f" above {above:g}" if np.isfinite(above) else ""
            raise self.error(key, f"expected a finite number{bound}, found {_shown(value)}")
        return float(value)  # type: ignore[arg-type]

    def numbers(self, key: str, size: int) -> NDArray[np.float64] | None:
        """Return ``size`` finite numbers; None where they are not given."""
        value = self.data.get(key)
        if value is None:
            return None
        if not isinstance(value, list) or len(value) != size or not all(map(_is_number, value)):
            raise self.error(key, f"expected {size} finite numbers, found {_shown(value)}")
        return np.array(value, dtype=float)

    def table(self, key: str, known: tuple[str, ...]) -> TomlTable:
        """Return a table within; an empty one where it is not given."""
        value = self.data.get(key, {})
        if not isinstance(value, dict):
            raise self.error(key, f"expected a table, found {_shown(value)}")
        header = key if not self.header else self.header
        return replace(self, data=value, header=header, known=known)

    def tables(self, key: str, known: tuple[str, ...]) -> list[TomlTable]:
        """Return all ``[[key]]`` tables, of which there must be one."""
        value = self.data.get(key)
        if not isinstance(value, list) or not value or not all(isinstance(item, dict) for item in value):
            raise self.error(key, f"expected one [[{key}]] table or more, found {_shown(value)}")
        return [
            replace(self, data=item, header=key, index=i, known=known, numbered=True) for i, item in enumerate(value)
        ]


def _line_of(text: str, header: str, index: int | None, key: str) -> int:
    """Line, from 1, on which a key of the table ``header`` stands; that of the table itself if the key is absent.

    ``index`` says which of several tables with that header; None where there is one.
    """
    seen, current, found = -1, "", 1
    is_key: Callable[[str], object] = re.compile(
        rf"""\s*["']?{re.escape(key)}["']?\s*=|.*\{{.*\b{re.escape(key)}\s*="""
    ).match
    for number, line in enumerate(text.splitlines(), start=1):
        title = re.match(r"\s*\[\[?\s*([\w.-]+)\s*\]\]?", line)
        if title:
            current = title[1]
            seen += current == header
            if (current == header and index in (None, seen)) or current == key:
                found = number
        here = current == header and index in (None, seen)
        if here and is_key(line):
            return number
    return found


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _shown(value: object) -> str:
    return "nothing" if value is None else repr(value)[:60]
