"""The journal: what an arm did is on file before the process can die, and the disk never holds up or ends a motion."""

import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rejoint.logs import journal as module
from rejoint.logs.journal import CUT_SHORT, Journal, read_journal, recover
from rejoint.logs.runfolder import RunFolder, locked
from rejoint.logs.runlog import RunLog
from waiting import until

pytestmark = pytest.mark.realtime

JOINTS = ("a", "b")
RNG = np.random.default_rng(7)
ROWS = [(0.025 * k, *RNG.normal(size=(2, 2)), np.full(3, np.nan), RNG.normal(size=3)) for k in range(60)]


def begin(folder: Path, name: str = "deploy-1") -> Journal:
    path = folder / "logs" / f"{name}.parquet"
    return Journal(path, SimpleNamespace(name="planar", joint_names=JOINTS), "tcp://x", "deploy/policy")


def written(folder: Path, count: int = len(ROWS)) -> Journal:
    journal = begin(folder)
    for row in ROWS[:count]:
        journal.append(*row)
    journal.close()
    return journal


def columns(rows: list[tuple]) -> dict[str, np.ndarray]:
    names = "time", "position", "command", "target", "true_tcp"
    return {name: np.stack(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)}


def same(log: RunLog, rows: list[tuple]) -> None:
    for name, column in columns(rows).items():
        np.testing.assert_array_equal(getattr(log, name), column)


def whole() -> RunLog:
    return RunLog(arm="planar", joint_names=JOINTS, robot="tcp://x", label="deploy/policy", **columns(ROWS))


def test_what_a_killed_process_wrote_becomes_a_log_of_its_own(tmp_path: Path) -> None:
    written(tmp_path)
    (found,) = recover(tmp_path / "logs")
    log = RunLog.load(found)
    same(log, ROWS)
    assert (found.name, log.label) == (f"deploy-1-{CUT_SHORT}.parquet", f"deploy/policy/{CUT_SHORT}")
    assert (log.arm, log.joint_names, log.robot) == ("planar", JOINTS, "tcp://x")
    assert [path.name for path in (tmp_path / "logs").iterdir()] == [found.name]
    assert recover(tmp_path / "logs") == ()
    written(tmp_path)
    (other,) = recover(tmp_path / "logs")
    assert {path.name for path in (tmp_path / "logs").iterdir()} == {found.name, other.name}


def test_a_log_that_came_to_its_end_leaves_no_journal(tmp_path: Path) -> None:
    journal = written(tmp_path)
    journal.finish(whole())
    same(RunLog.load(journal.path), ROWS)
    assert list(journal.path.parent.iterdir()) == [journal.path]
    other = written(tmp_path)  # killed after the log was written and before the journal was removed
    assert other.file.exists()
    assert recover(tmp_path / "logs") == ()
    assert list(journal.path.parent.iterdir()) == [journal.path]


def test_a_journal_without_rows_leaves_nothing(tmp_path: Path) -> None:
    journal = written(tmp_path, 0)
    journal.file.write_bytes(b"\0" * 4096)  # as a loss of power may leave it
    assert recover(tmp_path / "logs") == ()
    assert list((tmp_path / "logs").iterdir()) == []


def test_rows_that_no_run_log_may_hold_are_left_out(tmp_path: Path) -> None:
    journal = begin(tmp_path)
    late, broken = ROWS[5], (0.2, np.full(2, np.nan), *ROWS[6][2:])
    for row in (*ROWS[:8], late, broken, *ROWS[8:]):
        journal.append(*row)
    journal.close()
    same(read_journal(journal.file), ROWS)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], max_examples=60)
@given(cut=st.floats(0, 1), flips=st.lists(st.tuples(st.floats(0, 0.999), st.integers(1, 255)), max_size=3))
def test_damage_costs_the_rows_that_it_hit_and_no_more(
    tmp_path: Path, cut: float, flips: list[tuple[float, int]]
) -> None:
    journal = written(tmp_path)
    before = journal.file.read_bytes()
    head, data = before.index(b"\n") + 1, bytearray(before)
    for where, mask in flips:
        data[int(where * len(data))] ^= mask
    journal.file.write_bytes(data if flips else data[: round(cut * len(data))])
    after = journal.file.read_bytes()
    step = (len(before) - head) // len(ROWS)
    places = [slice(start, start + step) for start in range(head, len(before), step)]
    left = [row for row, place in zip(ROWS, places, strict=True) if after[place] == before[place]]
    found = read_journal(journal.file)
    if after[:head] == before[:head] and left:
        assert found is not None
        same(found, left)
    else:
        assert found is None or len(found) <= len(ROWS)
    journal.file.unlink()


def test_a_journal_that_does_not_say_whose_it_is_is_not_thrown_away(tmp_path: Path) -> None:
    journal = written(tmp_path)
    journal.file.write_bytes(b"?" + journal.file.read_bytes()[1:])
    assert recover(tmp_path / "logs") == ()
    assert [path.name for path in (tmp_path / "logs").iterdir()] == ["deploy-1-damaged.journal"]


def test_what_is_written_survives_a_kill(tmp_path: Path) -> None:
    code = f"""
import sys, time
from pathlib import Path
sys.path[:0] = {sys.path!r}
from test_journal import ROWS, begin
journal = begin(Path(sys.argv[1]))
head = journal.file.stat().st_size
for row in ROWS:
    journal.append(*row)
while journal.file.stat().st_size < head + len(ROWS) * 92:
    time.sleep(0.01)
print("written", flush=True)
time.sleep(600)
"""
    words = [sys.executable, "-c", code, str(tmp_path)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "written\n"
        process.send_signal(signal.SIGKILL)
    with locked(RunFolder(tmp_path)):
        (path,) = (tmp_path / "logs").iterdir()
        same(RunLog.load(path), ROWS)


def test_a_disk_that_fills_meanwhile_neither_ends_the_run_nor_hides_the_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = begin(tmp_path)

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.os, "write", full)
    journal.append(*ROWS[0])
    until(lambda: journal.problem is not None)
    for row in ROWS[1:]:
        journal.append(*row)  # raises nothing
    monkeypatch.undo()
    journal.finish(whole())  # by then there may be room again, and all of it is in memory
    same(RunLog.load(journal.path), ROWS)
