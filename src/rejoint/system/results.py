"""How results look at a prompt and in a notebook, and how they become tables of pandas."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from html import escape
from importlib import import_module
from operator import methodcaller
from typing import Any

import msgspec
import numpy as np

FEW = 3
"""Items that are shown as they are (chosen)"""
LONG = 80
"""Characters of a text that is shown whole (chosen)"""


class Readable:
    """Base of results, dataclasses with ``repr=False``: what is large in them is named, not written out."""

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


def _short(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"array{value.shape}"
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if isinstance(value, dict | list | tuple) and (len(value) > FEW or any(map(is_dataclass, value))):
        return f"{len(value)} x {type(next(iter(value))).__name__}"
    text = f"{type(value).__name__}(...)" if is_dataclass(value) else repr(value)
    return text if len(text) <= LONG else f"{text[:LONG]}..."
