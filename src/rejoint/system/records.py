"""Frozen dataclasses; how results look at a prompt and in a notebook, and how they become tables of pandas."""

from collections.abc import Iterable
from dataclasses import dataclass, field, fields, is_dataclass, replace
from html import escape
from importlib import import_module
from operator import methodcaller
from typing import Any, TypeVar, dataclass_transform

import msgspec
import numpy as np

from rejoint.system.errors import InputError

T = TypeVar("T")

FEW = 3
"""Items that are shown as they are (chosen)"""
LONG = 80
"""Characters of a text that is shown whole (chosen)"""


def as_options(given: object, kind: type[T]) -> T:
    """Return ``given``, by default a new object of its ``kind``; InputError for anything else."""
    found = kind() if given is None else given
    if isinstance(found, kind):
        return found
    raise InputError(f"expected an object of the class {kind.__name__}, got {given!r:.80}")


class Readable:
    """Base of results: what is large in them is named, not written out."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name}={text}' for name, text in self._shown())})"

    def _repr_html_(self) -> str:
        rows = (f"<tr><th>{name}</th><td>{escape(text)}</td></tr>" for name, text in self._shown())
        return f"<table><caption>{type(self).__name__}</caption>{''.join(rows)}</table>"

    def to_pandas(self) -> Any:  # noqa: ANN401 - pandas is not part of the installation
        """Return a `pandas.DataFrame`: a row for each part of the result, such as a target; SI units."""
        values = [getattr(self, one.name) for one in fields(self)]  # type: ignore[arg-type]
        inner = next((value for value in values if isinstance(value, Readable)), None)
        if inner is not None:
            return inner.to_pandas()
        parts = (value for value in values if isinstance(value, tuple) and value and is_dataclass(value[0]))
        rows = next(parts, (self,))
        return import_module("pandas").json_normalize(msgspec.to_builtins(rows, enc_hook=methodcaller("tolist")))

    def _shown(self) -> list[tuple[str, str]]:
        return [(one.name, _short(getattr(self, one.name))) for one in fields(self)]  # type: ignore[arg-type]


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(field,))
def value_type(cls: type[T]) -> type[T]:
    """Make a frozen dataclass of named fields, compared by value.

    What users construct is a plain dataclass: the API pages show its signature.
    """
    return dataclass(frozen=True, kw_only=True, repr=not issubclass(cls, Readable))(cls)


@dataclass_transform(frozen_default=True, kw_only_default=True, eq_default=False, field_specifiers=(field,))
def entity(cls: type[T]) -> type[T]:
    """Make the same, compared by identity: it holds arrays."""
    return dataclass(frozen=True, kw_only=True, eq=False, repr=not issubclass(cls, Readable))(cls)


def taken(whole: T, names: Iterable[str], where: Any) -> T:  # noqa: ANN401 - whatever arrays take
    """Return ``whole`` with the rows ``where`` of its arrays ``names``."""
    return replace(whole, **{name: getattr(whole, name)[where] for name in names})  # type: ignore[type-var]


def _short(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"array{value.shape}"
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if isinstance(value, dict | list | tuple) and (len(value) > FEW or any(map(is_dataclass, value))):
        return f"{len(value)} x {type(next(iter(value))).__name__}"
    text = f"{type(value).__name__}(...)" if is_dataclass(value) else repr(value)
    return text if len(text) <= LONG else f"{text[:LONG]}..."
