"""Logs of states alone: what they are good for, and what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from log_samples import ARM, Sample, worn_sample, write_table
from typer.testing import CliRunner

import rejoint
from rejoint.cli import app
from rejoint.logs import export_log, import_logs
from rejoint.logs.runlog import RunLog, read_log
from rejoint.system.errors import InputError
from rejoint.twin.parameters import prior, unpack
from rejoint.twin.prediction import PredictionError
from rejoint.twin.twin import HeldOut, Twin


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
    assert "holds no commands: it is good for `diagnose` and `replay` of the states alone" in imported.notes[0]
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


def test_a_diagnosis_of_states_says_what_is_impossible(logs: Path):
    found = rejoint.diagnose(logs, arm=ARM).diagnosis
    assert found.condition == "unknown"
    assert "cannot be told: 1 recorded motion, 12 s, hold no commands" in found.verdict
    assert "wrist_roll never moves" in found.verdict
    assert "shoulder_pan travels" in found.verdict
    assert "Without commands it cannot be told how far joints stop" in found.unseen[0]
    noise = [row.noise_rad for row in found.measurement.joints]
    assert all(row.stiffness_nm_per_rad is None and row.lag_s is None for row in found.measurement.joints)
    assert noise[0] is not None
    assert 2e-4 < noise[0].value < 4e-4


def test_a_twin_cannot_be_fitted_to_states(logs: Path, tmp_path: Path):
    with pytest.raises(InputError, match="identification: these logs hold no commands, and without them stiffness"):
        rejoint.identify(logs, arm=ARM)
    found = worn_sample(seconds=2)
    whole = RunLog.of(found.time, found.command, found.position, arm=ARM, label="whole")
    with pytest.raises(InputError, match=r"diagnosis: 1 of 2 logs hold no commands .wave.; put them into a folder"):
        rejoint.diagnose([read_log(logs / "wave.parquet"), whole], arm=ARM)


def healthy_twin() -> Twin:
    belief, error = prior(ARM), PredictionError(joints=np.zeros(5), joint=0.0, tcp=0.0)
    return Twin(
        arm=ARM.name, joint_names=ARM.joint_names, parameters=unpack(belief.mean, ARM.joints),
        covariance=np.diag(belief.sigma**2), lower=belief.lower, upper=belief.upper,
        narrowing=np.ones(len(belief.mean)), identified=np.zeros(len(belief.mean), dtype=bool), fit_seconds=1.0,
        held_out=HeldOut(seconds=1.0, no_twin=error, healthy_twin=error, twin=error),
    )  # fmt: skip


def test_a_replay_of_states_sends_the_path_to_the_twin(logs: Path, tmp_path: Path):
    healthy_twin().save(tmp_path / "twin.toml")
    out = tmp_path / "replay"
    done = CliRunner().invoke(
        app, ["replay", str(tmp_path / "twin.toml"), "--logs", str(logs), "--arm", "so101", "--out", str(out), "--json"]
    )
    assert done.exit_code == 0, done.output
    assert "The twin, sent along the recorded" in done.stdout
    assert "how well the twin predicts the arm cannot be told, and no page is written" in done.stdout
    told = json.loads(done.stdout.splitlines()[-1])
    assert told["judgement"] is told["page"] is None
    assert 0.0 < told["followed"][0]["rms_mm"] < told["followed"][0]["most_mm"] < 400.0
    assert not out.exists()
