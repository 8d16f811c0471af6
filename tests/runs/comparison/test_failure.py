"""Why a controller failed, in words."""

from rejoint.control.guard import TRIPS, reason_names
from rejoint.runs.comparison.failure import MEANINGS


def test_every_reason_that_ends_a_motion_has_words():
    assert set(MEANINGS) == set(reason_names(TRIPS.value))
