"""Rows that runs and checks leave: written by many at once, read in place, damaged one by one."""

import math
import os
import signal
import threading
import time
from dataclasses import asdict, replace
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rejoint.arms import load_arm
from rejoint.diagnosis.monitoring.judge import Change, Due, Outlook, PastCheck, outlook
from rejoint.diagnosis.monitoring.measures import CheckMeasures, JointCheck
from rejoint.diagnosis.monitoring.words import cause_of, say
from rejoint.logs.history import index
from rejoint.logs.history.identity import hours_of, name_of
from rejoint.logs.history.index import INDEX, find_rows
from rejoint.logs.history.rows import SCHEMA, SUMMARY, HistoryRow, read_rows, utc_now, write_rows
from rejoint.logs.history.sql import ask
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.runs.history import summary
from rejoint.runs.history.checks import past_of, rows_of
from rejoint.runs.history.page import history_page, write_history
from rejoint.runs.history.prometheus import prometheus_text
from rejoint.runs.history.table import arms_of, cells
from rejoint.system.errors import FileError, InputError

BEGIN = datetime(2027, 1, 1)
JOINTS = ("shoulder", "elbow")


def measures(error: float = 3.0, hysteresis: float = 2.0, temperature: float | None = 25.0) -> CheckMeasures:
    joints = tuple(
        JointCheck(
            joint=name, hysteresis_mm=hysteresis, reversal_mm=0.4, deviation_mm=1.0, sag_mm=None, lever_mm=200.0,
            temperature_c=temperature,
        )
        for name in JOINTS
    )  # fmt: skip
    return CheckMeasures(
        joints=joints, error_mm=error, repeatability_mm=0.2, approach_mm=0.9, true_error_mm=None,
        true_approach_mm=None, temperature_c=temperature,
    )  # fmt: skip


def head(month: float = 0.0, arm: str = "a1", **values: object) -> HistoryRow:
    return replace(
        HistoryRow(time=BEGIN + timedelta(days=30 * month), kind="check", arm=arm, robot="tcp://10.0.0.1:9000",
                   model="mycobot280", setup="same"), **values)  # fmt: skip


def put(folder: Path, name: str, rows: list[HistoryRow]) -> Path:
    write_rows(folder / name / SUMMARY, rows)
    return folder / name / SUMMARY


def test_rows_come_back_as_they_were(tmp_path: Path) -> None:
    row = replace(head(), due=BEGIN, used_h=3.5, line='shoulder: 1 mm; "so"', temperature_c=None)
    path = put(tmp_path, "x", rows_of(row, measures()))
    assert read_rows(path) == rows_of(row, measures())


def test_a_damaged_file_loses_only_itself(tmp_path: Path) -> None:
    paths = [put(tmp_path, str(i), rows_of(head(i), measures())) for i in range(4)]
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


def strange(name: str, value: object, kind: pa.DataType) -> pa.Table:
    """Rows of which one column holds something that none of ours does."""
    table = pa.Table.from_pylist([asdict(head(3))], schema=SCHEMA).replace_schema_metadata({b"rejoint.history": b"1"})
    return table.set_column(table.column_names.index(name), name, pa.array([value], kind))


TIME = pa.timestamp("us")


@pytest.mark.parametrize(
    ("table", "told"),
    [
        (strange("time", None, TIME), "rows without time"),
        (strange("arm", None, pa.string()), "rows without arm"),
        (strange("time", 2**62, TIME), "time is no date"),
        (strange("due_late", -(2**62), TIME), "due_late is no date"),
        (strange("error_mm", "x", pa.string()), "damaged"),
        (strange("time", BEGIN, TIME).append_column("time", pa.array([BEGIN], TIME)), "damaged"),
        (pa.table({"a": [1]}), "holds no summary rows"),
        (strange("arm", "a9", pa.string()).replace_schema_metadata({b"rejoint.history": b"2"}), "update rejoint"),
    ],
)
def test_rows_of_somebody_else_are_left_out_and_told(tmp_path: Path, table: pa.Table, told: str) -> None:
    put(tmp_path, "checks/a1/0", rows_of(head(0), measures()))
    (tmp_path / "checks" / "a1" / "1").mkdir()
    pq.write_table(table, tmp_path / "checks" / "a1" / "1" / SUMMARY)
    (tmp_path / "loop").mkdir()
    (tmp_path / "loop" / SUMMARY).symlink_to(tmp_path / "loop" / SUMMARY)
    for arm in (None, "a1"):
        rows, unread = find_rows(tmp_path, arm)
        assert rows == rows_of(head(0), measures())
        (problem,) = unread
        assert told in problem
    write_history(tmp_path / "history.html", arms_of(rows))


def test_many_write_at_once(tmp_path: Path) -> None:
    """Several writers and a reader: every row is there at the end, and none is ever half there."""
    problems: list[tuple[str, ...]] = []

    def write(writer: int) -> None:
        for i in range(15):
            put(tmp_path, f"{writer}-{i}", rows_of(head(i, arm=f"a{writer}"), measures()))

    threads = [threading.Thread(target=write, args=(writer,)) for writer in range(4)]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        problems.append(find_rows(tmp_path)[1])
        time.sleep(0.01)
    rows, unread = find_rows(tmp_path)
    assert not unread
    assert not any(problems)
    assert len(rows) == 4 * 15 * 3


def test_a_folder_that_goes_while_it_is_looked_for_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("stays", "goes"):
        put(tmp_path, name, rows_of(head(arm=name), measures()))
    scan = os.scandir

    def gone(place: str) -> object:
        if Path(place).name == "goes":
            raise FileNotFoundError(place)
        return scan(place)

    monkeypatch.setattr(os, "scandir", gone)
    rows, unread = find_rows(tmp_path)
    assert {row.arm for row in rows} == {"stays"}
    assert not unread


def test_rows_are_found_through_links_and_below_names_of_any_encoding_each_once(tmp_path: Path) -> None:
    """Checks on a larger disk began a new norm each time, and a folder called in Latin-1 ended every command."""
    place = tmp_path / "disk" / "checks"
    put(place, "a1/t", rows_of(head(), measures()))
    lab = tmp_path / "lab"
    lab.mkdir()
    (lab / "checks").symlink_to(place)
    (lab / "again").symlink_to(place / "a1")
    (place / "back").symlink_to(lab)
    for _ in range(2):  # read, and taken from the copy
        rows, unread = find_rows(lab)
        assert ([row.arm for row in rows if not row.joint], unread) == (["a1"], ())
    put(place, "a2/t", rows_of(head(1, arm="a2"), measures()))
    try:
        (place / "a2").rename(os.fsdecode(os.fsencode(place) + b"/a\xe4"))
    except OSError:
        pytest.skip("this file system knows no such name")
    for _ in range(2):
        rows, unread = find_rows(lab)
        assert [row.arm for row in rows if not row.joint] == ["a1"]
        assert [("a\\xe4" in one, one.isascii()) for one in unread] == [(True, True)]


def test_what_was_read_once_is_a_copy_and_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The copy follows files that come, change and go, and is made anew where it is damaged or missing."""
    paths = [put(tmp_path / "checks", f"a{i}/t", rows_of(head(i, arm=f"a{i}"), measures())) for i in range(3)]
    first = find_rows(tmp_path)
    assert find_rows(tmp_path) == first
    assert len(first[0]) == 9
    paths[0].unlink()
    write_rows(paths[1], rows_of(head(1, arm="a1"), measures(error=9.0)))
    put(tmp_path, "run", [head(5, arm="a9", kind="repair")])
    rows = find_rows(tmp_path)[0]
    assert {row.arm for row in rows} == {"a1", "a2", "a9"}
    assert [row.error_mm for row in rows if row.arm == "a1" and not row.joint] == [9.0]
    assert {row.arm for row in find_rows(tmp_path, "a2")[0]} == {"a2", "a9"}
    monkeypatch.setattr(index, "read_table", None)  # a check reads nothing anew either, where there is a copy
    assert len(find_rows(tmp_path, "a2")[0]) == 4
    monkeypatch.undo()
    for damage in (b"", b"PAR1", (tmp_path / INDEX).read_bytes()[:-9]):
        (tmp_path / INDEX).write_bytes(damage)
        assert find_rows(tmp_path)[0] == rows


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
def test_a_repair_or_a_moved_arm_begin_a_new_norm(rows: list[HistoryRow], count: int) -> None:
    every = [row for one in rows for row in (rows_of(one, measures()) if one.kind == "check" else [one])]
    past = past_of(every, "a1", name_of("tcp://10.0.0.1:9000", "mycobot280"))
    assert len(past.visits) == count
    assert past.setup == "same"
    assert past.visits[-1].measures == measures()


@pytest.mark.parametrize(
    ("where", "name"), [(0, "error_mm"), (0, "true_error_mm"), (1, "hysteresis_mm"), (2, "temperature_c")]
)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300])
def test_a_check_with_what_is_no_measurement_counts_for_nothing(where: int, name: str, value: float) -> None:
    """Not a number in a norm kept every later alarm back; what is too large ended the check in a bug."""
    rows = [row for month in range(3) for row in rows_of(head(month), measures())]
    rows[3 + where] = replace(rows[3 + where], **{name: value})
    assert [one.time for one in past_of(rows, "a1", "key").visits] == [head(0).time, head(2).time]


def test_a_repair_is_of_the_arm_that_was_checked_last_at_its_address() -> None:
    """Arms are plugged into one port one after the other; the history shows each with its own repair."""
    key = name_of("tcp://10.0.0.1:9000", "mycobot280")
    repair = head(2.5, kind="repair", arm=key, settled_mm=0.5, error_mm=30.0, state="bad")
    checks = [head(month, arm=arm) for month, arm in enumerate(("a1", "a2", "a1", "a2", "a1"))]
    rows = [row for one in checks for row in rows_of(one, measures())] + [repair]
    mine, other = past_of(rows, "a1", key), past_of(rows, "a2", key)
    assert (len(mine.visits), mine.left_mm) == (1, 0.5)
    assert (len(other.visits), other.left_mm) == (2, None)
    assert past_of([*rows, replace(repair, time=BEGIN)], "a3", key).left_mm is None
    assert past_of([repair], "a3", key).left_mm == 0.5
    assert {arm.name: len(arm.rows) for arm in arms_of(rows)} == {"a1": 4, "a2": 2}
    told = arms_of([row for row in rows if row.time <= repair.time])
    shown = {arm.name: cells(arm) for arm in told}
    assert shown["a1"][1:3] == ["repaired", "0.5 by encoders"]
    assert shown["a1"][-1].endswith("--repeat 5")
    assert history_page(told).verdict[0] == "Nothing to do on 2 arms."


def test_a_later_comparison_in_a_finished_run_is_no_new_repair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter(BEGIN + timedelta(days=100 * n) for n in range(3))
    monkeypatch.setattr(summary, "utc_now", lambda: next(times))
    monkeypatch.setattr(summary, "_compared", lambda arm, _: arm)
    run = SimpleNamespace(
        diagnosis=None, comparison="made", robot="tcp://10.0.0.1:9000", arm=load_arm("mycobot280"), path=tmp_path,
        folder=RunFolder(tmp_path),
    )  # fmt: skip
    told = []
    for finished in (False, True, True):
        if finished:
            run.folder.finished.write_text("{}")
        summary.summarise(run)
        (row,) = read_rows(tmp_path / SUMMARY)
        told.append((row.kind, row.time))
    repaired = BEGIN + timedelta(days=100)
    assert told == [("run", BEGIN), ("repair", repaired), ("repair", repaired)]


def test_joints_come_back_in_their_order_and_once(tmp_path: Path) -> None:
    """So that the joints of a new check meet their own, also in a folder that holds a copy of itself."""
    for month in range(2):
        for place in ("", "copy/"):
            put(tmp_path, f"{place}{month}", rows_of(head(month), measures()))
    past = past_of(find_rows(tmp_path)[0], "a1", "")
    assert [visit.measures for visit in past.visits] == [measures(), measures()]


def test_an_emulated_arm_stays_the_same_while_it_ages() -> None:
    names = {name_of(f"emulated:worn{query}", "mycobot280") for query in ("", "?hours=5", "?hours=70&ambient=30")}
    assert names == {"mycobot280-emulated-worn"}
    seeded = {name_of(f"emulated:worn?{query}", "m") for query in ("seed=3", "seed=3&hours=5", "hours=5&seed=3")}
    assert len({name.replace("&", "-") for name in seeded}) == 1
    assert hours_of("emulated:worn?seed=2&hours=12.5") == 12.5
    assert hours_of("tcp://hours=3") is None


def history_of(hysteresis: list[float], tolerance: float | None = None) -> Outlook:
    past = [
        PastCheck(time=BEGIN + timedelta(days=30 * i), measures=measures(3.0 + value - 2.0, value))
        for i, value in enumerate(hysteresis)
    ]
    return outlook(past, tolerance)


def test_the_line_says_cause_millimetres_date_and_what_to_do() -> None:
    assert "5 are needed" in say(history_of([2.0] * 3), "R")
    assert say(history_of([2.0] * 3), "R").endswith(
        "Do: check again, 3 more times; the first ones may follow each other at once."
    )
    assert say(history_of([2.0] * 3, 2.5), "R").endswith("which is reached. Do: rejoint repair R.")
    steady = say(history_of([2.0] * 12, 6.0), "R")
    assert steady.startswith("No change in 2 joints since 2027-01-01.")
    assert "no wear seen" in steady
    worn = history_of([2.0] * 7 + [2.2, 2.4, 2.6, 2.8, 3.0], 6.0)
    assert worn.state == "alarm"
    line = say(worn, "tcp://10.0.0.1:9000")
    assert line.startswith("shoulder: friction or weakness in slow motion 2.0 -> 3.0 mm since 2027-06-30 (alarm)")
    assert "also elbow" in line
    assert "tolerance 6.0 mm, reached " in line
    assert "Do: rejoint repair tcp://10.0.0.1:9000" in line
    assert "which is reached" in say(history_of([2.0] * 12, 2.5), "R")
    assert say(history_of([2.0] * 3, 2.5), "arm://1?a&b").endswith("Do: rejoint repair 'arm://1?a&b'.")


def test_a_single_odd_check_is_not_named_as_the_cause() -> None:
    """One joint drifts; another one was once far off, which adds up to more and is no drift."""
    past = []
    for i, drift in enumerate([2.0] * 8 + [2.03] * 5):
        seen = measures(3.0, drift)
        odd = replace(seen.joints[1], hysteresis_mm=2.0, reversal_mm=2.0 if i == 12 else 0.4)
        past.append(
            PastCheck(time=BEGIN + timedelta(days=30 * i), measures=replace(seen, joints=(seen.joints[0], odd)))
        )
    found = outlook(past)
    assert found.state == "drifting"
    assert abs(found.changes[0].cusum) < max(abs(one.cusum) for one in found.changes)
    assert cause_of(found).startswith("shoulder: friction")
    assert say(found, "R").startswith("shoulder: friction or weakness in slow motion")
    assert "also" not in say(found, "R")


def judged(*checks: CheckMeasures, tolerance: float | None = None, left: float | None = None) -> Outlook:
    past = [PastCheck(time=BEGIN + timedelta(days=182 * i), measures=one) for i, one in enumerate(checks)]
    return outlook(past, tolerance, left_mm=left)


def changed(**joints: dict[str, float]) -> CheckMeasures:
    seen = measures()
    rows = (replace(row, **joints.get(row.joint, {})) for row in seen.joints)
    return replace(seen, joints=tuple(rows))


def test_of_joints_that_wear_fast_the_one_that_wears_most_is_the_cause() -> None:
    """Checks are rare, and each is far off for both: so both have the same CUSUM."""
    worse = [
        changed(
            shoulder={"hysteresis_mm": 2.0 + 0.3 * n}, elbow={"hysteresis_mm": 2.0 + n, "deviation_mm": 1.0 + 3 * n}
        )
        for n in range(1, 4)
    ]
    found = judged(*[measures()] * 8, *worse)
    assert found.state == "alarm"
    assert len({one.cusum for one in found.changes if one.quantity == "hysteresis"}) == 1
    assert cause_of(found).startswith("elbow: friction or weakness in slow motion 2.0 -> 5.0 mm")
    assert say(found, "R").endswith("if it stays, change the servo of elbow.")


def test_what_got_better_is_no_wear() -> None:
    found = judged(*[changed(elbow={"hysteresis_mm": 8.0})] * 8, *[measures()] * 3)
    line = say(found, "R")
    assert line.startswith("elbow: friction or weakness in slow motion 8.0 -> 2.0 mm")
    assert "Do: look what was done to the servo of elbow, as it is better than it was" in line
    assert "--moved" in line
    assert "repair" not in line


def test_an_arm_that_was_over_from_the_beginning_has_no_servo_to_blame() -> None:
    assert say(judged(*[measures(9.0)] * 8, tolerance=6.0), "R").endswith("which is reached. Do: rejoint repair R.")


def test_a_date_that_is_near_is_heeded() -> None:
    grows = [measures(3.0 + 0.3 * n) for n in range(9)]
    past = [PastCheck(time=BEGIN + timedelta(days=7 * n), measures=one) for n, one in enumerate(grows)]
    found = replace(outlook(past, 5.6), state="steady")
    assert found.due is not None
    assert found.due.early - found.newest < timedelta(days=30)
    assert f"Do: nothing yet; check again by {found.due.early:%Y-%m-%d}" in say(found, "R")


def test_a_repaired_arm_is_held_against_what_its_repair_left() -> None:
    """It is bad without a controller, before and after; its owner bears what is left with it."""
    bare = [measures(30.0) for _ in range(6)]
    assert judged(*bare, tolerance=3.0).over
    kept = judged(*bare, tolerance=3.0, left=1.0)
    assert not kept.over
    assert kept.controlled_mm == 1.0
    assert "30.0 mm by the encoders without a controller, at most 1.0 mm with that of its repair" in say(kept, "R")
    grown = judged(*bare, *(measures(30.0 + 0.4 * n) for n in range(1, 5)), tolerance=3.0, left=1.0)
    assert grown.controlled_mm == pytest.approx(2.6)
    assert grown.due is not None
    assert judged(*bare, measures(32.1), tolerance=3.0, left=1.0).over


def test_hours_that_fall_are_not_counted() -> None:
    def due(hours: list[float | None]) -> Due | None:
        past = [
            PastCheck(time=BEGIN + timedelta(days=30 * i), measures=measures(3.0 + 0.2 * i), used_h=used)
            for i, used in enumerate(hours)
        ]
        return outlook(past, 6.0).due

    assert due([100.0, 20.0, *np.arange(110.0, 160.0, 10.0)]) == due([None] * 7) is not None


def many(folder: Path, arms: int, checks: int) -> None:
    """Histories of arms of which the last ones are the worst."""
    for a in range(arms):
        for c in range(checks):
            row = head(c, arm=f"arm-{a:03}", tolerance_mm=6.0, state="alarm" if a >= arms - 2 else "steady",
                       line=f"Something. Do: look at arm {a}.")  # fmt: skip
            put(folder, f"{a}-{c}", rows_of(row, measures(3.0 + 0.001 * a * c)))


def test_the_worst_arm_comes_first_in_table_and_page(tmp_path: Path) -> None:
    many(tmp_path, 5, 3)
    arms = arms_of(find_rows(tmp_path)[0])
    assert [arm.name for arm in arms][:2] == ["arm-004", "arm-003"]
    assert cells(arms[0])[1] == "alarm"
    assert cells(arms[0])[-1] == "look at arm 4."
    page = history_page(arms)
    assert page.verdict[0] == "2 of 5 arms need somebody."
    write_history(tmp_path / "history.html", arms)
    text = (tmp_path / "history.html").read_text(encoding="utf-8")
    assert text.count("<svg") == 5
    assert "http" not in text.replace("http-equiv", "")
    assert text.index("arm-004") < text.index("arm-000")


def test_rows_are_asked_in_sql_where_they_lie(tmp_path: Path) -> None:
    pytest.importorskip("duckdb")
    many(tmp_path, 3, 4)
    damaged = put(tmp_path, "damaged", rows_of(head(), measures()))
    damaged.write_bytes(b"PAR1")
    left_out: list[str] = []
    words = "select arm, count(*) n from history where joint = '' group by arm order by arm"
    names, rows = ask(tmp_path, words, left_out.append)
    assert [str(damaged) in one for one in left_out] == [True]
    assert names == ["arm", "n"]
    assert rows == [("arm-000", 4), ("arm-001", 4), ("arm-002", 4)]
    for query in ("select nothing from history", "", "-- nothing"):
        with pytest.raises(InputError, match="--sql"):
            ask(tmp_path, query)
    with pytest.raises(InputError, match="--sql"):
        ask(tmp_path, f"copy history to '{tmp_path}/out.csv'")
    with pytest.raises(FileError, match="rejoint check"):
        ask(tmp_path / "none", "select 1")


@pytest.mark.parametrize("zone", ["Pacific/Auckland", "America/Los_Angeles"])
def test_a_query_takes_now_in_utc_as_rows_are_wherever_it_is_asked(
    zone: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A check of just now lay half a day in the past or in the future."""
    pytest.importorskip("duckdb")
    put(tmp_path, "a1", rows_of(replace(head(), time=utc_now()), measures()))
    monkeypatch.setenv("TZ", zone)
    time.tzset()
    try:
        _, ((off,),) = ask(tmp_path, "select abs(epoch(now() - time)) from history limit 1")
    finally:
        monkeypatch.undo()
        time.tzset()
    assert off < 600.0


def test_an_answer_has_times_of_now_without_a_package_for_zones(tmp_path: Path) -> None:
    pytest.importorskip("duckdb")
    many(tmp_path, 1, 1)
    names, ((now, one, rows),) = ask(tmp_path, """select now() as "a""b", 1 as "a""b", count(*) from history""")
    assert (names, one, rows > 1) == (['a"b', 'a"b', "count_star()"], 1, True)
    assert now.tzinfo is None
    assert abs(now - utc_now()) < timedelta(minutes=10)


@pytest.mark.parametrize(
    "query",
    [
        "delete from history",
        "update history set arm = 'x' returning arm",
        "create table mine as select 1",
        "select * from enable_logging('QueryLog', storage = 'stdout')",
        "call enable_logging('QueryLog', storage = 'file', storage_path = '{}/log')",  # ended the whole process
    ],
)
def test_a_query_that_would_write_is_refused_rather_than_said_to_have_done_it(query: str, tmp_path: Path) -> None:
    pytest.importorskip("duckdb")
    many(tmp_path, 1, 1)
    ask(tmp_path, "select 1")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match="--sql"):
        ask(tmp_path, query.format(tmp_path))
    assert sorted(tmp_path.rglob("*")) == before


def test_a_query_without_end_can_be_interrupted(tmp_path: Path) -> None:
    pytest.importorskip("duckdb")
    many(tmp_path, 1, 1)
    timer = threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        ask(tmp_path, "select count(*) from range(1000000000000) a where a.range % 7 = 3")
    timer.join()


def test_prometheus_reads_every_line() -> None:
    change = Change(joint='el"bow', quantity="sag", state="alarm", usual_mm=1, now_mm=2, since=None, cusum=6.5)
    seen = Outlook(
        state="alarm", checks=9, since=BEGIN, newest=BEGIN, changes=(change,), error_mm=2.5, error_known=False,
        tolerance_mm=3.0, due=Due(early=BEGIN, middle=None, late=None),
    )  # fmt: skip
    text = prometheus_text("a7", seen, measures())
    samples = [line for line in text.splitlines() if not line.startswith("#")]
    assert 'rejoint_error_mm{arm="a7",by="encoders"} 2.5' in samples
    assert 'rejoint_state{arm="a7",state="alarm"} 1' in samples
    assert 'rejoint_cusum{arm="a7",joint="el\\"bow",quantity="sag"} 6.5' in samples
    assert (
        f'rejoint_due_seconds{{arm="a7",end="early"}} {(BEGIN - datetime(1970, 1, 1)).total_seconds():.0f}' in samples
    )
    assert text.endswith("\n")
    assert len({line.split(" ")[2] for line in text.splitlines() if line.startswith("# TYPE")}) == 7
