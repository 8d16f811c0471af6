"""What speaks against a log without proving it wrong: the import stops, unless its user goes on by force."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rejoint.logs.runlog import RunLog
from rejoint.system.errors import FileError

FORCED = "forced"
"""Key in the ``extra`` of a run log under which the reasons are kept for which its import would have stopped"""

_BETWEEN = " | "


@dataclass(frozen=True, kw_only=True)
class Doubts:
    """Where the checks of one log bring what speaks against it."""

    force: bool = False
    """go on all the same"""
    reasons: list[str] = field(default_factory=list)
    """what would have stopped the import"""

    def stop(self, path: Path, problem: str, remedy: str) -> None:
        """Raise FileError, or by force keep the problem as a reason."""
        if not self.force:
            raise FileError(path, problem, f"{remedy}; or go on with --force, which keeps this reason in the log")
        if problem not in self.reasons:
            self.reasons.append(problem)

    @property
    def kept(self) -> dict[str, str]:
        """Entry for the ``extra`` of the run log; empty where nothing was forced."""
        return {FORCED: _BETWEEN.join(self.reasons)} if self.reasons else {}


def forced_reasons(extra: dict[str, str]) -> tuple[str, ...]:
    """Return the reasons that `Doubts.kept` put into the ``extra`` of a run log."""
    return tuple(extra[FORCED].split(_BETWEEN)) if extra.get(FORCED) else ()


def forced_remarks(logs: Sequence[RunLog]) -> list[str]:
    """Say in sentences which logs were imported by force, and what speaks against them."""
    found: dict[str, list[str]] = {}
    for log in logs:
        for reason in forced_reasons(log.extra):
            found.setdefault(reason, []).append(log.label)
    return [f"{_named(labels)} imported by force, although {reason}" for reason, labels in found.items()]


def _named(labels: list[str]) -> str:
    return f"{labels[0]} was" if len(labels) == 1 else f"{labels[0]} and {len(labels) - 1} more were"
