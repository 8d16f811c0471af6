"""A lone servo with a pendulum: its logs are accepted as they are, and its truth is found at every gain."""

from dataclasses import replace

import numpy as np
import pytest
import rig

from rejoint.logs.exclusions import find_exclusions, table_height
from rejoint.system.errors import InputError
from rejoint.twin.conditions import GAIN, TORQUE_OFF, declare, gains, powered
from rejoint.twin.fromlogs import FITTED, identify_logs
from rejoint.twin.holdout import HoldOut
from rejoint.twin.judge import Candidate, judge
from rejoint.twin.motionfit import LogSettings

SETTINGS = LogSettings(threads=1, stictions=(1.25,), timestep=0.005)


@pytest.mark.parametrize("gain", [rig.GAINS[0], rig.GAINS[2]])
def test_a_minute_of_a_lone_servo_tells_its_stiffness(gain):
    """On fresh motion the twin is as good as one with the plant's own parameters, and trusted."""
    found = identify_logs(rig.ARM, rig.minute(gain), SETTINGS)
    assert float(found.twin.parameters.stiffness[0]) == pytest.approx(gain, rel=0.15)
    assert found.judgement.doubts == ()
    fresh = [rig.record(gain, rig.Motion(seed=900 + k, seconds=8.0, steps=k % 2 == 1)) for k in range(4)]
    truth = Candidate(name="truth", parameters=rig.truth(gain), stiction=1.25)
    mean = judge(rig.ARM, [Candidate.of(FITTED, found.twin), truth], fresh, timestep=0.005).mean
    assert mean[FITTED].free.joint < 1.2 * mean["truth"].free.joint


def test_one_log_of_a_lone_servo_is_enough():
    log = rig.record(1.0, rig.Motion(seed=7, seconds=24.0))
    found = identify_logs(rig.ARM, [log], SETTINGS)
    assert float(found.twin.parameters.stiffness[0]) == pytest.approx(1.0, rel=0.15)
    assert [motion.motion for motion in found.judgement.motions] == ["motion7 (end)"]


@pytest.mark.parametrize(("gain", "friction"), [(0.36, 1.0), (0.36, 3.0), (9.0, 1.0)])
def test_a_weak_or_sticky_servo_is_neither_at_a_stop_nor_dead(gain, friction):
    """The weakest sags by more than 20 degrees; with three times the friction it sticks over 15."""
    logs = [rig.record(gain, rig.Motion(seed=k, steps=k % 2 == 1), friction=friction) for k in range(4)]
    assert table_height(rig.ARM, logs) is None
    for log, rows in zip(logs, find_exclusions(rig.ARM, logs), strict=True):
        assert rows.free.mean() > 0.95, log.label
    if gain < 1.0:
        far = max(np.quantile(np.abs(log.command - log.position), 0.95) for log in logs)
        assert far > np.radians(15.0)


def test_dead_readings_and_a_stop_of_a_lone_servo_are_found():
    log = rig.record(9.0, rig.Motion(seed=2, seconds=20.0))
    dead, blocked = log.position.copy(), np.minimum(log.position, 0.4)
    dead[600:1000] = dead[600]
    rows = find_exclusions(rig.ARM, [replace(log, position=dead)])[0]
    assert rows.stale[650:1000].all()
    assert not rows.stale[:590].any()
    pressed = log.command[:, 0] > 0.4 + np.radians(12.0)
    assert pressed.sum() > 100
    assert find_exclusions(rig.ARM, [replace(log, position=blocked)])[0].stop[pressed].mean() > 0.9


def test_gains_and_spans_without_torque_can_be_declared():
    """Motions at two gains make one twin, of the gain that is one; what is recorded without torque is left out."""
    soft = [rig.record(1.5, rig.Motion(seed=k, steps=k % 2 == 1)) for k in range(2)]
    stiff = [rig.record(3.0, rig.Motion(seed=10 + k, steps=k % 2 == 1)) for k in range(2)]
    limp = soft[0].position.copy()
    limp[300:500] = 0.0
    logs = declare([replace(soft[0], position=limp), *soft[1:], *stiff], GAIN, {"motion0": "0.5", "motion1": "0.5"})
    logs = declare(logs, TORQUE_OFF, {"motion0": "3-5"})
    found = identify_logs(rig.ARM, logs, replace(SETTINGS, hold_out=HoldOut(names=("motion11",))))
    assert float(found.twin.parameters.stiffness[0]) == pytest.approx(3.0, rel=0.15)
    assert found.fitted == ("motion0 (1)", "motion0 (2)", "motion1", "motion10")
    pieces = powered(logs[:1])
    assert pieces[0].time[-1] - logs[0].time[0] < 3.0
    assert pieces[1].time[0] - logs[0].time[0] > 5.0
    np.testing.assert_array_equal(gains(pieces[1]), [0.5])


def test_declarations_that_make_no_sense_are_refused():
    logs = [rig.record(1.0, rig.Motion(seed=0, seconds=1.0))]
    for key, values, says in (
        (GAIN, {"elsewhere": "1"}, "no motion elsewhere"), (GAIN, {"motion0": "0"}, "above zero"),
        (GAIN, {"motion0": "1 2"}, "one number above zero, or 1"), (GAIN, {"motion0": "half"}, "not a number"),
        (TORQUE_OFF, {"motion0": "5-3"}, "from and to"), (TORQUE_OFF, {"motion0": "3"}, "from and to"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=says):
            declare(logs, key, values)
