"""What the compiled loops need of the system: a compiler that is not switched off, and a place to keep its work."""

from __future__ import annotations

import os

from rejoint.system.errors import InputError

_OFF, _PLACE = "NUMBA_DISABLE_JIT", "NUMBA_CACHE_DIR"
_NO_PLACE = "no locator available"  # so Numba says it, in a RuntimeError


def require_compiler() -> None:
    """Raise InputError where compiling is switched off: uncompiled, a control cycle takes longer than its period."""
    if os.environ.get(_OFF, "0").strip() not in ("", "0"):
        raise InputError(f"{_OFF} is set: uncompiled, no arm can be driven or simulated in time; unset it")


def explain(error: Exception) -> str | None:
    """Say in a line what to do where compiled loops can be kept nowhere; None for any other error."""
    if not isinstance(error, RuntimeError) or _NO_PLACE not in str(error):
        return None
    return (
        "compiled loops are kept beside the installed package or in the home folder, and neither can be written; "
        f"set {_PLACE} to a folder that can"
    )
