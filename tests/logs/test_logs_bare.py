"""Logs of states alone: what they are good for, and what is refused."""

import numpy as np
import pytest
from log_samples import ARM, worn_sample, write_table

import rejoint
from rejoint.logs.exporting import export_log
from rejoint.logs.importing import import_logs
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError

FOUND = worn_sample(seconds=2)


def test_states_survive_the_disk_and_an_export(tmp_path):
    source = write_table(tmp_path / "wave.csv", worn_sample(seconds=12))
    source.write_text("".join(",".join(line.split(",")[:6]) + "\n" for line in source.read_text().splitlines()))
    imported = import_logs(source, ARM, out=tmp_path / "logs")
    assert len(imported.notes) == 1
    assert "holds no commands" in imported.notes[0]
    log = RunLog.load(tmp_path / "logs/wave.parquet")
    assert np.isnan(log.command).all()
    for ending in ("csv", "mcap"):
        export_log(log, tmp_path / f"again.{ending}")
        (again,) = import_logs(tmp_path / f"again.{ending}", ARM, out=tmp_path / ending).logs
        assert not again.commanded
        np.testing.assert_array_equal(again.position, log.position)


def test_half_of_the_commands_are_refused():
    with pytest.raises(InputError, match="command holds values that are not finite"):
        RunLog.of(FOUND.time, np.where(FOUND.time[:, None] > 1, np.nan, FOUND.command), FOUND.position, arm=ARM)


def test_angles_that_are_no_radians_never_reach_a_simulation():
    log = RunLog.of(FOUND.time, np.rad2deg(FOUND.command), np.rad2deg(FOUND.position), arm=ARM)
    for use in (rejoint.diagnose, rejoint.identify):
        with pytest.raises(InputError, match="beyond two turns"):
            use(log, arm=ARM)
