"""Loads that a driver tells of duties, against the law that made the duties."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from loneservo import lone_servo
from rejoint.robots.feetech import KIND, torque_share
from rejoint.robots.knobs import steps


@given(error=st.integers(-90, 90), p=st.sampled_from([8, 16, 32]), startup=st.integers(0, 40), dead=st.integers(0, 4))
def test_the_load_of_a_servo_at_rest_is_its_gain_times_its_error(error, p, startup, dead):
    servo = lone_servo(blocked=True)
    servo.settings["p"], servo.settings["startup"] = p, startup
    servo.settings["dead_cw"] = servo.settings["dead_ccw"] = dead
    servo.status["goal"] = error
    servo.advance(0.4)
    gains = {"p": (p,), "startup": (startup,), "dead_cw": (dead,), "dead_ccw": (dead,)}
    load = torque_share(gains, servo.status["output"], error)
    assert load.item() == pytest.approx(error * p / 4 / 1000, abs=0.0011)


@given(duty=st.integers(-1023, 1023))
def test_loads_keep_the_sign_and_the_size_of_their_duty(duty):
    load = torque_share({"p": (32,), "startup": (16,), "dead_cw": (1,), "dead_ccw": (1,)}, duty, 0).item()
    assert abs(load) <= 1.0
    assert abs(load - duty / 1000) <= 0.024
    assert load * duty >= 0.0


@given(before=st.integers(0, 254), wanted=st.integers(0, 254), name=st.sampled_from(sorted(KIND.strides)))
def test_gains_change_in_small_steps_and_arrive(before, wanted, name):
    values = [row[0] for _, row in steps({name: (before,)}, {name: (wanted,)}, KIND.strides)]
    assert np.abs(np.diff([before, *values])).max(initial=0) <= abs(KIND.strides[name])
    assert [before, *values][-1] == wanted
