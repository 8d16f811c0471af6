"""What strangers put into one file: pauses, two motions, two arms, repeated readings, commands that moved nothing."""

from dataclasses import replace

import numpy as np
import pytest
from log_samples import ARM, Sample, worn_sample, write_table
from test_logs_checks import motion

import rejoint
from rejoint.logs.consistency import copies
from rejoint.logs.importing import import_logs, to_log
from rejoint.logs.joints import ImportOptions
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


def test_a_long_pause_parts_a_recording(tmp_path):
    source = write_table(tmp_path / "day.csv", paused((400, 60.0), (700, 3600.0)))
    found = import_logs(source, ARM, out=tmp_path / "logs")
    assert [log.label for log in found.logs] == ["day-1of3", "day-2of3", "day-3of3"]
    assert [len(log) for log in found.logs] == [400, 300, ROWS - 700]
    assert max(np.diff(log.time).max() for log in found.logs) < 0.021
    np.testing.assert_array_equal(np.concatenate([log.command for log in found.logs]), FOUND.command)


def test_holes_close_together_and_readings_that_jump_out_and_back_are_left_out(tmp_path):
    position = FOUND.position.copy()
    position[[100, 110], 1] = np.nan
    position[200:212, 2] += 1.0
    source = write_table(tmp_path / "day.csv", replace(FOUND, position=position))
    assert [len(log) for log in import_logs(source, ARM, out=tmp_path / "logs").logs] == [ROWS - 14]


def test_a_late_stamp_in_fast_motion_is_no_damage():
    read = 0.00625 * np.arange(2000) + 0.035 * (np.arange(2000) >= 1000)
    stamped = read + 0.035 * (np.arange(2000) == 999)
    state, command = (np.tile(np.sin(5.0 * (read - read[999] + ahead)), (5, 1)).T for ahead in (0.0, 0.08))
    assert to_log(motion(Sample(time=stamped, position=state, command=command)), ARM)[1] == []


def test_two_arms_that_take_turns_are_refused():
    position = FOUND.position.copy()
    position[1::2] = -position[1::2] + 0.3
    refused(replace(FOUND, position=position), "as if two arms took turns")


@pytest.mark.parametrize("row", [0, -1])
def test_commands_that_never_change_move_no_arm(row: int):
    held = np.tile(FOUND.command[row], (ROWS, 1))
    refused(replace(FOUND, command=held), "the command of .* never changes, yet it moves away from it")


def test_a_copied_recording_is_no_further_evidence(tmp_path):
    for name in ("a", "b", "a (copy)"):
        found = FOUND if name != "b" else replace(FOUND, position=FOUND.position + 5 * ARM.encoder_step)
        folder = tmp_path / "in" / ("later" if name == "b" else "")
        folder.mkdir(parents=True, exist_ok=True)
        write_table(folder / f"{name}.csv", found)
    imported = import_logs(tmp_path / "in", ARM, out=tmp_path / "logs")
    assert len(imported.logs) == 2
    assert any("left out, for it holds the same readings as a" in note for note in imported.notes)
    logs = [replace(imported.logs[0], label=name) for name in ("x", "y", "z")]
    for use in (rejoint.identify, rejoint.diagnose):
        with pytest.raises(InputError, match=r"y holds the same readings as x.*remove the copies"):
            use(logs, arm=ARM)
    still = replace(logs[0], position=np.tile(logs[0].position[:1], (ROWS, 1)))
    assert copies((name, still) for name in "ab") == {}
