"""Rows that runs and checks leave: written by many at once, read in place, damaged one by one."""

from dataclasses import replace
from datetime import datetime, timedelta

import pytest

from rejoint.diagnosis.monitoring.judge import Change, Due, Outlook, PastCheck, outlook, say
from rejoint.diagnosis.monitoring.measures import CheckMeasures, JointCheck
from rejoint.logs.history import SUMMARY, HistoryRow, find_rows, name_of, read_rows, write_rows
from rejoint.runs.history import arms_of, cells, past_of, prometheus_text, rows_of, write_history
from rejoint.system.errors import FileError

BEGIN = datetime(2027, 1, 1)
JOINTS = ("shoulder", "elbow")


def measures(error=3.0, hysteresis=2.0):
    joints = tuple(
        JointCheck(
            joint=name,
            hysteresis_mm=hysteresis,
            reversal_mm=0.4,
            deviation_mm=1.0,
            sag_mm=None,
            lever_mm=200.0,
            temperature_c=25.0,
        )
        for name in JOINTS
    )
    return CheckMeasures(
        joints=joints,
        error_mm=error,
        repeatability_mm=0.2,
        approach_mm=0.9,
        true_error_mm=None,
        temperature_c=25.0,
    )


def head(month=0.0, arm="a1", **values):
    return replace(
        HistoryRow(
            time=BEGIN + timedelta(days=30 * month),
            kind="check",
            arm=arm,
            robot="tcp://10.0.0.1:9000",
            model="mycobot280",
            setup="same",
        ),
        **values,
    )


def checked(row):
    """Rows of a check, as `rejoint check` writes them."""
    return rows_of(row, measures(), outlook([PastCheck(time=row.time, measures=measures())]), row.line)


def put(folder, name, rows):
    write_rows(folder / name / SUMMARY, rows)
    return folder / name / SUMMARY


def test_rows_come_back_as_they_were(tmp_path):
    row = replace(head(), due=BEGIN, used_h=3.5, line='shoulder: 1 mm; "so"', temperature_c=None)
    path = put(tmp_path, "x", checked(row))
    assert read_rows(path) == checked(row)


def test_a_damaged_file_loses_only_itself(tmp_path):
    paths = [put(tmp_path, str(i), checked(head(i))) for i in range(4)]
    paths[1].write_bytes(paths[1].read_bytes()[:-40])
    data = bytearray(paths[2].read_bytes())
    data[len(data) // 3] ^= 0xFF
    paths[2].write_bytes(data)
    (tmp_path / "3" / f".{SUMMARY}.partial").write_bytes(b"half")
    (tmp_path / "gone").mkdir()
    (tmp_path / "gone" / SUMMARY).symlink_to(tmp_path / "nothing")
    rows, unread = find_rows(tmp_path)
    assert {row.time for row in rows if not row.joint} >= {BEGIN, BEGIN + timedelta(days=90)}
    assert len(unread) >= 1
    assert any(str(paths[1]) in problem for problem in unread)
    with pytest.raises(FileError, match="delete it"):
        read_rows(paths[1])


@pytest.mark.parametrize(
    ("rows", "count"),
    [
        ([head(0), head(1), head(2)], 3),
        ([head(0), head(1), head(2, norm="moved"), head(3)], 2),
        ([head(0), head(1), head(1.5, kind="repair", arm="mycobot280-tcp-10.0.0.1-9000"), head(2)], 1),
        ([head(0), head(1), head(1.5, kind="run"), head(2)], 3),
        ([head(0), head(1, arm="a2"), head(2)], 2),
    ],
)
def test_a_repair_or_a_moved_arm_begin_a_new_norm(rows, count):
    every = [row for one in rows for row in (checked(one) if one.kind == "check" else [one])]
    past = past_of(every, "a1")
    assert len(past.visits) == count
    assert past.setup == "same"
    assert past.visits[-1].measures == measures()


def test_a_repair_is_of_the_arm_that_it_names_else_of_the_only_one_at_its_address(tmp_path):
    """Arms are plugged into one port one after the other; the history shows each with its own repair."""
    key, line = name_of("tcp://10.0.0.1:9000", "mycobot280"), "It is soft. Do: rejoint check a1 --repeat 5"
    repair = head(2.5, kind="repair", settled_mm=0.5, error_mm=30.0, state="bad", line=line)
    checks = [row for month in range(5) for row in checked(head(month, arm=f"a{2 - month % 2}"))]
    rows, unnamed = [*checks, repair], replace(repair, arm=key)
    mine, other = past_of(rows, "a1"), past_of(rows, "a2")
    assert (len(mine.visits), mine.left_mm) == (1, 0.5)
    assert (len(other.visits), other.left_mm) == (3, None)
    assert [past_of([*checks, unnamed], arm).left_mm for arm in ("a1", "a2", key)] == [None, None, 0.5]
    assert past_of([unnamed, head(3), head(4, arm="a2")], "a1").left_mm == 0.5
    assert {arm.name: len(arm.rows) for arm in arms_of(rows)} == {"a1": 3, "a2": 3}
    told = arms_of([row for row in rows if row.time <= repair.time])
    shown = {arm.name: cells(arm) for arm in told}
    assert shown["a1"][1:3] == ["repaired", "0.5 by encoders"]
    assert not head(error_mm=2.0, true_error_mm=4.0, tolerance_mm=3.0).over  # a check judges by the encoders
    assert shown["a1"][-1] == "rejoint check a1 --repeat 5"
    write_history(tmp_path / "told.html", told)
    assert "<p>Nothing urgent on 2 arms.</p>" in (tmp_path / "told.html").read_text()


def history_of(hysteresis, tolerance=None):
    return judged(*(measures(1.0 + value, value) for value in hysteresis), tolerance=tolerance, days=30)


def test_the_line_says_cause_millimetres_date_and_what_to_do():
    assert "5 are needed" in say(history_of([2.0] * 3), "R")
    worn = history_of([2.0] * 7 + [2.2, 2.4, 2.6, 2.8, 3.0], 6.0)
    assert worn.state == "alarm"
    line = say(worn, "rejoint repair tcp://10.0.0.1:9000")
    for told in ("shoulder: ", "2.0 -> 3.0 mm since 2027-06-30", "also elbow", "tolerance 6.0 mm, reached "):
        assert told in line
    assert "Do: rejoint repair tcp://10.0.0.1:9000" in line
    assert say(history_of([2.0] * 3, 2.5), "R").endswith("reached. Do: R")


def judged(*checks, tolerance=None, left=None, days=182):
    past = [PastCheck(time=BEGIN + timedelta(days=days * i), measures=one) for i, one in enumerate(checks)]
    return outlook(past, tolerance, left_mm=left)


def test_a_repaired_arm_is_held_against_what_its_repair_left():
    """It is bad without a controller, before and after; its owner bears what is left with it."""
    bare = [measures(30.0) for _ in range(6)]
    assert judged(*bare, tolerance=3.0).over
    kept = judged(*bare, tolerance=3.0, left=1.0)
    assert not kept.over
    assert kept.controlled_mm == 1.0
    grown = judged(*bare, *(measures(30.0 + 0.4 * n) for n in range(1, 5)), tolerance=3.0, left=1.0)
    assert grown.controlled_mm == pytest.approx(2.6)
    assert grown.due is not None
    assert judged(*bare, measures(32.1), tolerance=3.0, left=1.0).over


def test_prometheus_reads_every_line():
    change = Change(joint='el"bow', quantity="sag", state="alarm", usual_mm=1, now_mm=2, since=None, cusum=6.5)
    seen = Outlook(
        state="alarm",
        checks=9,
        since=BEGIN,
        newest=BEGIN,
        changes=(change,),
        error_mm=2.5,
        tolerance_mm=3.0,
        due=Due(early=BEGIN, middle=None, late=None),
    )
    text = prometheus_text("a7", seen, measures())
    samples = [line for line in text.splitlines() if not line.startswith("#")]
    assert 'rejoint_error_mm{arm="a7",by="encoders"} 2.5' in samples
    assert 'rejoint_state{arm="a7",state="alarm"} 1' in samples
    assert 'rejoint_cusum{arm="a7",joint="el\\"bow",quantity="sag"} 6.5' in samples
    assert (
        f'rejoint_due_seconds{{arm="a7",end="early"}} {(BEGIN - datetime(1970, 1, 1)).total_seconds():.0f}' in samples
    )
    assert text.endswith("\n")
    assert len({line.split(" ")[2] for line in text.splitlines() if line.startswith("# TYPE")}) == 8
