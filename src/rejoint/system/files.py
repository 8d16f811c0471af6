"""Files: written whole or not at all, read with limits on size; TOML, sealed if the program writes it."""

import hashlib
import os
import re
import shutil
import tempfile
import tomllib
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from operator import methodcaller
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

import msgspec
import numpy as np
import tomlkit
from numpy.typing import NDArray
from rich.filesize import decimal

from rejoint.system.errors import FileError, InputError, UnsavedError, first_line

T = TypeVar("T")

MEGABYTE = 10**6

CHANGED = "damaged (it is not what was written: its digest is another)"

FILE_MOST = 64 * MEGABYTE
"""[bytes] of a file of text, unless it holds a table (chosen)"""

SPACE = 50 * MEGABYTE
"""[bytes] free before an arm moves (chosen: a run takes 5 MB)"""

UNFINISHED = ".partial"
"""Suffix of unfinished files"""

UNWRITABLE = "free some space, allow writing there, or choose another folder"
MALFORMED = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    msgspec.MsgspecError,
    zipfile.BadZipFile,
)
"""What decoders raise for data of another kind"""
_DIGEST = re.compile(rb',\n  "digest": "([0-9a-f]{16})"\n}\Z')


@contextmanager
def writing(path: Path, problem: str = "cannot be written") -> Iterator[None]:
    """Turn what the system raises into a FileError with this ``problem``."""
    try:
        yield
    except OSError as error:
        raise FileError(path, f"{problem} ({error.strerror or first_line(error)})", UNWRITABLE) from error


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` fill a file, and move it whole to ``path``; FileError."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=UNFINISHED)
        temporary = Path(name)
        try:
            try:
                write(temporary)
                temporary.chmod(0o644)
                os.fsync(handle)
            finally:
                os.close(handle)  # Windows moves no open file
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def as_path(what: str, given: object) -> Path:
    """Return ``given`` as a path; InputError for what is none."""
    if isinstance(given, str | os.PathLike):
        return Path(given)
    raise InputError(f"expected {what}, got {given!r:.80}")


def write_bytes(path: Path, data: bytes) -> None:
    """Write bytes as `write_whole`."""
    write_whole(path, lambda temporary: temporary.write_bytes(data))


def write_text(path: Path, text: str) -> None:
    """Write a text as `write_whole`; what is no text of a path, by its number."""
    write_bytes(path, text.encode(errors="backslashreplace"))


def read_bounded(path: Path, remedy: str, most: int = FILE_MOST) -> bytes:
    """Read a file of at most ``most`` bytes; FileError, OSError."""
    require_file(path, most, remedy)
    return path.read_bytes()


@contextmanager
def reading(path: Path, problem: str, remedy: str) -> Iterator[None]:
    """Turn what decoders raise into a FileError with this ``problem``."""
    try:
        yield
    except FileNotFoundError as error:
        raise FileError(path, "no such file", remedy) from error
    except MALFORMED as error:
        raise FileError(path, f"{problem} ({type(error).__name__}: {first_line(error)})", remedy) from error


def require_file(path: Path, most: int, remedy: str) -> None:
    """Raise FileError unless ``path`` is such a file; FileNotFoundError."""
    size = path.stat().st_size
    if not path.is_file():
        raise FileError(path, "cannot be read: it is a folder, a pipe or a device", "give a file")
    if size > most:
        raise FileError(path, f"{decimal(size)} large, expected at most {decimal(most)}", remedy)


def begins_with(path: Path, first: bytes) -> bool:
    """Whether ``path`` is a file with these first bytes."""
    try:
        if not path.is_file():  # a pipe is not opened: it might never answer
            return False
        with path.open("rb") as file:
            return file.read(len(first)) == first
    except OSError:
        return False


def require_space(folder: Path) -> None:
    """Raise FileError unless `SPACE` is free at ``folder``."""
    with writing(folder):
        free = shutil.disk_usage(folder).free
    if free < SPACE:
        raise FileError(folder, f"{decimal(free)} free on that disk, {decimal(SPACE)} needed", UNWRITABLE)


def write_json(path: Path, value: object) -> None:
    """Write readable JSON; objects get a digest."""
    data = msgspec.json.format(msgspec.json.encode(value, enc_hook=methodcaller("tolist")), indent=2)
    if data.endswith(b"\n}"):
        data = data[:-2] + f',\n  "digest": "{digest(data)}"\n}}'.encode()
    write_bytes(path, data)


def array_of(kind: Any, rows: object) -> NDArray[Any]:  # noqa: ANN401 - such as NDArray[np.int64]
    """Array of a ``kind`` from lists, as msgspec asks for one."""
    return np.array(rows, dtype=get_args(get_args(kind)[1])[0])


def read_json(path: Path, kind: type[T]) -> T:
    """Read JSON of `write_json` as ``kind``; FileError."""
    remedy = "delete what is left of it, and run its stage"
    with reading(path, "damaged", remedy):
        data = read_bounded(path, remedy)
        found = _DIGEST.search(data)
        if found:
            data = data[: found.start()] + b"\n}"
            if digest(data).encode() != found[1]:
                raise FileError(path, CHANGED, remedy)
        return msgspec.json.decode(data, type=kind, dec_hook=array_of)


def read_json_if(path: Path, kind: type[T]) -> T | None:
    """Read JSON as `read_json`; None where there is no file."""
    return read_json(path, kind) if path.exists() else None


@contextmanager
def saving(result: object) -> Iterator[None]:
    """Raise UnsavedError with ``result`` in place of FileError."""
    try:
        yield
    except FileError as error:
        raise UnsavedError(error, result) from error


def set_aside(path: Path) -> Path:
    """Rename what exists at ``path`` by its time; returns ``path``."""
    if path.exists():
        made = datetime.fromtimestamp(path.stat().st_mtime)
        path.replace(unused(path.with_stem(f"{path.stem}-{made:%Y%m%d-%H%M%S}")))
    return path


def unused(path: Path) -> Path:
    """Return ``path``, numbered if it exists."""
    number, free = 2, path
    while os.path.lexists(free):
        free = path.with_stem(f"{path.stem}-{number}")
        number += 1
    return free


def digest(data: bytes) -> str:
    """Fingerprint against changes."""
    return hashlib.sha256(data).hexdigest()[:16]


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
        text = read_bounded(path, remedy).decode("utf-8-sig")
    try:
        return msgspec.toml.decode(text, type=kind)
    except (RecursionError, ValueError) as error:
        raise FileError(path, first_line(error), "correct the file") from error


def read_shipped(module: str, name: str, kind: type[T]) -> T:
    """Read the TOML file ``name`` that comes with the program, beside the file of a ``module``."""
    return read_toml(Path(module).with_name(name), kind, "install rejoint again")


_SEAL = re.compile(rb"\A# digest of the text below: ([0-9a-f]{16})\n")


def toml_of(table: Mapping[str, Any]) -> str:
    """TOML of a ``table``, without what is None; arrays become lists."""

    def known(value: Any) -> Any:  # noqa: ANN401 - of any TOML
        if isinstance(value, dict):
            return {key: known(one) for key, one in value.items() if one is not None}
        return [known(one) for one in value] if isinstance(value, list) else value

    return tomlkit.dumps(known(msgspec.to_builtins(table, enc_hook=methodcaller("tolist"))))


def write_sealed(path: Path, toml: str, about: str) -> None:
    """Write TOML below comments ``about`` it, whole or not at all."""
    text = "".join(f"# {line}\n" for line in about.splitlines()) + toml
    write_text(path, f"# digest of the text below: {digest(text.encode())}\n{text}")


def read_sealed(path: Path, build: Callable[[dict[str, Any]], T], *, name: str, version: int, again: str) -> T:
    """Read a ``name`` file of format ``version`` and ``build`` its content; FileError with the remedy ``again``."""
    remedy = f"{again} again"
    with reading(path, f"no {name}", remedy):
        text = read_bounded(path, remedy)
        sealed = _SEAL.search(text)
        if sealed and digest(text[sealed.end() :]).encode() != sealed[1]:
            raise FileError(path, CHANGED, remedy)
        data = tomllib.loads(text.decode())
        if data.get("format") != version:
            raise FileError(path, f"{name} of format {data.get('format')!r}, expected {version}", remedy)
        return build(data)
