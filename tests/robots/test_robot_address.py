"""Robot addresses: what they mean, and one clear line for those that mean nothing."""

import pytest

from rejoint.robots import open_robot, place_of
from rejoint.robots.family import Wire
from rejoint.system.errors import InputError
from rejoint_lab.family import EmulatedAddress

KNOWN = [
    ("emulated:worn?seed=7", EmulatedAddress(profile="worn?seed=7")),
    ("emulated:worn?payload=0.1&seed=7", EmulatedAddress(profile="worn?seed=7", payload=0.1)),
    ("tcp://robot.local", Wire(text="tcp://robot.local", host="robot.local", port=9000)),
    ("serial:///dev/ttyAMA0", Wire(text="serial:///dev/ttyAMA0", device="/dev/ttyAMA0", baud=1_000_000)),
    ("serial:///dev/x?baud=115200", Wire(text="serial:///dev/x?baud=115200", device="/dev/x", baud=115_200)),
]


@pytest.mark.parametrize(("text", "detail"), KNOWN)
def test_known_addresses(text, detail):
    place = place_of(text)
    assert (place.text, str(place), place.detail) == (text, text, detail)
    assert place.virtual == text.startswith("emulated:")


@pytest.mark.parametrize("arguments", [{"count": 0}, {"count": 2}, {"period": (0.0, 0.1)}, {"period": (0.2, 0.1)}])
def test_what_a_single_arm_cannot_do_is_refused_before_connecting(arguments):
    with pytest.raises(InputError):
        open_robot("tcp://127.0.0.1:1", **arguments)
