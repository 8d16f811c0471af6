"""The measurements find the parameters of a servo that is simulated here, apart from any other model."""

import dataclasses

import numpy as np
import pytest

from rejoint.arms import gravity_torque, link_inertia, mycobot280
from rejoint.diagnosis.excitation import EXCITATION_LABEL, plan_excitation
from rejoint.diagnosis.measurement import measure
from rejoint.diagnosis.metrics import arm_delay, gravity_terms
from rejoint.diagnosis.segments import ExcitationLog, attach_segments
from rejoint.logs.runlog import RunLog

ARM = mycobot280()
STEP = 0.0025  # s
LATENCY = AGE = 4  # steps: 10 ms each way

STIFFNESS = np.array([20.0, 40.0, 8.0, 10.0, 30.0, 15.0])
DAMPING = np.array([0.6, 1.0, 0.15, 0.4, 0.5, 0.3])
COULOMB = np.array([0.10, 0.05, 0.12, 0.03, 0.06, 0.02])
INERTIA = np.array([0.020, 0.020, 0.016, 0.016, 0.016, 0.016])


@pytest.fixture(scope="module")
def log():
    """The log of servos that turn as fast as they should."""
    return simulated(ARM.max_speed)


def simulated(top_speed):
    """Six joints, each a PD servo with an inertia, Coulomb friction and gravity, behind a channel with jitter."""
    excitation = plan_excitation(ARM, seed=7)
    rng = np.random.default_rng(7)
    inertia = INERTIA + link_inertia(ARM, ARM.rest)
    q, v, due, goal, reference = ARM.rest.copy(), np.zeros(6), {}, ARM.rest.copy(), ARM.rest.copy()
    history, rows, next_row = [q] * (AGE + 1), [], 0
    for k in range(int(excitation.duration / STEP)):
        if k == next_row:
            seen = np.rint(history[-1 - AGE] / ARM.encoder_step) * ARM.encoder_step
            command = excitation.command(k * STEP)
            rows.append((k * STEP, seen, command))
            due[k + LATENCY] = command
            gravity = gravity_torque(ARM, q)
            next_row = k + int(rng.integers(8, 13))
        goal = due.pop(k, goal)
        reference = reference + np.clip(goal - reference, -STEP * top_speed, STEP * top_speed)
        free = (v + STEP * (STIFFNESS * (reference - q) - gravity) / inertia) / (1 + STEP * DAMPING / inertia)
        v = np.sign(free) * np.maximum(np.abs(free) - STEP * COULOMB / inertia, 0.0)
        q = q + STEP * v
        history.append(q)
    time, position, command = (np.array(column) for column in zip(*rows, strict=True))
    plain = RunLog.of(time + 5.0, command, position, arm=ARM, label=EXCITATION_LABEL)
    return attach_segments(plain, excitation.segments, np.zeros((0, 2)))


@pytest.fixture(scope="module")
def measured(log):
    return measure(ARM, log)


def test_the_terms_of_gravity_add_up_to_the_torque():
    q = np.random.default_rng(0).uniform(ARM.lower, ARM.upper, (5, ARM.joints))
    links = np.column_stack([ARM.mass, ARM.mass[:, None] * ARM.com]).ravel()
    found = [gravity_terms(ARM, q, joint) @ links for joint in range(ARM.joints)]
    assert np.transpose(found) == pytest.approx(gravity_torque(ARM, q))


@pytest.mark.parametrize("joint", [1, 2])
def test_stiffness_from_gravity(measured, joint):
    found = measured.joints[joint]
    assert found.stiffness_nm_per_rad.value == pytest.approx(STIFFNESS[joint], rel=0.07)
    assert found.stiffness_nm_per_rad.low * 0.95 < STIFFNESS[joint] < found.stiffness_nm_per_rad.high * 1.05


@pytest.mark.parametrize("joint", [0, 4, 5])
def test_stiffness_from_inertia_where_gravity_does_nothing(measured, joint):
    found = measured.joints[joint]
    assert found.stiffness_nm_per_rad.low < STIFFNESS[joint] < found.stiffness_nm_per_rad.high


def test_known_motor_inertias_sharpen_it(log):
    found = measure(ARM, log, tuple(INERTIA))
    for joint in (0, 4, 5):
        assert found.joints[joint].stiffness_nm_per_rad.value == pytest.approx(STIFFNESS[joint], rel=0.3)


@pytest.mark.parametrize("joint", range(6))
def test_hysteresis_and_lag(measured, joint):
    found = measured.joints[joint]
    assert found.hysteresis_rad.value == pytest.approx(2 * COULOMB[joint] / STIFFNESS[joint], rel=0.2, abs=6e-4)
    assert found.lag_s.value == pytest.approx(DAMPING[joint] / STIFFNESS[joint], rel=0.2, abs=0.006)


def test_friction_in_newton_metres(measured):
    for joint in (1, 2):
        assert measured.joints[joint].coulomb_nm.value == pytest.approx(COULOMB[joint], rel=0.25)


def test_damping_ratio(measured):
    truth = DAMPING / (2 * np.sqrt(STIFFNESS * (INERTIA + link_inertia(ARM, ARM.rest))))
    for joint in (0, 1, 2, 3):
        assert measured.joints[joint].damping_ratio.value == pytest.approx(truth[joint], rel=0.3)


@pytest.mark.parametrize("delay", [0.1, 0.25])
def test_a_longer_way_to_the_arm_changes_its_delay_alone(log, measured, delay):
    late = np.stack([np.interp(log.time - delay, log.time, angle) for angle in log.position.T], axis=-1)
    late = dataclasses.replace(log, position=late)
    before, after = (arm_delay(ExcitationLog.of(ARM, one)) for one in (log, late))
    assert after - before == pytest.approx(delay, abs=0.01)
    for now, then in zip(measure(ARM, late).joints, measured.joints, strict=True):
        assert now.stiffness_nm_per_rad.value == pytest.approx(then.stiffness_nm_per_rad.value, 0.15)
        assert now.hunting_rad.value < then.hunting_rad.value + 1e-3


def test_encoder_noise_is_measured(log):
    rng = np.random.default_rng(0)
    noisy = dataclasses.replace(log, position=log.position + rng.normal(scale=0.005, size=log.position.shape))
    for found in measure(ARM, noisy).joints:
        assert found.noise_rad.low < 0.005 < found.noise_rad.high


@pytest.mark.parametrize("every", [1, 2], ids=["25 ms", "50 ms"])
def test_noise_is_not_taken_for_hunting_and_hunting_not_for_noise(log, every):
    names = ("time", "position", "command", "target", "true_tcp")
    thinned = dataclasses.replace(log, **{name: getattr(log, name)[::every] for name in names})
    rng = np.random.default_rng(1)
    noisy = dataclasses.replace(thinned, position=thinned.position + rng.normal(scale=0.009, size=(len(thinned), 6)))
    assert all(row.hunting_rad.value == 0.0 for row in measure(ARM, noisy).joints)
    swing = 0.009 * 2**0.5 * np.sin(2 * np.pi * 4.0 * thinned.time)
    hunting = dataclasses.replace(thinned, position=thinned.position + swing[:, None])
    assert all(row.hunting_rad.low > 0.006 for row in measure(ARM, hunting).joints)
