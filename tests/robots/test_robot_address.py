"""Robot addresses: what they mean, and one clear line for those that mean nothing."""

import numpy as np
import pytest

from rejoint.control.robot import Robot
from rejoint.robots import open_robot, place_of
from rejoint.robots.address import SerialAddress, TcpAddress
from rejoint.robots.own import EmulatedAddress
from rejoint.system.errors import AddressError, InputError, MissingExtraError

KNOWN = [
    ("emulated:worn", EmulatedAddress(profile="worn")),
    ("emulated:worn?seed=7", EmulatedAddress(profile="worn?seed=7")),
    ("emulated:worn?payload=0.1&seed=7", EmulatedAddress(profile="worn?seed=7", payload=0.1)),
    ("tcp://10.0.0.7:9001", TcpAddress(text="tcp://10.0.0.7:9001", host="10.0.0.7", port=9001)),
    ("tcp://robot.local", TcpAddress(text="tcp://robot.local", host="robot.local", port=9000)),
    ("serial:///dev/ttyAMA0", SerialAddress(text="serial:///dev/ttyAMA0", device="/dev/ttyAMA0", baud=1_000_000)),
    ("serial:///dev/x?baud=115200", SerialAddress(text="serial:///dev/x?baud=115200", device="/dev/x", baud=115_200)),
]


@pytest.mark.parametrize(("text", "detail"), KNOWN)
def test_known_addresses(text, detail):
    place = place_of(text)
    assert (place.text, str(place), place.detail) == (text, text, detail)
    assert place.virtual == text.startswith("emulated:")


@pytest.mark.parametrize(
    "address",
    [
        "", "worn", "emulated", "emulated:", "tcp:", "tcp://", "tcp://host:port", "tcp://host:99999", "tcp://host:0",
        "tcp://host:1/x", "serial:", "serial://", "serial:///", "serial://ttyAMA0", "serial:///dev/x?baud=fast",
        "serial:///dev/x?speed=1", "http://host:9000", "serial:///dev/x?baud", "tcp://[::1",
    ],
)  # fmt: skip
def test_malformed_addresses_name_their_form_once_or_all_of_them(address):
    forms = {"emulated": r"emulated:PROFILE", "tcp": r"tcp://HOST:PORT", "serial": r"serial:///dev/DEVICE",
             "feetech": r"feetech:///dev/DEVICE or feetech://HOST:PORT"}  # fmt: skip
    scheme, colon, _ = address.partition(":")
    expected = [form for name, form in forms.items() if not (colon and scheme in forms) or name == scheme]
    with pytest.raises(AddressError) as caught:
        open_robot(address)
    assert [str(caught.value).count(form) for form in forms.values()] == [int(f in expected) for f in forms.values()]
    assert len(str(caught.value)) < 160


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "tcp://nosuchhost.invalid:9000", "serial:///dev/nosuchport"])
def test_where_nothing_is_the_error_is_one_line(address):
    with pytest.raises(AddressError, match="nothing answers at") as caught:
        open_robot(address)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("arguments", [{"count": 0}, {"count": 2}, {"period": (0.0, 0.1)}, {"period": (0.2, 0.1)}])
def test_what_a_single_arm_cannot_do_is_refused_before_connecting(arguments):
    with pytest.raises(InputError):
        open_robot("tcp://127.0.0.1:1", **arguments)


def test_emulated_robots_are_opened_as_a_batch():
    robot = open_robot("emulated:worn", count=3, period=(0.05, 0.05), seed=4)
    assert isinstance(robot, Robot)
    assert (robot.count, robot.address) == (3, "emulated:worn")
    before = robot.read()
    after = robot.step(before.position)
    np.testing.assert_allclose(after.time - before.time, 0.05)


def test_a_missing_extra_is_named(monkeypatch):
    monkeypatch.setattr("rejoint.system.extras.find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=r"emulated:worn needs .*mujoco.*pip install 'rejoint\[train\]'"):
        open_robot("emulated:worn")


def test_periods_that_nobody_asked_for():
    for text, period in (("tcp://127.0.0.1:9000", 0.05), ("serial:///dev/ttyAMA0", 0.05)):
        assert place_of(text).default_period == (period, period)
    assert place_of("emulated:worn").default_period == (0.02, 0.03)
