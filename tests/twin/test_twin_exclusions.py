"""Contacts, stops and dead readings, put into logs on purpose."""

from dataclasses import replace

import numpy as np
import pytest
from motion_logs import ARM, TABLE, as_log, pressing, record, wandering

from rejoint.arms import tcp_position
from rejoint.logs.columns import ZEROS
from rejoint.logs.exclusions import MARGIN, RECOVERY, find_exclusions, table_height
from rejoint.twin.replay import cut_windows


@pytest.fixture(scope="module")
def touching():
    return record("press", *pressing(), table=TABLE)


@pytest.fixture(scope="module")
def free():
    return record("free", *wandering(0, 24.0))


def test_without_contact_there_is_no_table(free):
    assert table_height(ARM, [free]) is None
    assert find_exclusions(ARM, [free])[0].free.all()


def test_only_a_tip_of_known_height_in_several_places_tells_a_table(touching):
    assert table_height(ARM, [touching]) == pytest.approx(TABLE.height, abs=0.006)
    assert table_height(ARM, [replace(touching, extra={ZEROS: "unknown"})]) is None
    time, command = pressing()
    command[:, 0] = 0.0
    assert table_height(ARM, [record("one place", time, command, table=TABLE)]) is None


def test_contact_rows_and_the_seconds_after_are_masked(touching):
    rows = find_exclusions(ARM, [touching], TABLE.height)[0]
    tip = tcp_position(ARM, touching.position)[:, 2]
    low = tip < TABLE.height + MARGIN
    assert rows.contact[low].all()
    last = np.flatnonzero(low)[-1]
    after = (touching.time > touching.time[last]) & (touching.time <= touching.time[last] + RECOVERY)
    assert rows.contact[after].all()
    far = touching.time > touching.time[last] + RECOVERY + 0.1
    assert far.any()
    assert not rows.contact[far].any()
    assert rows.readable.all()


def test_a_joint_at_a_stop_is_found(free):
    position = free.position.copy()
    stop = np.quantile(free.command[:, 4], 0.3)
    position[:, 4] = np.maximum(free.position[:, 4], stop + 0.15)
    blocked = as_log("blocked", free.time, position, free.command)
    rows = find_exclusions(ARM, [blocked])[0]
    error = position[:, 4] - free.command[:, 4]
    assert rows.stop[(error > np.radians(12)) & (position[:, 4] <= stop + 0.151)].mean() > 0.9
    assert not rows.stop.all()
    assert not rows.contact.any()
    assert not rows.stale.any()


def test_dead_readings_are_found(free):
    position = free.position.copy()
    position[300:420] = position[300]
    rows = find_exclusions(ARM, [as_log("dead", free.time, position, free.command)])[0]
    assert rows.stale[302:420].all()
    assert not rows.stale[:300].any()
    assert not rows.stale[420 + round(RECOVERY / 0.02) + 2 :].any()


def test_windows_hold_free_rows_only_and_contacts_apart(touching, free):
    logs = [touching, free]
    rows = find_exclusions(ARM, logs, TABLE.height)
    windows = cut_windows(rows, 4.0)
    for w in windows:
        assert rows[logs.index(w.log)].free[w.first : w.last].all()
        assert w.log.time[w.last - 1] - w.log.time[w.first] < 4.3
    covered = np.zeros(len(free), dtype=int)
    for w in windows:
        if w.log is free:
            covered[w.first : w.last] += 1
    np.testing.assert_array_equal(covered, rows[1].free)
    assert {w.log for w in windows} == {*logs}
    contacts = np.concatenate([np.arange(w.first, w.last) for w in cut_windows(rows, 4.0, contact=True)])
    assert {w.log for w in cut_windows(rows, 4.0, contact=True)} == {touching}
    assert set(np.flatnonzero(rows[0].contact)) <= set(contacts)
