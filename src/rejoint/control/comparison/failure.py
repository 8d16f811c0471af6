"""How and why a controller failed, in one sentence for the owner."""

from __future__ import annotations

from collections import Counter

from rejoint.control.comparison.result import ControllerRow
from rejoint.control.guard import TRIPS, reason_names

MEANINGS = {
    "not finite": "a command or a measured position was not a number",
    "stale": "the arm's answers were too old",
    "out of range": "a measured position lay far outside the joint limits",
    "temperature": "a servo was too hot",
    "servo fault": "a servo reported a fault",
    "not following": "a joint's reading stood still and was not believed",
}
"""What the trips of the guard mean, by `reason_names`"""


def failure(row: ControllerRow) -> str:
    """Return the sentence; empty for a controller that was driven to the end and reached some target."""
    name = row.controller
    if row.out:
        return f"{name} {row.out}: what was left of its trials was not driven, and counts neither for nor against it."
    if row.failures:
        sets, repetitions, _ = row.outcomes.shape
        return f"{name}: {row.failures} of {2 * sets * repetitions} runs ended early, because {_why(row)}."
    if row.crossing.success.value == 0.0 and any(value is not None for value in row.outcomes.crossed):
        settled = row.hold.settled
        off = "" if settled is None else f"; it comes to rest {1e3 * settled.mean.value:.1f} mm off"
        return f"{name} reached none of its targets in time{off}."
    return ""


def _why(row: ControllerRow) -> str:
    """Name the reasons, the most frequent first; a file of an earlier version only has the guard's counts."""
    trips = set(reason_names(TRIPS.value))
    names = [name for name, _ in Counter(end.why for end in row.ended).most_common()]
    names = names or [count.reason for count in row.guard if count.reason in trips]
    return ", or ".join(MEANINGS.get(name, name) for name in names) or "the guard stopped them"
