"""A diagnosis from logs alone: known wear is named, a table is not taken for wear, what is not known is said."""

import re
from dataclasses import replace

import numpy as np
import pytest
from motion_logs import TABLE, TRUTH, as_log, centre_of, pressing, record
from motion_logs import wandering as twin_wandering
from plant_logs import ARM, HEALTHY, kinds, plain_reference, record_motions, with_joint

from rejoint.arms import gravity_torque, tcp_position
from rejoint.diagnosis.diagnosis import diagnose_logs
from rejoint.diagnosis.healthy import reference_by
from rejoint.diagnosis.metrics import fit_law
from rejoint.diagnosis.segments import FREE, inertial_torque, join_logs, resting_postures
from rejoint.logs.columns import ZEROS
from rejoint.logs.exclusions import UNPOWERED, find_exclusions
from rejoint.system.errors import InputError
from rejoint.system.statistics import Estimate

WEARS = {
    "healthy": HEALTHY,
    "soft elbow": with_joint(2, position_gain=0.3 * HEALTHY.position_gain[2]),
    "sticky lift": with_joint(1, coulomb=0.40, stiction=0.50),
    "late elbow": with_joint(2, damping_gain=4.0 * HEALTHY.damping_gain[2]),
    "sticky roll": with_joint(4, coulomb=0.25, stiction=0.30),
    "blocked wrist": with_joint(3, coulomb=8.0, stiction=9.0),
    "limp wrist": with_joint(3, torque_limit=1e-3),
    "ringing pan": with_joint(0, damping_gain=0.05 * HEALTHY.damping_gain[0]),
    "half gain": replace(HEALTHY, position_gain=0.5 * HEALTHY.position_gain),
}


@pytest.fixture(scope="module")
def logs():
    found = dict(zip(WEARS, record_motions(list(WEARS.values()), 6, 16.0), strict=True))
    scale = 1.0 - 0.5 * np.eye(ARM.joints)[0]
    zeros = [replace(log, extra={ZEROS: "the zeros are not known"}) for log in found["soft elbow"]]
    return found | {
        "unknown zeros": zeros,
        "half gain": [replace(log, gain=np.full_like(log.position, 16)) for log in found["half gain"]]
        + [replace(log, gain=np.full_like(log.position, 32)) for log in found["healthy"]],
        "half scale": [replace(log, position=scale * log.position) for log in found["healthy"]],
    }


@pytest.fixture(scope="module")
def found(logs):
    return {name: diagnose_logs(ARM, entry, plain_reference()) for name, entry in logs.items()}


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("healthy", set()),
        ("soft elbow", {("elbow_flex", "weak_gain")}),
        ("sticky lift", {("shoulder_lift", "friction")}),
        ("late elbow", {("elbow_flex", "lag")}),
        ("sticky roll", {("wrist_roll", "hysteresis")}),  # gravity does not load it: friction has no torque here
        ("blocked wrist", {("wrist_flex", "stuck")}),
        ("limp wrist", {("wrist_flex", "stuck")}),
        ("half scale", {("shoulder_pan", "stuck")}),
        ("half gain", set()),
        ("ringing pan", {("shoulder_pan", "low_damping")}),
        ("unknown zeros", {("elbow_flex", "hysteresis")}),  # as sag tells no stiffness
    ],
)
def test_one_wear_is_named_and_nothing_else(found, name, expected):
    assert kinds(found[name]) == expected
    assert (found[name].condition == "ok") == (not expected)
    for joint, _ in expected:
        assert joint in found[name].verdict


def test_stiffness_is_measured_within_its_interval(found):
    """Stiction and load friction shift it by a few percent, as they would in any log of a real arm."""
    known = {name: WEARS[name] for name in ("healthy", "soft elbow", "late elbow")} | {"half gain": HEALTHY}
    for name, wear in known.items():
        for joint in (1, 2, 3):
            k, truth = found[name].measurement.joints[joint].stiffness_nm_per_rad, wear.position_gain[joint]
            assert 0.95 * k.low < truth < 1.05 * k.high, (name, joint, k, truth)
            assert k.high / k.low < 1.6


def test_a_stranger_whose_sag_is_not_that_of_the_model_has_no_known_stiffness(logs):
    """With masses elsewhere the same sag fits no stiffness; with the true ones it tells it, less surely."""
    stranger = replace(ARM, name="stranger")
    entry = [replace(log, arm=stranger.name) for log in logs["healthy"]]
    right = diagnose_logs(stranger, entry, None)
    k = right.measurement.joints[1].stiffness_nm_per_rad
    assert k.low < HEALTHY.position_gain[1] < k.high
    turned = stranger.offset.copy()
    turned[0] = np.eye(4)[[2, 0, 1, 3]] @ turned[0]
    said = diagnose_logs(replace(stranger, offset=turned), entry, None).verdict
    assert "not along (0, 0, -1)" in said
    assert "as if" not in right.verdict
    mirror = np.eye(5)[[0, 2, 1, 3, 4]]
    other = [replace(log, position=log.position @ mirror, command=log.command @ mirror) for log in entry]
    assert "lift and elbow_flex were" in diagnose_logs(stranger, other, None).verdict
    elsewhere = replace(stranger, com=0.15 * np.roll(np.eye(3), 1, axis=0)[np.arange(ARM.joints) % 3])
    rows = diagnose_logs(elsewhere, entry, None).measurement.joints
    assert [row.stiffness_nm_per_rad for row in rows[2:]] == [None] * 3
    assert all(row.hysteresis_rad is not None for row in rows[1:4])
    k = rows[1].stiffness_nm_per_rad  # what follows wrong masses roughly tells it roughly
    assert k.low < HEALTHY.position_gain[1] < k.high


@pytest.mark.parametrize(("name", "expected"), [("soft elbow", "weak_gain"), ("sticky lift", "friction")])
def test_beside_a_healthy_arm_of_its_model_a_stranger_is_as_well_known_as_another(logs, name, expected):
    stranger = replace(ARM, name="stranger")
    before, now = ([replace(log, arm=stranger.name) for log in logs[one]] for one in ("healthy", name))
    good = reference_by(stranger, diagnose_logs(stranger, before, None))
    assert {kind for _, kind in kinds(diagnose_logs(stranger, now, good))} == {expected}


def test_friction_and_hysteresis_are_those_of_the_wear(found):
    lift = found["sticky lift"].measurement.joints[1]
    half = 0.40 / HEALTHY.position_gain[1]
    assert lift.hysteresis_rad.value == pytest.approx(2 * half, rel=0.15)
    assert lift.coulomb_nm.value == pytest.approx(0.40, rel=0.15)
    assert found["healthy"].measurement.joints[1].coulomb_nm.value < 0.12


def test_the_tool_at_rest_is_as_far_off_as_the_logs_say(logs, found):
    log = logs["soft elbow"][0]
    still = np.abs(np.diff(log.command, axis=0, prepend=log.command[:1])).max(axis=1) < 1e-9
    still &= np.concatenate([np.zeros(40, dtype=bool), still[:-40]])  # a second after the last step
    rows = still & (log.time > log.time[0] + 10.0)
    gap = tcp_position(ARM, log.command[rows]) - tcp_position(ARM, log.position[rows])
    expected = 1e3 * np.linalg.norm(gap, axis=1).mean()
    alone = diagnose_logs(
        ARM, [log, replace(log, position=log.position + 1e-9)], None
    ).evidence.rest_error_mm  # of one, there is too little
    assert alone.value == pytest.approx(expected, rel=0.5)
    assert found["soft elbow"].evidence.rest_error_mm.low > found["healthy"].evidence.rest_error_mm.high
    assert found["unknown zeros"].evidence.rest_error_mm is None
    assert found["blocked wrist"].evidence.rest_error_mm.high < 5.0
    assert "without wrist_flex" in found["blocked wrist"].verdict
    assert any("wrist_flex does not answer" in line for line in found["blocked wrist"].unseen)


@pytest.fixture(scope="module")
def on_a_table():
    """Free motion of one arm, and the same arm pressing on a table in several postures."""
    free = [record(f"free{k}", *twin_wandering(k, 14.0, centre_of(k))) for k in range(9)]
    press = [record(f"press{k}", *pressing(14.0 + k), table=TABLE) for k in range(5)]
    return free, press


def own_reference():
    """A reference by which the arm of `motion_logs` is healthy: 30 % about its truth."""

    def around(value):
        return Estimate(value, value / 1.3, value * 1.3)

    healthy = plain_reference()
    rows = tuple(
        replace(
            row,
            stiffness_nm_per_rad=around(TRUTH.stiffness[j]),
            modelled_nm_per_rad=None,
            coulomb_nm=around(1.12 * TRUTH.coulomb[j]),
            hysteresis_rad=around(2.24 * TRUTH.coulomb[j] / TRUTH.stiffness[j]),
            lag_s=around(TRUTH.damping[j] / TRUTH.stiffness[j] + 0.01),
        )
        for j, row in enumerate(healthy.joints)
    )
    return replace(healthy, joints=rows)


def test_an_arm_that_lies_on_its_table_is_not_called_worn(on_a_table):
    free, press = on_a_table
    diagnosis = diagnose_logs(ARM, [*free, *press], own_reference())
    assert kinds(diagnosis) == set()
    assert diagnosis.evidence.table_height_m == pytest.approx(TABLE.height, abs=0.006)
    assert diagnosis.evidence.contact_seconds > 20.0
    assert re.search(r"\d+ s with the tool on a table", diagnosis.verdict)
    alone = diagnose_logs(ARM, free, own_reference())
    assert alone.evidence.table_height_m is None
    for joint in (1, 2, 3):
        k, same = (d.measurement.joints[joint].stiffness_nm_per_rad for d in (diagnosis, alone))
        assert max(k.low, same.low) < min(k.high, same.high)


def test_a_joint_declared_without_torque_is_not_worn(logs):
    declared = [replace(log, extra={UNPOWERED: "wrist_flex"}) for log in logs["limp wrist"]]
    found = diagnose_logs(ARM, declared, plain_reference())
    assert kinds(found) == set()
    assert "wrist_flex does not answer" in " ".join(found.unseen)


def test_spans_hold_free_rows_of_one_log(logs):
    entry = logs["healthy"][:3]
    excluded = find_exclusions(ARM, entry)
    shut = excluded[1].contact.copy()
    shut[100:300] = True
    excluded[1] = replace(excluded[1], contact=shut)
    data = join_logs(ARM, excluded)
    starts = np.cumsum([0, *(len(log) for log in entry)])
    for segment in data.segments:
        rows = data.rows(segment)
        log = segment.log
        assert starts[log] <= rows[0] <= rows[-1] < starts[log + 1]
        assert excluded[log].free[rows - starts[log]].all()
    free = [s for s in data.of_kind(FREE) if s.log == 1]
    assert len(free) == 2
    assert (np.diff(data.log.time) > 0).all()
    np.testing.assert_array_equal(data.log.position, np.concatenate([log.position for log in entry]))


def test_one_direction_tells_no_friction(logs):
    """A joint that is only ever raised: what friction holds back and where its zero is look the same."""
    time = np.arange(0.0, 30.0, 0.02)
    command = np.tile([0.0, -0.4, 0.2, 0.3, 0.0], (len(time), 1))
    command[:, 1] += 0.04 * time
    up = as_log("up", time, command - 0.02, command)
    data = join_logs(ARM, find_exclusions(ARM, [up]))
    assert fit_law(data, 1) is None
    both = join_logs(ARM, find_exclusions(ARM, logs["healthy"]))
    assert fit_law(both, 1) is not None


def test_commands_of_unknown_servos_take_effect_at_once(logs):
    slow = replace(ARM, name="mine", max_speed=0.1 * ARM.max_speed)
    entry = [replace(logs["healthy"][0], arm="mine")]
    data = join_logs(slow, find_exclusions(slow, entry))
    reached = data.references[1].sample(data.log.time + 1e-3, np.zeros(1))[0]
    np.testing.assert_allclose(reached[:, 0], data.log.command[:, 1])


def states_with_current(dry, phase, step=0.01):
    """A minute of states, and of current: ``dry`` (n,) [A], 0.3 A s/rad by speed, 0.05 A s^2/rad, noise; one rests."""
    time = np.arange(0.0, 60.0, step)
    position = np.zeros((len(time), ARM.joints))
    speed, acceleration = np.zeros((2, len(time), ARM.joints))
    for joint in range(ARM.joints - 1):
        for k, rate in enumerate(2 * np.pi * np.array([0.11, 0.17, 0.23, 0.31])):
            angle = rate * time + joint + k + phase
            position[:, joint] += 0.2 * np.sin(angle)
            speed[:, joint] += 0.2 * rate * np.cos(angle)
            acceleration[:, joint] -= 0.2 * rate**2 * np.sin(angle)
    noise = 0.02 * np.random.default_rng(5).standard_normal(speed.shape)
    current = dry * np.sign(speed) + 0.3 * speed + 0.05 * acceleration + noise
    current[1000:1021] = np.nan  # not read
    log = as_log("states", time, position, np.full_like(position, np.nan))
    return replace(log, current=current, units={"current": "A"})


def test_turning_points_and_a_slow_way_are_no_rest():
    time = np.arange(0.0, 20.0, 0.02)
    swing, slow = 0.3 * np.sin(np.outer(time, np.full(ARM.joints, 2.0))), np.outer(0.06 * time, np.ones(ARM.joints))
    for position, command in ((swing, swing + 0.1), (slow, 0.0 * slow + 1.2)):
        log = as_log("moving", time, position, command)
        assert resting_postures(find_exclusions(ARM, [log])[0]).shape[1] == 0


def test_a_joint_that_swings_under_a_standing_command_rests_in_the_middle():
    time = np.arange(0.0, 16.0, 0.02)
    command = np.outer(0.3 * (time > 8.0), np.ones(ARM.joints))
    position = command - 0.14 + np.outer(0.05 * np.sin(14.0 * time), np.eye(ARM.joints)[1])
    log = as_log("swing", time, position, command)
    position, command = resting_postures(find_exclusions(ARM, [log])[0])
    assert len(position) == 2
    np.testing.assert_allclose(position, command - 0.14, atol=0.02)


def test_a_joint_that_gives_way_is_named_though_the_arm_never_rests():
    logs = [states_with_current(np.zeros(ARM.joints), phase) for phase in (0.0, 0.7)]
    slump = np.eye(ARM.joints)[1] * 1.5
    sunk = [replace(log, command=log.position + slump * (log.position > 0.3)) for log in logs]
    found = diagnose_logs(ARM, sunk, None)
    assert kinds(found) == {("shoulder_lift", "stuck")}
    assert found.condition == "bad"


def test_a_frozen_joint_costs_what_its_motion_misses_though_it_rests_where_it_is_sent():
    time = np.arange(0.0, 40.0, 0.02)
    command = np.outer(0.5 * np.sin(0.5 * time).clip(0.0), np.ones(ARM.joints))
    log = as_log("frozen", time, command * (np.arange(ARM.joints) != 1) + 1e-3, command)
    found = diagnose_logs(ARM, [log], None).findings
    assert max(one.tcp_mm for one in found if one.kind == "stuck") > 10.0


def test_a_command_beyond_the_end_of_a_joint_is_no_error():
    time = np.arange(0.0, 40.0, 0.02)
    command = np.outer(np.sin(0.5 * time).clip(-0.3, 0.3), np.ones(ARM.joints)) + ARM.lower
    log = as_log("end", time, command.clip(ARM.lower), command)
    found = diagnose_logs(ARM, [log], None)
    assert found.evidence.rest_error_mm.value < 0.1
    short = as_log("short", time, command.clip(ARM.lower + 0.1), command)
    assert diagnose_logs(ARM, [short], None).evidence.rest_error_mm.value > 10.0


def test_current_tells_friction_where_nobody_recorded_commands():
    log = states_with_current(np.full(ARM.joints, 0.4), 0.0)
    with pytest.raises(InputError, match="hold no commands"):
        diagnose_logs(ARM, [replace(log, current=None, units={})], None)
    diagnosis = diagnose_logs(ARM, [log], None)
    assert (diagnosis.condition, diagnosis.findings) == ("unknown", ())
    for row in diagnosis.measurement.joints[:-1]:
        assert row.coulomb_effort.value == pytest.approx(0.4, 0.05)
        assert row.viscous_effort.value == pytest.approx(0.3, 0.05)
        assert row.stiffness_nm_per_rad is None
    assert diagnosis.measurement.joints[-1].coulomb_effort is None
    assert " A (" in diagnosis.verdict
    assert diagnosis == replace(diagnose_logs(ARM, [log], plain_reference()), healthy=None)  # it knows no current
    dry = replace(log, current=0.4 * np.sign(log.current))
    assert diagnose_logs(ARM, [dry], None).measurement.joints[0].coulomb_effort.value == pytest.approx(0.4, 0.05)
    for current in (-log.current, np.abs(log.current)):
        rows = diagnose_logs(ARM, [replace(log, current=current)], None).measurement.joints
        assert {(row.coulomb_effort, row.viscous_effort) for row in rows} == {(None, None)}


def test_one_speed_does_not_tell_dry_friction_from_friction_by_speed():
    time = np.arange(0.0, 60.0, 0.01)
    position = np.outer(np.abs((0.2 * time) % 2.0 - 1.0), np.ones(ARM.joints))
    way = np.sign(np.gradient(position, axis=0))
    log = as_log("one speed", time, position, np.nan * position)
    log = replace(log, current=0.4 * way + 0.01 * np.sin(time)[:, None] * way, units={"current": "A"})
    row = diagnose_logs(ARM, [log], None).measurement.joints[0]
    assert row.coulomb_effort.value == pytest.approx(0.4, 0.05)
    assert row.viscous_effort is None


def test_noise_of_encoders_does_not_hide_that_torque_is_right():
    clean = states_with_current(0.0, 0.0, 0.002)
    torque = gravity_torque(ARM, clean.position) + inertial_torque(ARM, clean.time, clean.position)
    noisy = clean.position + np.random.default_rng(0).normal(0.0, 3e-3, torque.shape)
    log = replace(clean, position=noisy, torque=torque, units={"torque": "N m"})
    assert diagnose_logs(ARM, [log], None).measurement.torque_over_load == pytest.approx(1.0, 0.1)


@pytest.mark.parametrize(
    ("grown", "unit", "condition"), [(1.6, "A", "unknown"), (1.9, "A", "worn"), (1.9, "", "unknown")]
)
def test_friction_that_grew_between_two_dates_is_named_and_no_other(grown, unit, condition):
    dry = np.full(ARM.joints, 0.4)
    before = diagnose_logs(ARM, [replace(states_with_current(dry, 0.0), units={"current": unit})], None)
    dry[1] *= grown
    now = diagnose_logs(ARM, [states_with_current(dry, 0.7)], reference_by(ARM, before))
    assert now.condition == condition
    assert ("it grew at shoulder_lift." in now.verdict) == (condition == "worn")
    assert now.measurement.joints[1].coulomb_effort.value == pytest.approx(0.4 * grown, 0.05)
