"""Experiments of the paper and rival controllers; not imported by the product."""

from collections.abc import Mapping, Sequence
from typing import TypeVar

from rejoint.system.errors import InputError

T = TypeVar("T")


def look_up(known: Mapping[str, T], names: Sequence[str]) -> dict[str, T]:
    """Return what the ``names`` stand for, by default all; InputError for unknown ones."""
    for name in names:
        if name not in known:
            raise InputError(f"{name!r} is not known here; expected {', '.join(known)}")
    return {name: known[name] for name in names or known}
