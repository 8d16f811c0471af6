"""Logs of states alone: nobody recorded what the joints were sent."""

from __future__ import annotations

from collections.abc import Sequence

from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError


def states_alone(logs: Sequence[RunLog], what: str) -> bool:
    """Tell whether no log holds commands; InputError of ``what``, such as "replay", if only some do."""
    bare = [log.label for log in logs if not log.commanded]
    if bare and len(bare) < len(logs):
        raise InputError(
            f"{what}: {len(bare)} of {len(logs)} logs hold no commands ({bare[0]}{', ...' * (len(bare) > 1)}); "
            "put them into a folder of their own"
        )
    return bool(bare)


def require_commands(logs: Sequence[RunLog], what: str) -> None:
    """Raise InputError where ``what``, such as "identification", is given logs of states alone."""
    if states_alone(logs, what):
        raise InputError(
            f"{what}: these logs hold no commands, and without them stiffness, friction, lag and zeros cannot be told; "
            "record what is sent as well (`diagnose` and `replay` take states alone)"
        )
