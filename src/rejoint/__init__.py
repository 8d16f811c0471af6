"""Give a worn robot arm its accuracy back, in software.

The stages of a repair as functions (`repair` is all of them), the objects that they take and return, and the errors
that they raise. Each name is loaded at its first use. Positions are in radians, lengths in metres, times in seconds.
"""

import ast
import pathlib
from importlib import import_module


def _read_homes() -> dict[str, str]:
    """Modules of the public names, by the stub beside this file."""
    stub = ast.parse(pathlib.Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    return {one.name: str(node.module) for node in stub.body if isinstance(node, ast.ImportFrom) for one in node.names}


_HOMES = _read_homes()
__all__ = list(_HOMES)


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value  # the next time it is found at once
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
