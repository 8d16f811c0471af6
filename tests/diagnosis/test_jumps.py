"""What is no wear is told from it, on emulated arms: zeros that were moved between two checks, and warmth."""

from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
import pytest

from rejoint.arms import load_arm
from rejoint.diagnosis.monitoring.judge import PastCheck, outlook, say
from rejoint.diagnosis.monitoring.measures import measure_check, record_check
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear

ARM = load_arm("mycobot280")
BEGIN = datetime(2027, 1, 1)
MOVED_DEG = {"joint2": 1.2, "joint3": -0.8}
AGED = ("healthy?seed=5&hours=900", "worn")


def judged(*checks):
    """Judge checks, one a month, whose true error nobody knows."""
    return outlook(
        [PastCheck(time=BEGIN + timedelta(days=30 * n), measures=one) for n, one in enumerate(checks)],
        tolerance_mm=50.0,
    )


@pytest.fixture(scope="module")
def checks():
    """Check a healthy arm, the same with two zeros moved, and arms that wear much."""
    healthy, *aged = (load_wear(name, ARM) for name in ("healthy", *AGED))
    off = np.array([MOVED_DEG.get(name, 0.0) for name in ARM.joint_names])
    moved = replace(healthy, offset=healthy.offset - np.radians(off))
    robot = EmulatedRobot(ARM, [healthy, moved, *aged], seed=4)
    return [replace(measure_check(ARM, log, warm), true_error_mm=None) for log, warm in record_check(robot)]


def test_zeros_that_were_moved_are_no_wear(checks):
    healthy, moved = checks[:2]
    found = judged(*[healthy] * 6, moved)
    assert {one.joint: one.degrees for one in found.moved} == pytest.approx(MOVED_DEG, abs=0.1)
    assert {(one.after, one.before) for one in found.moved} == {
        (BEGIN + timedelta(days=150), BEGIN + timedelta(days=180))
    }
    assert found.state == "drifting"
    assert found.due is None
    line = say(found, "ROBOT")
    assert "joint2 by 1.2 deg, joint3 by 0.8 deg, which is no wear" in line
    later = judged(*[healthy] * 6, *[moved] * 3)  # by then the charts call out as well
    assert later.state == "alarm"


def test_one_odd_check_is_no_moved_arm(checks):
    healthy, moved = checks[:2]
    assert judged(*[healthy] * 6, moved, healthy).moved == ()


def test_a_joint_that_rests_elsewhere_in_its_friction_has_not_moved_its_zero(checks):
    rows = [replace(one, deviation_mm=one.deviation_mm + 0.4 * one.hysteresis_mm) for one in checks[0].joints]
    assert judged(checks[0], replace(checks[0], joints=tuple(rows))).moved == ()


def test_a_slower_connection_is_no_wear(checks):
    """At the speed of the sweeps, 0.12 rad/s, 50 ms lie between the directions as 0.012 rad do."""
    rows = [replace(one, hysteresis_mm=one.hysteresis_mm + 0.012 * one.lever_mm) for one in checks[0].joints]
    slower = judged(*[checks[0]] * 6, *[replace(checks[0], joints=tuple(rows))] * 3)
    assert slower.state == "alarm"
    assert slower.later
    assert not judged(*[checks[0]] * 6, *[checks[3]] * 3).later


@pytest.mark.parametrize("which", range(len(AGED)), ids=AGED)
def test_wear_is_no_moved_zero_however_fast_it_comes(checks, which):
    found = judged(*[checks[0]] * 6, *[checks[2 + which]] * 3)
    assert found.moved == ()
    assert found.state == "alarm"


def test_where_a_joint_rests_may_go_with_the_warmth_of_its_whole_friction(checks):
    """A reversal is the small rest of a wide band: it goes with warmth by more than a small share of itself."""
    seen = []
    for month in (0.0, 0.05, 0.1, 0.15, *range(1, 19)):
        warmer = 5.0 * np.sin(2.0 * np.pi * (month + 3) / 12.0)
        rows = [
            replace(
                one,
                temperature_c=(one.temperature_c or 0.0) + warmer,
                reversal_mm=one.reversal_mm - 0.01 * one.hysteresis_mm * warmer,
            )
            for one in checks[0].joints
        ]
        seen.append(replace(checks[0], joints=tuple(rows)))
    assert all(judged(*seen[:stop]).state != "alarm" for stop in range(6, len(seen) + 1))
