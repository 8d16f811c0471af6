"""What the user is told of an error that ended a command, a job or a step."""

import tempfile
import traceback
from collections.abc import Iterable
from typing import NamedTuple

from rejoint.system.errors import RejointError, first_line
from rejoint.system.extras import explain
from rejoint.system.stopping import Interrupted

BUG, UNUSABLE = 1, 2
"""Exit codes: what should never happen, and unusable input"""


class Failure(NamedTuple):
    """An error for its user."""

    text: str
    """in one line, with what to do"""
    kind: str
    code: int
    """exit code"""


def failure_of(error: BaseException) -> Failure:
    """Describe an ``error``; the traceback of a bug is written to a file, which is named."""
    if isinstance(error, RejointError | Interrupted):
        return Failure(str(error), type(error).__name__, error.exit_code)
    if isinstance(error, MemoryError):
        text = "not enough memory for this; close other programs, allow more, or ask for less"
        return Failure(text, "MemoryError", UNUSABLE)
    if line := explain(error):
        return Failure(line, "MissingExtraError" if isinstance(error, ImportError) else "InputError", UNUSABLE)
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        text = f"{where}{error.strerror or error}; check the path, its permissions and the space left"
        return Failure(text, "OSError", UNUSABLE)
    from rejoint.robots.registry import driver_of  # late: this module may be what is broken

    text = f"a bug in {driver_of(error) or 'rejoint itself'}: {type(error).__name__}: {first_line(error)}"
    return Failure(f"{text}; where it is: {kept(traceback.format_exception(error))}", "InternalError", BUG)


def kept(trace: Iterable[str]) -> str:
    """Write the traceback of a bug to a file, and return its path."""
    with tempfile.NamedTemporaryFile(
        "w", prefix="rejoint-traceback-", suffix=".txt", encoding="utf-8", delete=False
    ) as file:
        file.writelines(trace)
    return file.name
