"""Logged torque settles the scale that masses leave open, with gravity fed forward or links heavier than modelled."""

from dataclasses import replace

import numpy as np
import pytest
from motion_logs import ARM, TRUTH, centre_of, record, wandering

from rejoint.arms import gravity_torque
from rejoint.diagnosis.diagnosis import diagnose_logs
from rejoint.twin.identify import LogSettings, Motions, identify_logs

STRANGER = replace(ARM, name="stranger")
HEAVY = replace(ARM, mass=1.5 * ARM.mass)


def motions(share, tempo=1):
    """Logs with torque of an arm that is heavier than its model; a ``share`` of its gravity is fed forward."""
    logs, rng = [], np.random.default_rng(0)
    for k in range(5):
        time, command = (one[::tempo] for one in wandering(k, 20.0 * tempo, centre_of(k, wrist=0.0)))
        sent = command + share * gravity_torque(HEAVY, command) / TRUTH.stiffness
        log = record(f"motion{k}", time / tempo, sent, own=HEAVY)
        torque = TRUTH.stiffness * (sent - log.position + TRUTH.offset)
        noisy = torque + 0.02 * rng.standard_normal(torque.shape)
        logs.append(replace(log, arm="stranger", command=command, torque=noisy, units={"torque": "N m"}))
    return logs


def stiffness(logs, gear=1.0):
    """Stiffness (n, 3) with its interval, over the true one; NaN if unknown. Torques are divided by a gear ratio."""
    logs = [replace(log, torque=log.torque / gear) for log in logs]
    rows = [row.stiffness_nm_per_rad for row in diagnose_logs(STRANGER, logs, None).measurement.joints]
    return np.array([(k.value, k.low, k.high) if k else [np.nan] * 3 for k in rows]) / TRUTH.stiffness[:, None]


@pytest.mark.parametrize("share", [0.0, 0.5, 0.8, 1.0])
def test_torque_tells_the_stiffness_and_a_sag_no_more_than_it_can(share):
    logs = motions(share)
    value, low, high = stiffness(logs).T
    assert ((low < 1.0) & (high > 1.0)).all()
    assert np.abs(value - 1.0).max() < 0.1
    if share != 0.8:  # the sag left then is that of servos three times as stiff
        _, low, high = stiffness(logs, np.nan).T
        assert not ((low > 1.0) | (high < 1.0)).any()
        assert share < 1.0 or np.isnan(low).all()


@pytest.mark.parametrize(("share", "gear"), [(0.0, 0.001), (1.0, 6.33)])
def test_torques_of_motors_or_in_another_unit_are_not_believed(share, gear):
    _, low, high = stiffness(motions(share), gear).T
    assert not ((low > 1.0) | (high < 1.0)).any()


def test_a_twin_has_the_scale_of_the_torque():
    settings = LogSettings(hold_out=("motion1",), coarse_seconds=20.0, fit_seconds=40.0)
    twin = identify_logs(STRANGER, motions(0.0), settings)
    assert twin.identified[: ARM.joints].all()
    assert np.abs(twin.parameters.stiffness / TRUTH.stiffness - 1.0).max() < 0.15
    assert twin.held_out.twin.tcp < 1e-3


def test_fast_motion_tells_no_share_of_gravity():
    belief = Motions(STRANGER, motions(0.0, tempo=4), LogSettings()).belief
    shares = belief.layout.at("compensation")
    assert (np.abs(-0.5 - belief.mean[shares]) < 2.0 * belief.sigma[shares])[1:4].all()


def test_torque_of_the_other_sign_shows():
    turned = [replace(log, torque=-log.torque) for log in motions(0.0)]
    for logs in (turned, [replace(log, command=np.nan * log.command) for log in turned]):
        found = diagnose_logs(STRANGER, logs, None)
        assert found.measurement.torque_over_load == pytest.approx(-1.5, 0.05)
        assert any("carries the weight" in line for line in found.unseen)
