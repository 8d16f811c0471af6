"""What strangers put into one file: pauses, two motions, two arms, repeated readings, commands that moved nothing."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from log_samples import ARM, Sample, worn_sample, write_table
from test_logs_checks import motion
from test_logs_doubts import dataset
from test_logs_ros import KINDS, START, STORAGES, header, state, states, write

import rejoint
from rejoint.logs import ImportOptions, import_logs
from rejoint.logs.copies import copies
from rejoint.logs.joining import to_log
from rejoint.logs.parting import parted
from rejoint.logs.runlog import Array, RunLog
from rejoint.system.errors import FileError, InputError

FOUND = worn_sample(seconds=20)
ROWS = len(FOUND.time)


def refused(found: Sample, said: str) -> None:
    """The import stops and says so; by force it goes on and says it again."""
    with pytest.raises(FileError, match=said):
        to_log(motion(found), ARM)
    _, notes = to_log(motion(found), ARM, ImportOptions(force=True))
    assert any("imported by force" in note for note in notes)


def paused(*pauses: tuple[int, float]) -> Sample:
    time = FOUND.time.copy()
    for row, seconds in pauses:
        time[row:] += seconds
    return replace(FOUND, time=time)


def test_a_long_pause_parts_a_recording(tmp_path: Path):
    source = write_table(tmp_path / "day.csv", paused((400, 60.0), (700, 3600.0)))
    found = import_logs(source, ARM, out=tmp_path / "logs")
    assert [log.label for log in found.logs] == ["day-1of3", "day-2of3", "day-3of3"]
    assert [len(log) for log in found.logs] == [400, 300, ROWS - 700]
    assert max(np.diff(log.time).max() for log in found.logs) < 0.021
    np.testing.assert_array_equal(np.concatenate([log.command for log in found.logs]), FOUND.command)
    (note,) = [note for note in found.notes if "pause" in note]
    assert "2 pause(s) longer than 1 s, the longest 3.6e+03 s before line 702; cut there into 3 log(s)" in note


def test_a_lone_sample_between_pauses_is_left_out_and_told():
    parts = list(parted(motion(paused((400, 60.0), (401, 60.0)))))
    assert [len(part.state) for part in parts] == [400, ROWS - 401]
    assert parts[0].notes[-1].endswith("cut there into 2 log(s), 1 lone sample(s) left out")


def test_the_command_that_holds_goes_with_each_part():
    seldom = np.arange(0, ROWS, 7)
    found = motion(paused((400, 60.0)))
    assert found.command is not None
    rows = np.isin(np.arange(ROWS), seldom)
    parts = list(parted(replace(found, command=found.command.take(rows))))
    for part, first in zip(parts, (0, 400), strict=True):
        log, _ = to_log(part, ARM, ImportOptions(force=True))
        expected = FOUND.command[(first + np.arange(len(log))) // 7 * 7]
        np.testing.assert_array_equal(log.command, expected)


def test_a_short_gap_or_a_clock_set_back_parts_nothing():
    for found in (FOUND, paused((400, 0.9)), paused((400, -3.0))):
        assert [len(part.state) for part in parted(motion(found))] == [ROWS]


def test_joints_that_are_elsewhere_in_the_next_sample_are_refused():
    for last, said in ((420, r"2 time\(s\) .* line 422"), (ROWS, r"1 time\(s\) .* line 302")):
        position = FOUND.position.copy()  # a stretch of another recording; another zero from there on
        position[300:last, 2] += 0.4
        refused(replace(FOUND, position=position), f"{said}: no joint moves so")


def test_fast_steps_and_readings_that_catch_up_are_no_jumps():
    stepping = worn_sample(seconds=20, stepping=True)
    assert to_log(motion(stepping), ARM)[1] == []
    position = FOUND.position.copy()
    position[300:315] = position[300]
    assert to_log(motion(replace(FOUND, position=position)), ARM)[1] == []


def test_two_arms_that_take_turns_are_refused():
    position = FOUND.position.copy()
    position[1::2] = -position[1::2] + 0.3
    refused(replace(FOUND, position=position), "as if the samples of two arms took turns")


def test_readings_that_are_renewed_too_seldom_are_refused():
    rows = np.arange(ROWS)
    refused(replace(FOUND, position=FOUND.position[rows // 10 * 10]), "renewed only 5 times a second")
    assert to_log(motion(replace(FOUND, position=FOUND.position[rows // 2 * 2])), ARM)[1] == []


@pytest.mark.parametrize("row", [0, -1])
def test_commands_that_never_change_move_no_arm(row: int):
    held = np.tile(FOUND.command[row], (ROWS, 1))
    refused(replace(FOUND, command=held), "the commands of all joints never change, yet .* moves away from its own")


def test_commands_that_end_before_the_motion_are_noted():
    held = np.where(np.arange(ROWS)[:, None] < 500, FOUND.command, FOUND.command[500])
    _, notes = to_log(motion(replace(FOUND, command=held)), ARM)
    assert any("while its command stands, from 10" in note and "not in the file?" in note for note in notes)


def test_a_goal_that_was_sent_before_the_log_began_is_believed():
    goal = np.linspace(0.3, 0.6, 5)
    way = goal - 0.8 * np.exp(-FOUND.time / 0.5)[:, None] * np.ones(5)
    found = replace(
        FOUND, command=np.tile(goal, (ROWS, 1)), position=np.round(way / ARM.encoder_step) * ARM.encoder_step
    )
    to_log(motion(found), ARM)


def test_readings_whose_zero_was_moved_are_in_no_other_unit():
    moved = 196.5 * ARM.encoder_step * np.array([1, 0, 0, 0, 0])
    position = np.round(FOUND.position + np.where(np.arange(ROWS)[:, None] < ROWS // 2, 0.0, moved), 6)
    _, notes = to_log(motion(replace(FOUND, position=position)), ARM, ImportOptions(force=True))
    assert sum("farthest state.shoulder_pan" in note for note in notes) == 1
    assert not any("come in steps of" in note for note in notes)


def test_a_minus_of_a_spreadsheet_is_a_minus(tmp_path: Path):
    source = write_table(tmp_path / "a.csv", FOUND)
    plain = import_logs(source, ARM, out=tmp_path / "plain").logs[0]
    source.write_text(source.read_text().replace("-", "\N{MINUS SIGN}"), encoding="utf-8")
    np.testing.assert_array_equal(import_logs(source, ARM, out=tmp_path / "other").logs[0].position, plain.position)


def test_logs_that_are_too_short_say_what_they_hold():
    rows = [slice(first, first + 60) for first in range(0, 540, 60)]
    pieces = [
        RunLog.of(FOUND.time[own], FOUND.command[own], FOUND.position[own], arm=ARM, label=f"{own.start}")
        for own in rows
    ]
    with pytest.raises(InputError, match=r"of \d+ s in \d log\(s\), expected at least 10 s; record longer motions"):
        rejoint.identify(pieces, arm=ARM)


@pytest.mark.parametrize("storage", STORAGES)
def test_a_gripper_of_its_own_may_speak_first(tmp_path: Path, storage: str):
    found = worn_sample(seconds=6)
    kind, none = KINDS["sensor_msgs/msg/JointState"], np.zeros(0)

    def said(stamp: int, names: list[str], position: Array) -> object:
        return kind(header=header(START + stamp), name=names, position=position, velocity=none, effort=none)

    arm, sent = [], []
    for time, q, u in zip((found.time * 1e9).round().astype(int).tolist(), found.position, found.command, strict=True):
        arm.append(("/joint_states", time, said(time, list(ARM.joint_names), q)))
        sent.append(("/joint_commands", time, said(time, list(ARM.joint_names), u)))
    gripper = [("/joint_states", max(time - 5_000_000, 0), said(0, ["gripper"], np.zeros(1))) for _, time, _ in arm]
    imported = import_logs(write(tmp_path / "bag", storage, gripper + arm + sent), ARM, out=tmp_path / "logs")
    np.testing.assert_array_equal(imported.logs[0].position, found.position)
    assert any("state: 300 messages about other joints left out" in note for note in imported.notes)
    alone = write(tmp_path / "alone", storage, gripper + sent)
    with pytest.raises(FileError, match=r"message 1: no column for joint shoulder_pan.*, only gripper"):
        import_logs(alone, ARM, out=tmp_path / "none")


def test_stamps_that_go_back_name_the_other_clock(tmp_path: Path):
    found = worn_sample(seconds=6)
    both = states(found)
    both[7] = (both[7][0], both[7][1], state(START, found.position[7]))
    with pytest.raises(FileError, match=r"the clock goes back by .* take the times of recording .--stamp log."):
        import_logs(write(tmp_path / "bag", "mcap", both), ARM, out=tmp_path / "logs")


def test_an_episode_that_was_given_up_at_once_is_left_out(tmp_path: Path):
    found = worn_sample(seconds=6)
    folder = dataset(tmp_path / "set", np.full(5, 180 / np.pi), found)
    file = folder / "data/chunk-000/file-000.parquet"
    table, rows = pq.read_table(file), len(found.time)
    for name, last in (("episode_index", 1), ("frame_index", 0)):
        values = np.append(table[name].to_numpy()[:-1], last)
        table = table.set_column(table.column_names.index(name), name, pa.array(values))
    pq.write_table(table, file)
    imported = import_logs(folder, ARM, out=tmp_path / "logs", options=ImportOptions(angle_unit="deg"))
    assert [len(log) for log in imported.logs] == [rows - 1]
    assert "episode_000001: left out, with 1 sample(s), where a log needs at least 2" in imported.notes


def test_a_copied_recording_is_no_further_evidence(tmp_path: Path):
    for name in ("a", "b", "a (copy)"):
        found = FOUND if name != "b" else replace(FOUND, position=FOUND.position + 5 * ARM.encoder_step)
        (tmp_path / "in").mkdir(exist_ok=True)
        write_table(tmp_path / "in" / f"{name}.csv", found)
    imported = import_logs(tmp_path / "in", ARM, out=tmp_path / "logs")
    assert len(imported.logs) == 2
    assert any("left out, for it holds the same readings as a" in note for note in imported.notes)
    logs = [replace(imported.logs[0], label=name) for name in ("x", "y", "z")]
    for use in (rejoint.identify, rejoint.diagnose):
        with pytest.raises(InputError, match=r"y holds the same readings as x \(and 1 more\).*remove the copies"):
            use(logs, arm=ARM)
    still = replace(logs[0], position=np.tile(logs[0].position[:1], (ROWS, 1)))
    assert copies((name, still) for name in "ab") == {}
