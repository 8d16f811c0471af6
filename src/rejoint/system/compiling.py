"""Requirements of compiled loops: a compiler, and a cache."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from rejoint.system.errors import InputError, first_line

_OFF, _PLACE = "NUMBA_DISABLE_JIT", "NUMBA_CACHE_DIR"
_NO_PLACE = "no locator available"  # so Numba says it, in a RuntimeError
_KEEPER = ("numba", "core", "caching.py")  # of Numba, which reads and writes what is kept


def require_compiler() -> None:
    """Raise InputError where compiling is off: a control cycle would exceed its period."""
    if os.environ.get(_OFF, "0").strip() not in ("", "0"):
        raise InputError(f"{_OFF} is set: uncompiled, no arm can be driven or simulated in time; unset it")


def explain(error: Exception) -> str | None:
    """Explain a cache failure of Numba, or None.

    Numba neither checks nor syncs its cache: a damaged index is removed here.
    """
    if isinstance(error, RuntimeError) and _NO_PLACE in str(error):
        return (
            "compiled loops are kept beside the installed package or in the home folder, and neither can be written; "
            f"set {_PLACE} to a folder that can"
        )
    folder = _kept_in(error)
    if folder is None:
        return None
    if isinstance(error, OSError):
        told = error.strerror or first_line(error)
        return f"{folder}: compiled loops cannot be kept there ({told}); free some space, or set {_PLACE}"
    with suppress(OSError):
        for index in folder.glob("*.nbi"):
            index.unlink()
        return (
            f"{folder}: compiled loops that were kept there were damaged, as by a loss of power, and are removed; "
            "the same command compiles them again"
        )
    return f"{folder}: compiled loops that are kept there are damaged; delete the files *.nbi there"


def _kept_in(error: BaseException | None) -> Path | None:
    """Cache folder of a failure, or None."""
    while error is not None:
        trace = error.__traceback__
        while trace is not None:
            frame, trace = trace.tb_frame, trace.tb_next
            if Path(frame.f_code.co_filename).parts[-3:] != _KEEPER:
                continue  # what lies there may be a module that is imported when it is looked at
            place = getattr(frame.f_locals.get("self"), "cache_path", None)
            if place:
                return Path(place)
        error = error.__cause__ or error.__context__
    return None
