"""Logs of states alone: what they are good for, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
from log_samples import ARM, Sample, worn_sample, write_table

import rejoint
from rejoint.logs import export_log, import_logs
from rejoint.logs.runlog import RunLog, read_log
from rejoint.system.errors import InputError


def bare(folder: Path, seconds: float = 12.0) -> Path:
    """A folder with one log of states alone: rest, motion, rest."""
    found = worn_sample(seconds=seconds)
    rng = np.random.default_rng(0)
    rests = np.isin(np.arange(len(found.time)) // 10, [*range(10, 18), *range(25, 33), *range(40, 48), *range(52, 60)])
    position = found.position[np.cumsum(~rests) - 1]  # what moves goes on where it stood
    position = position + 3e-4 * rests[:, None] * rng.normal(size=position.shape)
    position[:, 4] = 0.1
    folder.mkdir()
    source = write_table(folder / "wave.csv", Sample(time=found.time, position=position, command=position))
    lines = [line.split(",")[:6] for line in source.read_text().splitlines()]
    source.write_text("\n".join(",".join(line) for line in lines) + "\n")
    return folder


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    imported = import_logs(bare(tmp_path / "in"), ARM, out=tmp_path / "logs")
    assert len(imported.notes) == 1
    assert "holds no commands: it is good for `replay` of the states alone" in imported.notes[0]
    return tmp_path / "logs"


def test_states_survive_the_disk_and_an_export(logs: Path, tmp_path: Path):
    log = read_log(logs / "wave.parquet")
    assert not log.commanded
    assert np.isnan(log.command).all()
    for ending in ("csv", "mcap"):
        export_log(log, tmp_path / f"again.{ending}")
        again = import_logs(tmp_path / f"again.{ending}", ARM, out=tmp_path / ending).logs[0]
        assert not again.commanded
        np.testing.assert_array_equal(again.position, log.position)


def test_half_of_the_commands_are_refused():
    found = worn_sample(seconds=2)
    command = found.command.copy()
    command[5] = np.nan
    with pytest.raises(InputError, match="command holds values that are not finite"):
        RunLog.of(found.time, command, found.position, arm=ARM)


def test_angles_that_are_no_radians_never_reach_a_simulation():
    found = worn_sample(seconds=2)
    log = RunLog.of(found.time, np.rad2deg(found.command), np.rad2deg(found.position), arm=ARM)
    for use in (rejoint.diagnose, rejoint.identify):
        with pytest.raises(InputError, match=r"run log motion: a position of 4\d\.\d+ rad, beyond two turns"):
            use(log, arm=ARM)
