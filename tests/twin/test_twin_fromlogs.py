"""Identification from logs of several motions: known truth, recovered inside its intervals."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from motion_logs import ARM, PERIOD, TRUTH, centre_of, pressing, problem_of, record, surface, wandering

from rejoint.arms import gravity_torque, tcp_position
from rejoint.logs.exclusions import UNPOWERED
from rejoint.logs.runlog import RunLog
from rejoint.twin import identify, replay
from rejoint.twin.fit import Problem
from rejoint.twin.identify import FITTED, HEALTHY, REFITTED, LogSettings, Motions, identify_logs
from rejoint.twin.parameters import pack, unknown_prior, unpack, vector_names
from rejoint.twin.replay import Replay, cut, part, repeated
from rejoint.twin.structure import EARLIER, Structure, find_acceleration, rough_fit
from rejoint.twin.twin import NO_TWIN, TablePlane, read_twin

TABLE = TablePlane(height=-0.02, slope_x=0.02, slope_y=0.0, stiffness=3000.0, friction=0.2)
QUICK = LogSettings(coarse_seconds=20.0, fit_seconds=40.0, contact_seconds=12.0)


@pytest.fixture(scope="module")
def logs():
    free = [record(f"motion{k}", *wandering(k, 20.0, centre_of(k))) for k in range(9)]
    return [*free, record("press0", *pressing(16.0), table=TABLE), record("press1", *pressing(20.0), table=TABLE)]


@pytest.fixture(scope="module")
def found(logs):
    return identify_logs(ARM, logs, replace(QUICK, hold_out=("motion3", "motion8", "press1")))


def test_held_out_motions_are_predicted(found):
    mean = found.judgement.mean
    assert mean[FITTED].free.tcp < 1e-3
    assert mean[FITTED].free.joint < np.radians(0.12)
    assert mean[FITTED].free.tcp < 0.1 * min(mean[HEALTHY].free.tcp, mean[NO_TWIN].free.tcp)
    assert [m.motion for m in found.judgement.motions] == ["motion3", "motion8", "press1"]
    assert not set(found.fitted) & {m.motion for m in found.judgement.motions}
    assert found.held_out.twin.tcp == mean[FITTED].free.tcp


def test_once_judged_the_twin_is_fitted_to_all_motions(found, logs):
    """It says so, has seen more than the fit that was judged, and is not that one."""
    assert REFITTED in found.notes
    fitted = sum(log.time[-1] - log.time[0] for log in logs if log.label in found.fitted)
    few = replace(QUICK, coarse_seconds=8.0, fit_seconds=1e4, far_seconds=8.0, hold_out=("motion3",))
    held = identify_logs(ARM, logs[:4], few)
    assert held.fit_seconds > 72.0 < fitted
    assert REFITTED in held.notes


def test_the_structure_is_that_of_the_truth(found):
    assert found.parameters.ramp_speed > 20.0
    assert (found.parameters.torque_limit > 2.0).all()
    assert not found.identified[vector_names(ARM.joint_names).index("ramp_speed")]
    assert found.parameters.delay == pytest.approx(float(TRUTH.delay), abs=0.004)


def test_the_table_is_found_and_contacts_predicted(found, logs):
    table = found.table
    press = logs[-1]
    tip = tcp_position(ARM, press.position)
    low = tip[tip[:, 2] < np.quantile(tip[:, 2], 0.2)]
    assert np.abs(surface(table, low) - surface(TABLE, low)).max() < 0.004
    contact = found.judgement.motions[-1].errors[FITTED].contact
    assert contact.tcp < 0.003
    assert contact.tcp < 0.2 * found.judgement.motions[-1].errors[NO_TWIN].contact.tcp


def test_a_twin_with_a_table_survives_its_file(found, tmp_path):
    found.save(tmp_path / "twin.toml")
    back = read_twin(tmp_path / "twin.toml", ARM)
    assert back.table == found.table
    assert back.digest() == found.digest()
    assert replace(back, table=None).digest() != back.digest()
    assert back.acceleration == found.acceleration == np.inf
    limited = replace(back, acceleration=39.0)
    assert limited.digest() != back.digest()
    limited.save(tmp_path / "limited.toml")
    assert read_twin(tmp_path / "limited.toml", ARM).acceleration == 39.0


def test_what_is_known_of_the_servos_holds_where_the_logs_do_not_tell():
    """An arm that stands still shows no limit of its acceleration; one that moves may show that there is none."""
    assert pytest.approx(38.963, abs=1e-3) == ARM.servo_acceleration  # 254 * 100 counts of a 4096th turn
    time, moving = wandering(0, 8.0)
    still = [record(f"still{k}", time, np.tile(moving[k : k + 1], (len(time), 1))) for k in (0, 200)]
    for logs, found in ((still, {39.0: 39.0, np.inf: np.inf}), ([record("moving", time, moving)], {39.0: np.inf})):
        problem = partial(problem_of, windows=cut(logs, 8.0))
        for known, expected in found.items():
            simple = Structure(belief=unknown_prior(ARM), acceleration=known)
            truth = replace(TRUTH, delay=TRUTH.delay - (EARLIER if known < np.inf else 0.0))
            start = np.clip(pack(truth), simple.prior.lower, simple.prior.upper)
            assert find_acceleration(problem, simple, start).acceleration == expected


def test_a_slow_acceleration_is_found_although_damping_stands_in_for_it():
    logs = [record(f"slow{k}", *wandering(k, 12.0), acceleration=4.0) for k in range(2)]
    problem = partial(problem_of, windows=cut(logs, 8.0))
    usual = Structure(belief=unknown_prior(ARM), acceleration=39.0)
    found = find_acceleration(problem, usual, rough_fit(problem(usual)))
    assert found.acceleration == pytest.approx(4.0, rel=0.15)


def test_threads_do_not_change_what_is_found(logs, monkeypatch):
    few = LogSettings(coarse_seconds=8.0, fit_seconds=8.0, far_seconds=8.0, contact_seconds=8.0, hold_out=("press1",))
    chosen = [replace(logs[i], extra={UNPOWERED: ARM.joint_names[3]}) for i in (0, 1, 9, 10)]
    monkeypatch.setattr(identify, "IDENTIFIED", 2.0)
    two = identify_logs(ARM, chosen, few)
    monkeypatch.setattr(replay, "THREADS", 1)
    one = identify_logs(ARM, chosen, few)
    assert one.digest() == two.digest()
    assert one.table == two.table
    # one is declared without power, and all priors together tell the scale of the other as well as the motion does
    assert one.unknown_scale == ARM.joint_names[3:]


@pytest.mark.parametrize("early", [0, 1])
def test_a_delay_below_zero_needs_evidence(early):
    arm = replace(ARM, name="stranger")
    stiff = replace(TRUTH, stiffness=10.0 * TRUTH.stiffness, damping=10.0 * TRUTH.damping, delay=0.0)
    log = record("one", *wandering(0, 30.0), stiff)
    log = replace(log, arm=arm.name, position=np.roll(log.position, -early, axis=0))
    found = Motions(arm, [log], LogSettings()).find_structure()[1]
    assert (unpack(found).delay < 0.0) == bool(early)


def test_gravity_fed_forward_is_no_stiffness_and_an_unpowered_joint_is_replayed_where_it_was():
    stranger = replace(ARM, name="stranger")
    logs = []
    for k in range(4):
        time, command = wandering(k, 14.0)
        fed = record(f"m{k}", time, command + gravity_torque(ARM, command) / TRUTH.stiffness)
        position = fed.position.copy()
        position[:, 4] = position[0, 4]
        logs.append(replace(fed, arm=stranger.name, command=command, position=position))
    found = identify_logs(stranger, logs, LogSettings(coarse_seconds=8.0, fit_seconds=15.0, far_seconds=5.0))
    told = dict(zip(found.names, found.identified, strict=True))
    assert f"never answers: {ARM.joint_names[4]}" in " ".join(found.notes)
    assert not any(known for name, known in told.items() if name.startswith(("stiffness", "damping", "coulomb")))
    assert {*found.unknown["compensation"]} >= {*ARM.joint_names[:4]}
    low, high = found.interval
    assert ((low.stiffness < TRUTH.stiffness) & (TRUTH.stiffness < high.stiffness))[:4].all()
    assert (found.parameters.compensation[1:3] > 0.0).all()
    assert HEALTHY not in found.judgement.mean
    assert found.judgement.mean[FITTED].free.tcp < 0.3 * found.judgement.mean[NO_TWIN].free.tcp
    assert found.judgement.doubts == ()  # what moves as predicted is trusted, though no torque is known


@pytest.mark.parametrize("freedom", [1.0, np.inf])
def test_motion_in_which_a_joint_had_no_power_counts_for_the_others_alone(freedom):
    log = record("one", *wandering(0, 20.0))
    limp = replace(log, extra={UNPOWERED: ARM.joint_names[1]})

    def weights(*logs):
        problem = Problem(Replay(ARM, cut(logs, 5.0)), unknown_prior(ARM), freedom=freedom)
        return problem.weights(problem.powered * np.random.default_rng(0).normal(0.0, 0.01, problem.measured.shape))

    np.testing.assert_allclose(weights(log, limp)[: len(log) - 1, 1], weights(log)[: len(log) - 1, 1])


def test_the_end_that_is_held_out_moves():
    time, command = wandering(0, 20.0)
    time, command = np.arange(3 * len(time)) * PERIOD, np.pad(command, ((0, 2 * len(time)), (0, 0)), mode="edge")
    seen, (end,) = part(ARM, [RunLog.of(time, command, command, arm=ARM.name, label="rests")])
    assert sum(map(len, seen)) + len(end) == len(time)
    assert 10.0 < end.time[0] < 18.0


def test_what_repeats_a_motion_that_is_held_out_is_not_fitted():
    def program(label, seeds, cycles=1, seconds=12.0):
        command = np.concatenate([wandering(seed, seconds)[1] for seed in (*seeds,) * cycles])
        time = np.arange(len(command)) * PERIOD
        return RunLog.of(time, command, command + 1e-3 * len(label), arm=ARM.name, label=label)

    seen, unseen = part(ARM, [program("ten cycles", [0], 10)])
    assert np.concatenate(repeated(unseen, seen)).mean() < 0.2
    assert sum(map(len, seen)) > 0.5 * 10 * 600
    seen, unseen = part(ARM, [program("short cycles", [0], 10, 2.4)])  # an end that is no cycle would seem new
    assert np.concatenate(repeated(unseen, seen)).mean() > 0.9
    again, new = repeated([program("again", [0]), program("new", [1])], [program("ten cycles", [0], 10)])
    assert again.mean() > 0.9
    assert not new.any()
    motions = [program(f"{way} {k}", [k]) for k in range(4) for way in ("there", "once more")]
    seen, unseen = part(ARM, motions)
    assert {log.label[-1] for log in seen}.isdisjoint(log.label[-1] for log in unseen)
    assert seen
