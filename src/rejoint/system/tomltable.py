"""TOML files that people write, read with bounds; errors name the line."""

from __future__ import annotations

import difflib
import re
import sys
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import tomlkit
from numpy.typing import NDArray

from rejoint.system.errors import FileError, InputError, first_line
from rejoint.system.files import CHANGED, TOML_MOST, digest, read_bounded, write_whole


def read_toml(path: Path, known: tuple[str, ...], remedy: str) -> TomlTable:
    """Read a TOML file with top keys ``known``; FileError with ``remedy``."""
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
    """A table of a TOML file; errors name key and line."""

    path: Path
    text: str
    data: dict[str, object]
    header: str
    """name, or empty for the top"""
    index: int
    """among tables of that header, from 0"""
    known: tuple[str, ...]
    """allowed keys"""
    numbered: bool = False
    """one of several"""

    def __post_init__(self) -> None:
        for key in self.data:
            if key not in self.known:
                close = difflib.get_close_matches(key, self.known, n=1)
                hint = f"did you mean {close[0]}" if close else f"known keys: {', '.join(self.known)}"
                raise self.error(key, f"there is no such key; {hint}")

    def error(self, key: str, problem: str) -> FileError:
        """FileError for a key, with its line."""
        where = f"{self.header} {self.index + 1}: " if self.numbered else f"{self.header}: " * bool(self.header)
        line = _line_of(self.text, self.header, self.index if self.numbered else None, key)
        return FileError(self.path, f"line {line}: {where}{key}: {problem}", "correct the file")

    def value(self, key: str, expected: str, valid: Callable[[Any], bool], *, needed: bool = False) -> Any:  # noqa: ANN401
        """Value that is ``valid``; None if missing and not ``needed``."""
        found = self.data.get(key)
        if (needed or found is not None) and not valid(found):
            raise self.error(key, f"expected {expected}, found {_shown(found)}")
        return found

    def string(self, key: str) -> str:
        """Return a required text."""
        return str(self.value(key, "a text", lambda found: isinstance(found, str) and found != "", needed=True))

    def boolean(self, key: str) -> bool | None:
        """Return a boolean or None."""
        found: bool | None = self.value(key, "true or false", lambda found: isinstance(found, bool))
        return found

    def texts(self, key: str) -> tuple[str, ...] | None:
        """Return a non-empty list of texts, or None."""
        found = self.value(key, "a list of one text or more", lambda found: _is_list(found, str))
        return None if found is None else tuple(found)

    def number(self, key: str, *, above: float = -np.inf) -> float | None:
        """Return a finite number greater than ``above``, or None."""
        bound = f" above {above:g}" if np.isfinite(above) else ""
        found = self.value(key, f"a finite number{bound}", lambda found: _is_number(found) and float(found) > above)
        return None if found is None else float(found)

    def numbers(self, key: str, size: int) -> NDArray[np.float64] | None:
        """Return ``size`` finite numbers, or None."""
        found = self.value(
            key,
            f"{size} finite numbers",
            lambda found: isinstance(found, list) and len(found) == size and all(map(_is_number, found)),
        )
        return None if found is None else np.array(found, dtype=float)

    def table(self, key: str, known: tuple[str, ...]) -> TomlTable:
        """Return a table within, perhaps empty."""
        found = self.value(key, "a table", lambda found: isinstance(found, dict))
        return replace(self, data=found or {}, header=self.header or key, known=known)

    def tables(self, key: str, known: tuple[str, ...]) -> list[TomlTable]:
        """Return all ``[[key]]`` tables, at least one."""
        found = self.value(key, f"one [[{key}]] table or more", lambda found: _is_list(found, dict), needed=True)
        return [
            replace(self, data=item, header=key, index=i, known=known, numbered=True) for i, item in enumerate(found)
        ]


def _line_of(text: str, header: str, index: int | None, key: str) -> int:
    """Line, from 1, of a key of table ``index`` of ``header``, else of the table."""
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


def _is_list(value: object, kind: type) -> bool:
    return isinstance(value, list) and value != [] and all(isinstance(one, kind) for one in value)


def _shown(value: object) -> str:
    return "nothing" if value is None else repr(value)[:60]


T = TypeVar("T")

_SEAL = re.compile(rb"\A# digest of the text below: ([0-9a-f]{16})\n")


def write_sealed(path: Path, document: tomlkit.TOMLDocument) -> None:
    """Write TOML, whole or not at all."""
    text = tomlkit.dumps(document)
    text = f"# digest of the text below: {digest(text.encode()).decode()}\n{text}"
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def read_sealed(path: Path, build: Callable[[dict[str, Any]], T], *, name: str, version: int, again: str) -> T:
    """Read a ``name`` file of format ``version`` and ``build`` its content; FileError with the remedy ``again``.

    A file without a digest is accepted.
    """
    try:
        text = read_bounded(path, TOML_MOST, f"{again} again")
        sealed = _SEAL.search(text)
        if sealed and digest(text[sealed.end() :]) != sealed[1]:
            raise FileError(path, CHANGED, f"{again} again")
        data = tomllib.loads(text.decode())
        if data["format"] != version:
            raise FileError(path, f"{name} of format {data['format']!r}, expected {version}", f"{again} again")
        return build(data)
    except FileNotFoundError as error:
        raise FileError(path, "no such file", f"{again} first") from error
    except (OSError, UnicodeDecodeError, RecursionError, tomllib.TOMLDecodeError) as error:
        raise FileError(path, f"not a readable TOML file ({first_line(error)})", f"{again} again") from error
    except (KeyError, TypeError, ValueError, AttributeError, InputError, msgspec.MsgspecError) as error:
        raise FileError(path, f"no {name} ({type(error).__name__}: {first_line(error)})", f"{again} again") from error
