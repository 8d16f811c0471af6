"""A lone servo with a pendulum: its logs are accepted as they are, and its truth is found at every gain."""

from dataclasses import replace

import numpy as np
import pytest
import rig

from rejoint.logs.exclusions import find_exclusions, table_height
from rejoint.twin.fromlogs import FITTED, identify_logs
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
