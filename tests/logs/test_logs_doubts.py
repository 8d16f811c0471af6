"""What stops an import although every number is finite: clocks, copies, units, rates; and going on by force."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from log_samples import ARM, Sample, worn_sample, write_table
from test_logs_checks import motion

from real_so101 import FOLDER, NO_RECORDINGS, recorded
from rejoint.logs.columns import ZEROS, read_motion
from rejoint.logs.importing import READERS, import_logs, to_log
from rejoint.logs.joints import ImportOptions
from rejoint.system.errors import FileError

FORCE = ImportOptions(force=True)


def shifted(found: Sample, rows: int) -> Sample:
    """States stamped earlier by some rows, or later where ``rows`` is negative."""
    n = len(found.time)
    state, command = slice(max(rows, 0), n + min(rows, 0)), slice(max(-rows, 0), n - max(rows, 0))
    return Sample(time=found.time[: n - abs(rows)], position=found.position[state], command=found.command[command])


@pytest.mark.parametrize("stepping", [False, True])
@pytest.mark.parametrize("rows", [0, 3, -5])
def test_states_that_answer_in_time_are_believed(rows: int, stepping: bool):
    _, notes = to_log(motion(shifted(worn_sample(seconds=40, stepping=stepping), rows)), ARM)
    assert notes == []


def test_a_ramp_shows_no_lag():
    time = np.arange(0.0, 6.0, 0.02)
    ramp = 0.17 * time[:, None] * np.eye(5)[1]
    behind = 0.01 * np.random.default_rng(0).normal(1.0, 0.1, ramp.shape)
    sample = Sample(time=time, position=ramp - behind, command=ramp)
    assert not any("best after" in note for note in to_log(motion(sample), ARM)[1])


@pytest.mark.parametrize("stepping", [False, True])
@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (25, r"best after -0.[34]. s, .*exchanged"),
        (85, r"best after -(1.6|0.96) s, "),
        (-15, r"best after 0\.\d+ s, .*clocks differ"),
    ],
)
def test_states_on_another_clock_are_refused(rows: int, said: str, stepping: bool):
    found = motion(shifted(worn_sample(seconds=40, stepping=stepping), rows))
    with pytest.raises(FileError, match=said):
        to_log(found, ARM)
    log, notes = to_log(found, ARM, FORCE)
    assert "the states follow their commands best" in log.extra["forced"]
    assert notes[-1] == f"imported by force, although {log.extra['forced']}"


def test_a_weak_servo_that_answers_one_step_slowly_is_in_time():
    time = 0.01 * np.arange(800)
    command, position = 0.5 * (time > 2.0), 0.4 * (time - 2.1).clip(0.0, 1.25)
    one = Sample(time=time, position=np.outer(position, np.eye(5)[1]), command=np.outer(command, np.eye(5)[1]))
    assert to_log(motion(one), ARM)[1] == []


@pytest.mark.skipif(not recorded(), reason=NO_RECORDINGS)
@pytest.mark.parametrize("name", ["multisine", "circular_motion", "step_response", "single_joint_wrist_pitch"])
def test_a_real_arm_answers_in_time_and_not_before(name: str):
    (recorded,) = READERS["sage"].read(FOLDER / name, ImportOptions())
    found = read_motion(recorded, ARM, ImportOptions(), source=FOLDER / name, kind="sage")
    to_log(found, ARM)
    for shift in (0.3, 0.5, -2.0):
        later = np.stack([np.interp(found.time - shift, found.time, one) for one in found.position.T], axis=1)
        with pytest.raises(FileError, match="follow their commands best"):
            to_log(replace(found, position=later), ARM)


@pytest.mark.parametrize("lag", [-1, 0, 1, 4])
def test_states_that_are_commands_are_refused(lag: int):
    found = worn_sample()
    rows = np.clip(np.arange(len(found.time)) - lag, 0, len(found.time) - 1)
    with pytest.raises(FileError, match="are copies of the commands"):
        to_log(motion(replace(found, position=found.command[rows])), ARM)
    one = found.position.copy()
    one[:, 2] = np.round(found.command[rows, 2], 6)
    with pytest.raises(FileError, match=r"states of state.elbow_flex are copies of the commands"):
        to_log(motion(replace(found, position=one)), ARM)


def test_one_joint_in_another_unit_is_refused():
    found = worn_sample()
    mixed = found.position * np.array([1, 1, np.pi / 180, 1, 1])
    with pytest.raises(FileError, match=r"state.elbow_flex moves 0.0\d+ times as far as its command: not one unit"):
        to_log(motion(replace(found, position=mixed)), ARM)
    with pytest.raises(FileError, match=r"state.wrist_flex is 5. deg from its command"):
        to_log(motion(replace(found, position=found.position + np.array([0, 0, 0, 1.0, 0]))), ARM)


def dataset(folder: Path, scale: np.ndarray, found: Sample) -> Path:
    """A LeRobot dataset of a sample; ``scale`` (n,) is what a radian counts in it."""
    names = [f"{name}.pos" for name in ARM.joint_names]
    feature = {"dtype": "float32", "shape": [5], "names": names}
    info = {
        "codebase_version": "v3.0",
        "fps": 50,
        "total_frames": len(found.time),
        "features": {"observation.state": feature, "action": feature},
    }
    (folder / "meta").mkdir(parents=True)
    (folder / "meta/info.json").write_text(json.dumps(info))
    (folder / "data/chunk-000").mkdir(parents=True)
    columns = {
        "observation.state": (found.position * scale).astype(np.float32).tolist(),
        "action": (found.command * scale).astype(np.float32).tolist(),
        "timestamp": found.time.astype(np.float32),
        "frame_index": np.arange(len(found.time)),
        "episode_index": np.zeros(len(found.time), dtype=int),
    }
    pq.write_table(pa.table(columns), folder / "data/chunk-000/file-000.parquet")
    return folder


SPANS = np.array([2730, 2410, 2205, 2318, 3900])
"""[counts] calibrated ranges of an SO-101"""


def calibration(folder: Path) -> Path:
    motors = {
        name: {"id": i, "drive_mode": 0, "homing_offset": 0, "range_min": 100, "range_max": 100 + int(SPANS[i])}
        for i, name in enumerate(ARM.joint_names)
    }
    (folder / "arm.json").write_text(json.dumps(motors))
    return folder / "arm.json"


def test_degrees_declared_as_normalised_and_the_reverse(tmp_path):
    found = worn_sample()
    degrees = dataset(tmp_path / "deg", np.full(5, 180 / np.pi), found)
    normalised = dataset(tmp_path / "norm", 200 / (SPANS * 2 * np.pi / 4096), found)
    file = calibration(tmp_path)
    as_degrees, known = ImportOptions(angle_unit="deg"), ImportOptions(angle_unit="deg", calibration=file)
    as_normalised = ImportOptions(angle_unit="normalised", calibration=file)
    for source, options, said in (
        (degrees, as_normalised, r"states are deg, but --angle-unit says normalised: they come in steps of 0.0879"),
        (normalised, as_degrees, r"states are normalised, .*steps of 0.0733.*; set --angle-unit normalised"),
        (normalised, known, r"states are normalised, .*steps of 0.0733.*; set --angle-unit normalised"),
    ):
        with pytest.raises(FileError, match=said):
            import_logs(source, ARM, out=tmp_path / "logs", options=options)
    middles = ImportOptions(angle_unit="normalised")
    pairs = (degrees, as_degrees), (degrees, known), (normalised, as_normalised), (normalised, middles)
    for source, options in pairs:
        log = import_logs(source, ARM, out=tmp_path / f"{source.name} {id(options)}", options=options)
        np.testing.assert_allclose(log.logs[0].position, found.position, atol=1e-6)
        assert not any("nothing in the file tells" in note for note in log.notes)
        assert (ZEROS in log.logs[0].extra) == (options is middles)


def test_what_is_forced_is_kept_in_the_file(tmp_path):
    found = shifted(worn_sample(), 20)
    source = write_table(tmp_path / "wave.csv", found)
    imported = import_logs(source, ARM, out=tmp_path / "logs", options=FORCE)
    assert "best after -" in imported.logs[0].extra["forced"]
    assert any(note.startswith("wave: imported by force, although the states") for note in imported.notes)
