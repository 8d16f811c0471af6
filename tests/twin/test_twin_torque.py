"""Logged torque settles the scale that masses leave open, with gravity fed forward or links heavier than modelled."""

from dataclasses import replace

import numpy as np
import pytest
from motion_logs import ARM, TRUTH, centre_of, record, wandering

from rejoint.arms import gravity_torque
from rejoint.diagnosis.diagnosis import diagnose_logs
from rejoint.twin.identify import LogSettings, identify_logs

STRANGER = replace(ARM, name="stranger")
HEAVY = replace(ARM, mass=1.5 * ARM.mass)


def motions(share):
    """Logs with torque of an arm that is heavier than its model; a ``share`` of its gravity is fed forward."""
    logs, rng = [], np.random.default_rng(0)
    for k in range(5):
        time, command = wandering(k, 20.0, centre_of(k, wrist=0.0))
        sent = command + share * gravity_torque(HEAVY, command) / TRUTH.stiffness
        log = record(f"motion{k}", time, sent, own=HEAVY)
        torque = TRUTH.stiffness * (sent - log.position + TRUTH.offset)
        noisy = torque + 0.02 * rng.standard_normal(torque.shape)
        logs.append(replace(log, arm="stranger", command=command, torque=noisy, units={"torque": "N m"}))
    return logs


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_torque_tells_the_stiffness_and_a_sag_no_more_than_it_can(share):
    logs = motions(share)
    for row, truth in zip(diagnose_logs(STRANGER, logs, None).measurement.joints, TRUTH.stiffness, strict=True):
        k = row.stiffness_nm_per_rad
        assert k.low < truth < k.high
        assert abs(k.value / truth - 1.0) < 0.1
    rows = diagnose_logs(STRANGER, [replace(log, torque=None) for log in logs], None).measurement.joints
    for row, truth in zip(rows, TRUTH.stiffness, strict=True):
        k = row.stiffness_nm_per_rad
        assert k is None or (share < 1.0 and k.low < truth < k.high)


def test_a_twin_has_the_scale_of_the_torque():
    twin = identify_logs(STRANGER, motions(0.0), LogSettings(coarse_seconds=20.0, fit_seconds=40.0))
    known = twin.identified[: ARM.joints]
    assert known.all()
    assert np.abs(twin.parameters.stiffness / TRUTH.stiffness - 1.0).max() < 0.15
    assert twin.held_out.twin.tcp < 1e-3
