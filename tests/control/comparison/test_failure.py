"""Why a controller failed, in words."""

from rejoint.control.comparison.failure import MEANINGS
from rejoint.control.guard import TRIPS, reason_names


def test_every_reason_that_ends_a_motion_has_words():
    assert set(MEANINGS) == set(reason_names(TRIPS.value))
