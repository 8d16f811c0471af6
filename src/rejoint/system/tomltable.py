"""TOML files: those that people write, and sealed ones of the program."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
import tomlkit

from rejoint.system.errors import FileError, first_line
from rejoint.system.files import CHANGED, TOML_MOST, digest, read_bounded, reading, write_whole

T = TypeVar("T")

Number = Annotated[float, msgspec.Meta(ge=-1e300, le=1e300)]
Positive = Annotated[float, msgspec.Meta(gt=0.0, le=1e300)]
Triple = tuple[Number, Number, Number]
Text = Annotated[str, msgspec.Meta(min_length=1)]
Texts = Annotated[list[str], msgspec.Meta(min_length=1)]


class Table(msgspec.Struct, forbid_unknown_fields=True):
    """A table of a file; other keys than its fields are refused."""


def read_toml(path: Path, kind: type[T], remedy: str) -> T:
    """Read a TOML file as ``kind``; FileError names the key, or has the ``remedy``."""
    with reading(path, "it cannot be read", remedy):
        text = read_bounded(path, TOML_MOST, remedy).decode("utf-8-sig")
    try:
        return msgspec.toml.decode(text, type=kind)
    except (RecursionError, ValueError) as error:
        raise FileError(path, first_line(error), "correct the file") from error


_SEAL = re.compile(rb"\A# digest of the text below: ([0-9a-f]{16})\n")


def write_sealed(path: Path, table: Mapping[str, Any], about: str = "") -> None:
    """Write TOML below comments ``about`` it, whole or not at all."""
    text = "".join(f"# {line}\n" for line in about.splitlines()) + tomlkit.dumps(table)
    text = f"# digest of the text below: {digest(text.encode()).decode()}\n{text}"
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def read_sealed(path: Path, build: Callable[[dict[str, Any]], T], *, name: str, version: int, again: str) -> T:
    """Read a ``name`` file of format ``version`` and ``build`` its content; FileError with the remedy ``again``."""
    remedy = f"{again} again"
    with reading(path, f"no {name}", remedy):
        text = read_bounded(path, TOML_MOST, remedy)
        sealed = _SEAL.search(text)
        if sealed and digest(text[sealed.end() :]) != sealed[1]:
            raise FileError(path, CHANGED, remedy)
        data = tomllib.loads(text.decode())
        if data["format"] != version:
            raise FileError(path, f"{name} of format {data['format']!r}, expected {version}", remedy)
        return build(data)
