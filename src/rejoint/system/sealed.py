"""TOML files with a digest of their text in the first line, so that a changed or damaged one is noticed."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import tomlkit

from rejoint.system.errors import FileError, InputError, first_line
from rejoint.system.files import CHANGED, TOML_MOST, digest, read_bounded, write_whole

T = TypeVar("T")

_SEAL = re.compile(rb"\A# digest of the text below: ([0-9a-f]{16})\n")


def write_sealed(path: Path, document: tomlkit.TOMLDocument) -> None:
    """Write a document as TOML, whole or not at all."""
    text = tomlkit.dumps(document)
    text = f"# digest of the text below: {digest(text.encode()).decode()}\n{text}"
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def read_sealed(path: Path, build: Callable[[dict[str, Any]], T], *, name: str, version: int, again: str) -> T:
    """Read a file of the given format ``version`` and ``build`` what it holds, of which ``name`` says what it is.

    A file without a digest is read too: an owner may edit one and take the line away. FileError if it is missing,
    damaged or something else, with ``again`` as what to do; a ContractError of ``build`` passes through.
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
