"""SAGE folders, as SAGE wrote them and with one thing changed."""

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from log_samples import ARM, sample, write_sage

from real_so101 import FOLDER, NO_RECORDINGS, recorded
from rejoint.logs.importing import import_logs
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import FileError


@pytest.mark.skipif(not recorded(), reason=NO_RECORDINGS)
def test_recorded_logs_arrive_bit_for_bit(tmp_path):
    steps = []
    imported = import_logs(FOLDER, ARM, out=tmp_path / "logs", on_progress=lambda *step: steps.append(step))
    assert len(imported.logs) == len(list(FOLDER.glob("*/state_motor.csv"))) == 44
    assert [share for share, _ in steps] == [k / 44 for k in range(1, 45)]
    assert sum(len(log) for log in imported.logs) == 198040
    for motion in ("multisine", "hold_under_gravity"):
        log = RunLog.load(tmp_path / "logs" / f"{motion}.parquet")
        for file, values in (("state_motor", log.position), ("control", log.command)):
            with (FOLDER / motion / f"{file}.csv").open(newline="") as lines:
                rows = list(csv.DictReader(lines))
            assert values.tolist() == [json.loads(row["positions"])[:5] for row in rows]
            assert log.time.tolist() == [float(row["timestamp"]) / 1e6 for row in rows]
        assert log.joint_names == ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
        assert np.isnan(log.target).all()
        assert (log.arm, log.label, log.robot) == ("so101", motion, f"sage:{motion}")
    assert any("Jaw" in note for note in imported.notes)


def test_joint_order_is_that_of_the_list(tmp_path):
    shuffled = ("Elbow", "Jaw", "Wrist_Roll", "Rotation", "Wrist_Pitch", "Pitch")
    plain = import_logs(write_sage(tmp_path / "a", sample()), ARM, out=tmp_path / "1").logs[0]
    other = import_logs(write_sage(tmp_path / "b", sample(), shuffled), ARM, out=tmp_path / "2").logs[0]
    assert plain.position.tolist() == other.position.tolist() == sample().position.tolist()
    assert plain.command.tolist() == other.command.tolist() == sample().command.tolist()


@pytest.mark.parametrize("file", ["control.csv", "state_motor.csv"])
def test_a_file_without_samples_is_refused(tmp_path, file: str):
    folder = write_sage(tmp_path / "empty", sample())
    (folder / file).write_text("type,timestamp,positions\n")
    with pytest.raises(FileError, match=r"0 (states|commands)"):
        import_logs(folder, ARM, out=tmp_path / "logs")


def test_two_clocks_are_refused(tmp_path):
    folder = write_sage(tmp_path / "clocks", sample())
    later = replace(sample(), time=sample().time + 1.7e9)
    shutil.copy(write_sage(tmp_path / "later", later) / "control.csv", folder)
    with pytest.raises(FileError, match="not one clock"):
        import_logs(folder, ARM, out=tmp_path / "logs")
