"""The law of an STS3215 against what others measured on real ones, and the plant that runs on it."""

import numpy as np
import pytest

from loneservo import lone_servo
from rejoint.arms import load_arm
from rejoint_lab.plant import sts3215
from rejoint_lab.plant.plant import StsPlant
from rejoint_lab.plant.wear import load_wear

ARM = load_arm("so101")
STEP_ANGLE = 2 * np.pi / sts3215.COUNTS


def blocked(error, **settings):
    """A servo whose shaft stands ``error`` counts short of its goal."""
    servo = lone_servo(blocked=True)
    for name, value in settings.items():
        servo.settings[name] = value
    servo.status["goal"] = error
    servo.advance(0.3)
    return servo


@pytest.mark.parametrize(("counts", "measured"), [(7, 0.191), (25, 0.171), (50, 0.161), (95, 0.165)])
def test_the_duty_of_a_blocked_servo_is_the_one_that_an_oscilloscope_saw(counts, measured):
    """kscalelabs/sysid, 12 V, P = 32: duty over P times the error in radians."""
    found = blocked(counts).status["output"][0] / sts3215.PWM_FULL / (32 * counts * STEP_ANGLE)
    assert found == pytest.approx(measured, rel=0.04)


def test_a_larger_error_ends_in_the_protection_and_a_smaller_one_does_not():
    """The same bench: 100 counts were over 80 % of PWM and fell to 20 % after two seconds, 95 did not."""
    over, under = blocked(100), blocked(95)
    for servo in (over, under):
        assert not servo.status["alarms"].any()
        servo.advance(2.0)
    assert over.status["alarms"][0] == sts3215.OVERLOAD
    assert over.status["output"][0] == 200
    assert under.status["alarms"][0] == 0


@pytest.mark.parametrize(("p", "degrees"), [(16, 3.20), (32, 1.63)])
def test_one_load_sags_at_two_gains_as_an_owner_saw(p, degrees):
    """lerobot PR 4310: the counts of error that 157 per mille call for."""
    servo = lone_servo()
    servo.settings["p"] = p
    servo.joints["coulomb"] = servo.joints["stiction"] = 0.0
    servo.settings["bias"] = -0.157 * servo.settings["stall"]
    servo.advance(2.0)
    assert np.degrees(-servo.qpos[0, 0]) == pytest.approx(degrees, rel=0.05)


def test_an_integral_part_removes_the_sag_and_its_limit_bounds_it():
    servo = lone_servo(2)
    servo.settings["p"], servo.settings["i"] = 48, 4
    servo.settings["limit"] = [[0], [10]]
    servo.settings["bias"] = -0.157 * servo.settings["stall"]
    servo.advance(6.0)
    free, limited = np.degrees(-servo.qpos[:, 0])
    assert abs(free) < 0.2
    assert limited > 0.6


def test_a_bare_servo_turns_at_its_speed_limit_and_stops_at_its_goal():
    servo = lone_servo()
    servo.settings["speed"] = 1000.0
    servo.status["goal"] = 1000
    servo.advance(0.6)
    assert servo.status["speed"][0] == pytest.approx(1000, abs=100)
    assert servo.status["moving"][0]
    servo.advance(1.0)
    assert servo.status["position"][0] == pytest.approx(1000, abs=8)
    assert not servo.status["moving"][0]
    assert servo.status["reference"][0] == 1000


@pytest.mark.parametrize("acceleration", [2_000.0, 10_000.0, 25_400.0])
@pytest.mark.parametrize("goal", [1, 3, 57, -900])
def test_the_ramp_arrives_and_never_runs_past_its_goal(acceleration, goal):
    servo = lone_servo(blocked=True)
    servo.settings["acceleration"], servo.status["goal"] = acceleration, goal
    seen = []
    for _ in range(1500):
        servo.advance(0.001)
        seen.append(servo.status["reference"][0] * np.sign(goal))
    assert max(seen) <= abs(goal) + 1
    assert seen[-1] == abs(goal)


def test_torque_off_lets_go_and_torque_on_does_not_jump():
    servo = lone_servo()
    servo.status["goal"] = 200
    servo.advance(1.0)
    servo.settings["torque_on"] = 0
    servo.settings["bias"] = -0.3
    servo.advance(0.3)
    fallen = servo.qpos[0, 0]
    assert fallen < 150 * STEP_ANGLE
    servo.settings["torque_on"] = 1
    servo.settings["bias"] = 0.0
    servo.advance(1.0)
    assert servo.qpos[0, 0] < fallen + 0.05


def test_a_low_supply_is_told_and_weakens_the_motor():
    strong, weak = blocked(50), blocked(50, voltage=6.0, low_voltage=7.0)
    assert strong.servos["torque"][0] == pytest.approx(2 * weak.servos["torque"][0])
    assert weak.status["alarms"][0] == sts3215.VOLTAGE
    assert strong.status["alarms"][0] == 0


def test_heat_switches_the_output_off_where_it_is_asked_to():
    cut, kept = blocked(50, warmth=60.0), blocked(50, warmth=60.0, unloading=0)
    assert cut.status["output"][0] == 0
    assert kept.status["output"][0] > 0
    assert cut.status["alarms"][0] == kept.status["alarms"][0] == sts3215.HEAT


def test_an_arm_with_these_servos_rests_and_sags_as_its_profile_does():
    """At the P that the profile was measured with, the law has the profile's gain."""
    wear = load_wear("so101", ARM)
    plant = StsPlant(ARM, [wear], seed=0)
    before = plant.encoder()
    plant.advance(1.0)
    assert np.abs(plant.encoder() - before).max() <= 3 * ARM.encoder_step
    gain = plant.settings["stall"][0] * sts3215.GAIN_PER_P * 32
    assert gain == pytest.approx(wear.position_gain)
    plant.command(plant.goal + np.radians([20, 15, -15, 20, 20]))
    plant.advance(2.0)
    lead = plant.goal - plant.encoder()
    output = plant.load[0] * 1000
    expected = np.maximum(np.abs(output) - 16, 0) / 8 + 1
    assert np.abs(lead[0] / ARM.encoder_step - expected * np.sign(output))[np.abs(output) > 20].max() <= 1.5
