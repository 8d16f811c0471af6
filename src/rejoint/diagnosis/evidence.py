"""What logs of other motion hold that a diagnosis can rest on."""

from __future__ import annotations

from dataclasses import dataclass

from rejoint.system.statistics import Estimate


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Logs that a diagnosis was made from."""

    motions: int
    seconds: float
    """[s] in all"""
    free_seconds: float
    """[s] that show the free arm"""
    contact_seconds: float
    """[s] with the tool on a table, recovery included"""
    stop_seconds: float
    """[s] with a joint at a stop, recovery included"""
    dead_seconds: float
    """[s] of readings that do not change though they should, recovery included"""
    table_height_m: float | None
    """of the tool on the table, in the base frame; None if it never touches one"""
    rest_error_mm: Estimate | None
    """from where the tool was sent to where it rests, by encoder kinematics; None if the arm never rests"""
