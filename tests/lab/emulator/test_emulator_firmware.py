"""The firmware: limits, fresh mode and queue, stop, pause, power; and requests byte by byte."""

from operator import attrgetter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rejoint.arms import mycobot280
from rejoint.robots.mycobot.motion import FULL_SPEED
from rejoint.robots.mycobot.wire import NO_LINE, NO_SOLUTION, ORDER, ROWS, SIZES, Frame, answer
from rejoint_lab.emulator.firmware import COMMAND_DELAY

ARM = mycobot280()
REST = ARM.rest
THERE = REST + np.radians([30, 10, -10, 5, -5, 20])


def ask(firmware, text):
    """Request as hex without header, length and footer -> payload of the answer as hex, None for silence."""
    data = bytes.fromhex(text)
    reply = answer(firmware, Frame(data[0], data[1:]))
    return None if reply is None else reply.payload.hex()


@pytest.mark.parametrize("request_", ["40", "FF", "20 00", "22 01", "4A", "4A 09", "A0 01 01", "2A 00", "D5 01"])
def test_what_is_unknown_or_malformed_gets_no_answer(firmware, plant, request_):
    assert ask(firmware, request_) is None
    firmware.advance(1.0)
    np.testing.assert_array_equal(plant.position[0], REST)


def test_narrowed_limits_hold_and_never_widen(firmware):
    assert ask(firmware, "4D 01 0064") == "01"  # joint 1 up to 10.0 deg
    assert ask(firmware, "4B 01") == "010064"
    assert ask(firmware, "21 01 05DC 32") == "00"  # 15 deg
    assert ask(firmware, "21 01 0384 32") == "01"  # 9 deg
    assert ask(firmware, "4D 01 0708") == "00"  # 180.0 deg is beyond the arm's 168
    assert ask(firmware, "4C 01 00C8") == "00"  # a minimum of 20 above the maximum of 10
    assert ask(firmware, "4B 01") == "010064"


@pytest.mark.parametrize("percent", [100, 25])
def test_speed_scales_the_ramp(firmware, plant, percent):
    firmware.fresh = True
    firmware.move_joints(REST + np.array([1.5, 0, 0, 0, 0, 0]), percent / 100)
    firmware.advance(COMMAND_DELAY[1] + 0.002)
    before = plant.position[0, 0]
    firmware.advance(0.4)
    assert plant.position[0, 0] - before == pytest.approx(0.4 * FULL_SPEED * percent / 100, rel=1e-6)


def test_a_command_takes_effect_after_the_bus_latency(firmware, plant):
    firmware.fresh = True
    firmware.move_joints(THERE, 1.0)
    firmware.advance(COMMAND_DELAY[0] - 0.001)
    assert not plant.writes
    firmware.advance(COMMAND_DELAY[1] - COMMAND_DELAY[0] + 0.003)
    assert len(plant.writes) == 1


def test_without_power_nothing_is_accepted(firmware, plant):
    assert ask(firmware, "11") == "01"
    assert not plant.on
    assert ask(firmware, "12") == "00"
    assert ask(firmware, "51") == "00"
    assert not firmware.move_joints(THERE, 1.0)
    assert ask(firmware, "57 00") == "00"
    assert ask(firmware, "10") == "01"
    assert plant.on
    firmware.advance(0.5)
    np.testing.assert_array_equal(plant.position[0], REST)


def test_a_released_servo_gives_way_and_holds_where_it_is_put(firmware, plant):
    assert ask(firmware, "56 02") == "01"
    assert ask(firmware, "50 02") == "0200"
    assert ask(firmware, "51") == "00"
    plant.position[0, 1] += 0.3  # pushed by hand
    firmware.advance(0.1)
    assert plant.goal[0, 1] == pytest.approx(REST[1] + 0.3)
    assert ask(firmware, "57 02") == "01"
    firmware.advance(1.0)
    expected = REST.copy()
    expected[1] += 0.3
    np.testing.assert_allclose(plant.position[0], expected)


def test_calibration_makes_the_present_position_zero_without_motion(firmware, plant):
    assert ask(firmware, "54 01") == "01"
    assert ask(firmware, "20")[:4] == "0000"
    assert ask(firmware, "3B 01") == "0800"
    firmware.advance(1.0)
    np.testing.assert_allclose(plant.position[0], REST)
    firmware.fresh = True
    ask(firmware, "21 01 03E8 64")  # 10 deg from the new zero
    firmware.advance(1.0)
    assert plant.position[0, 0] == pytest.approx(REST[0] + np.radians(10))


def test_unreachable_coords_are_refused_with_the_vendors_codes(firmware, plant):
    far = np.array([2800, 2800, 4000, 0, 0, 0], dtype=">i2").tobytes().hex()
    assert ask(firmware, "25" + far + "64") == "00"
    assert firmware.error == NO_SOLUTION
    assert ask(firmware, "25" + far + "64 01") == "00"
    assert firmware.error == NO_LINE
    firmware.advance(1.0)
    np.testing.assert_array_equal(plant.position[0], REST)


def test_less_than_a_millisecond_is_not_lost(firmware):
    for _ in range(1000):
        firmware.advance(0.0004)
    assert firmware.plant.time[0] == pytest.approx(0.4, abs=1.1e-3)


KNOWN = [
    (command, size)
    for (command, size), row in ROWS.items()
    if (size == 0 or row.answer == ORDER) and (command, size) not in ((0x13, 1), (0x54, 1))
]
requests = st.sampled_from(KNOWN).flatmap(
    lambda known: st.builds(Frame, st.just(known[0]), st.binary(min_size=known[1], max_size=known[1]))
)


@settings(max_examples=80)
@given(st.lists(st.tuples(requests, st.integers(0, 60)), max_size=25), st.integers(0, 99))
def test_after_any_commands_the_arm_obeys_the_next(ideal, history, seed):
    """Whatever was sent, and however fast: limits hold throughout, and a fresh command is carried out exactly."""
    firmware = ideal(ARM, None, seed=seed)
    plant = firmware.plant
    for request, pause_ms in history:
        answer(firmware, request)
        firmware.advance(pause_ms * 1e-3)
        assert np.all((plant.goal >= ARM.lower - 1e-9) & (plant.goal <= ARM.upper + 1e-9))
    firmware.power(True)
    firmware.fresh = True
    wanted = np.clip(THERE, firmware.lower, firmware.upper)
    assert firmware.move_joints(np.clip(REST, firmware.lower, firmware.upper), 1.0)
    assert firmware.move_joints(wanted, 1.0)
    firmware.advance(4.0)
    np.testing.assert_allclose(plant.position[0], wanted, atol=1e-9)
    assert not firmware.moving


def test_each_command_names_something_that_the_computer_has_and_known_parts(firmware):
    for row in ROWS.values():
        assert row.call == "" or attrgetter(row.call)(firmware) is not None
        assert set(row.parts) <= set(SIZES)
