"""The check of an emulated arm, from motion to rows; one of them is driven for the whole file."""

import logging
from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
import pytest

import rejoint
from rejoint.arms import gravity_torque, load_arm, tcp_position
from rejoint.arms.workspace import is_safe
from rejoint.diagnosis.monitoring.measures import CYCLES, POSES, measure_check, plan_check, record_check
from rejoint.diagnosis.segments import attach_segments
from rejoint.logs.history import SUMMARY, find_rows, read_rows, write_rows
from rejoint.logs.journal import Journal
from rejoint.logs.runlog import RunLog
from rejoint.runs.stages import check as stage
from rejoint.system.errors import InputError
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear

ARM = load_arm("mycobot280")
BEGIN = datetime(2027, 1, 1)


@pytest.fixture(scope="module")
def checked(tmp_path_factory):
    home = tmp_path_factory.mktemp("history")
    found = rejoint.check(
        "emulated:healthy?hours=5", history=home, tolerance_mm=6.0, notes=rejoint.CheckNotes(when=BEGIN)
    )
    return found, home


@pytest.mark.parametrize("arm", [load_arm("mycobot280"), load_arm("so101")], ids=lambda arm: arm.name)
def test_the_routine_is_short_safe_and_always_the_same(arm):
    plan, again = plan_check(arm), plan_check(arm)
    assert (plan.position == again.position).all()
    assert 100.0 < plan.duration < 180.0
    time = np.arange(0.0, plan.duration, 0.1)
    command = plan.command(time)
    assert is_safe(arm, command).all()
    sagging = RunLog.of(time, command, command - gravity_torque(arm, command) / 9.0, arm=arm)
    found = measure_check(arm, attach_segments(sagging, plan.segments, np.zeros((0, 2))), None)
    assert min(row.sag_mm or 1.0 for row in found.joints) > 0.0
    poses = [segment for segment in plan.segments if segment.kind == "pose"]
    assert len(poses) == POSES * 2 * CYCLES
    swept = {joint for segment in plan.segments if segment.kind == "sweep" for joint in segment.joints}
    assert swept == set(range(arm.joints))


def test_measures_of_a_motion_made_by_hand():
    """Joint 2 lags by 1 deg under way, stops half of that short from both sides, and hangs 2 deg low."""
    plan = plan_check(ARM)
    time = np.arange(0.0, plan.duration, 0.02)
    command = plan.command(time)
    moving = np.sign(np.round(np.gradient(command[:, 1], time), 6))
    at_rest = [0.0]
    for sign in moving[1:]:
        at_rest.append(sign or at_rest[-1])
    position = command.copy()
    position[:, 1] -= np.radians(2.0) + np.radians(np.where(moving != 0, 1.0, 0.5)) * np.array(at_rest)
    log = RunLog.of(time, command, position, arm=ARM)
    found = measure_check(ARM, attach_segments(log, plan.segments, np.zeros((0, 2))), np.full(ARM.joints, 30.0))
    row = found.joints[1]
    lever = row.lever_mm
    assert row.hysteresis_mm == pytest.approx(np.radians(2.0) * lever, rel=1e-6)
    assert row.reversal_mm == pytest.approx(np.radians(1.0) * lever, rel=0.02)  # a row of the next travel is in it
    assert row.deviation_mm == pytest.approx(np.radians(2.0) * lever, rel=0.02)
    assert found.joints[0].hysteresis_mm == pytest.approx(0.0, abs=1e-9)
    assert found.repeatability_mm < 0.1
    stop = plan.position[np.searchsorted(plan.time, [s.start for s in plan.segments if s.kind == "pose"][:10])]
    away = stop.copy()
    away[:, 1] -= np.radians(2.0) + np.radians(0.5) * np.tile([1.0, -1.0], 5)
    off = 1e3 * np.linalg.norm(tcp_position(ARM, away) - tcp_position(ARM, stop), axis=1)
    assert found.error_mm == pytest.approx(off.mean(), rel=0.02)
    assert found.true_error_mm is None
    assert found.temperature_c == 30.0


def test_a_check_leaves_its_log_and_its_rows(checked):
    found, home = checked
    rows, unread = find_rows(home)
    assert unread == ()
    assert [row.joint for row in rows] == ["", *ARM.joint_names]
    tool = rows[0]
    assert (tool.time, tool.kind, tool.used_h, tool.tolerance_mm) == (BEGIN, "check", 5.0, 6.0)
    assert tool.line == found.line
    assert tool.state == "learning"
    assert tool.error_mm == found.measures.error_mm
    assert tool.true_error_mm > tool.error_mm == found.outlook.error_mm
    log = RunLog.load(found.folder / "check.parquet")
    again = measure_check(ARM, log, None)
    assert again.error_mm == found.measures.error_mm
    assert 100.0 < log.time[-1] - log.time[0] < 180.0


def test_guarded_and_in_batches_bit_for_bit(checked):
    """An arm in a batch does what it does alone, and neither a healthy nor a worn one trips the guard."""
    wears = [load_wear(name, ARM) for name in ("healthy?hours=5", "worn")]
    robot = EmulatedRobot(ARM, wears)
    (log, warm), (worn, _) = record_check(robot)
    alone = RunLog.load(checked[0].folder / "check.parquet")
    assert (log.position == alone.position).all()
    assert warm is not None
    assert measure_check(ARM, worn, None).error_mm > 4 * measure_check(ARM, log, None).error_mm


@pytest.fixture
def stood_in(checked, monkeypatch):
    """Let checks take the log of the one that was driven: what is tried here is what becomes of it."""
    log = RunLog.load(checked[0].folder / "check.parquet")
    monkeypatch.setattr(stage, "record_check", lambda *_, **__: [(log, np.full(ARM.joints, 25.0))])


@pytest.mark.parametrize("since", [0.0, 60.0])
def test_a_joint_whose_reading_stands_is_told_and_does_not_count(since, checked, tmp_path, monkeypatch):
    """A dead encoder: the servo still follows, and all that is measured of its joint would be zero."""
    log = RunLog.load(checked[0].folder / "check.parquet")
    position = log.position.copy()
    dead = log.time - log.time[0] >= since
    position[dead, 1] = position[dead, 1][0]
    monkeypatch.setattr(stage, "record_check", lambda *_, **__: [(replace(log, position=position), None)])
    with pytest.raises(rejoint.RobotError, match="joint2 did not follow"):
        rejoint.check("emulated:healthy", history=tmp_path, notes=rejoint.CheckNotes(when=BEGIN))
    assert not list(tmp_path.rglob(SUMMARY)), "it is no norm for later checks"


@pytest.mark.usefixtures("stood_in")
def test_a_history_grows_and_begins_anew(tmp_path):
    def once(month, *, moved=False, **options):
        notes = rejoint.CheckNotes(when=BEGIN + timedelta(days=30 * month), moved=moved)
        return rejoint.check("emulated:healthy", history=tmp_path, notes=notes, **options)

    counts = [once(month, tolerance_mm=6.0 if month == 0 else None).outlook.checks for month in range(7)]
    assert counts == [1, 2, 3, 4, 5, 6, 7]
    assert once(7).outlook.state == "steady"
    assert once(8).outlook.tolerance_mm == 6.0  # as the owner said before
    assert once(9, moved=True).outlook.checks == 1
    assert once(10).outlook.checks == 2
    repaired = replace(find_rows(tmp_path)[0][0], kind="repair", time=BEGIN + timedelta(days=315), settled_mm=0.5)
    write_rows(tmp_path / "run" / SUMMARY, [repaired])
    with pytest.raises(InputError, match="later date"):
        once(10.3)
    assert once(11).outlook.checks == 1
    other = replace(ARM, mass=1.1 * ARM.mass)
    changed = once(12, arm=other)
    assert changed.outlook.checks == 1
    assert read_rows(changed.folder / SUMMARY)[0].norm == "set up"
    assert changed.line.startswith("A new norm begins, as the arm is described otherwise")
    with pytest.raises(InputError, match=r"later date.*delete"):
        once(3)


@pytest.mark.usefixtures("stood_in")
def test_what_a_killed_check_recorded_is_kept_by_the_next_one(tmp_path, caplog):
    log = tmp_path / "checks" / "mine" / "1" / "check.parquet"
    journal = Journal(log, ARM, "emulated:healthy", "check")
    for number in range(50):
        journal.append(float(number), *(np.zeros(size) for size in (ARM.joints, ARM.joints, 3, 3)))
    journal.close()
    with caplog.at_level(logging.WARNING, logger="rejoint"):
        rejoint.check("emulated:healthy", name="mine", history=tmp_path, notes=rejoint.CheckNotes(when=BEGIN))
    kept = log.parent / "check-cut-short.parquet"
    assert [record.getMessage().rpartition(": ")[2] for record in caplog.records] == [str(kept)]
    assert len(RunLog.load(kept).time) == 50
    assert not log.exists()
    assert len(find_rows(tmp_path)[0]) == 1 + ARM.joints


@pytest.mark.usefixtures("stood_in")
def test_the_command_tells_cron_by_its_exit_code(tmp_path, cli):
    words = "check", "emulated:healthy", "--history", tmp_path, "--json", "--prometheus", tmp_path / "a.prom"
    done = cli(*words, "--date", "2027-01-01", "--repeat", "6", "--tolerance", "50")
    assert done.last["outlook"]["state"] == "steady"
    assert 'rejoint_state{arm="mycobot280-emulated-healthy",state="steady"} 1' in (tmp_path / "a.prom").read_text()
    assert "which is reached" in cli(*words, "--date", "2027-02-01", "--tolerance", "1", code=7).out
    assert "tolerance reached" in cli("history", tmp_path, "--json").out
    assert (tmp_path / "history.html").exists()
