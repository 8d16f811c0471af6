"""A dataset that LeRobot 0.4.4 itself wrote (lerobot_v3/make.py), as it is and with one thing changed."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from log_samples import ARM

from rejoint.logs.columns import calibrated_ranges
from rejoint.logs.importing import detect, import_logs
from rejoint.logs.joints import ImportOptions
from rejoint.system.errors import FileError

DATASET = Path(__file__).parent / "lerobot_v3" / "dataset"
DATA = Path("data/chunk-000/file-000.parquet")
DEGREES = ImportOptions(angle_unit="deg", force=True)
"""By force: the robot of make.py is a mock, whose states are its commands of two frames before."""


def sent(episode: int) -> np.ndarray:
    """The degrees that make.py sent in an episode, in LeRobot's float32."""
    frames = np.arange(40 + 10 * episode)[:, None]
    return (20 * np.sin(0.1 * frames * np.arange(1, 7)) + episode).astype(np.float32)[:, :5].astype(float)


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    return Path(shutil.copytree(DATASET, tmp_path / "in"))


def test_each_episode_becomes_a_log(tmp_path):
    assert detect(DATASET) == "lerobot"
    imported = import_logs(DATASET, ARM, out=tmp_path / "logs", options=DEGREES)
    assert [path.stem for path in sorted((tmp_path / "logs").iterdir())] == ["episode_000000", "episode_000001"]
    for episode, log in enumerate(imported.logs):
        assert log.command.tolist() == np.deg2rad(sent(episode)).tolist()
        lagging = np.concatenate([sent(episode)[:1], sent(episode)[:1], sent(episode)[:-2]])
        assert log.position.tolist() == np.deg2rad(lagging).tolist()
        assert log.time.tolist() == (np.arange(len(log)) / 30).tolist()
        assert "copies of the commands" in log.extra["forced"].split(" | ")[0]
    assert any("frame numbers over 30 Hz, no measured times" in note for note in imported.notes)
    assert any("gripper.pos" in note for note in imported.notes)


def test_a_robot_that_repeats_its_commands_is_none(tmp_path):
    with pytest.raises(FileError, match=r"are copies of the commands, 2 row.s. later.*--force"):
        import_logs(DATASET, ARM, out=tmp_path / "logs", options=ImportOptions(angle_unit="deg"))


def test_the_unit_has_to_be_declared(tmp_path):
    with pytest.raises(FileError, match=r"does not say the unit of observation.state and action; set --angle-unit"):
        import_logs(DATASET, ARM, out=tmp_path / "logs")
    with pytest.raises(FileError, match="values are degrees"):
        import_logs(DATASET, ARM, out=tmp_path / "logs", options=ImportOptions(angle_unit="rad"))


def test_normalised_values_need_the_calibration(tmp_path):
    motors = {
        name: {
            "id": i,
            "drive_mode": int(name == "wrist_roll"),
            "homing_offset": 0,
            "range_min": 1000,
            "range_max": 3048 - 100 * i,
        }
        for i, name in enumerate([*ARM.joint_names, "gripper"])
    }
    calibration = tmp_path / "arm.json"
    calibration.write_text(json.dumps(motors))
    options = ImportOptions(angle_unit="normalised", calibration=calibration, force=True)
    log = import_logs(DATASET, ARM, out=tmp_path / "logs", options=options).logs[1]
    # 2048 positions are half a turn, so that 100 stands for a quarter turn from the middle
    quarter_turns = (2048 - 100 * np.arange(5)) / 2048 * np.array([1, 1, 1, 1, -1])
    np.testing.assert_allclose(log.command, sent(1) / 100 * quarter_turns * np.pi / 2, rtol=1e-15)
    calibration.write_text("{}")
    with pytest.raises(FileError, match=r"arm.json: calibration: no column for joint shoulder_pan"):
        import_logs(DATASET, ARM, out=tmp_path / "other", options=options)


def test_ranges_follow_from_steps_and_a_still_joint_has_its_usual_one():
    step = 200.0 / 2100
    raw = step * np.round(60.0 / step * np.sin(np.outer(0.01 * np.arange(900), [1.0, 2.0, 3.0, 4.0, 0.0])))
    usual = np.ptp([ARM.lower[-1], ARM.upper[-1]]) * 2048 / np.pi
    np.testing.assert_allclose(calibrated_ranges(raw, ARM, DATASET), [2100, 2100, 2100, 2100, usual])


def test_several_files_mixed_rows_and_other_names_make_the_same_logs(dataset: Path, tmp_path):
    info = dataset / "meta/info.json"
    for name in ARM.joint_names:
        info.write_text(info.read_text().replace(name, f"main_{name}"))
    info.write_text(info.read_text().replace('"action"', '"actions"'))
    table = pq.read_table(dataset / DATA)
    table = table.rename_columns([name.replace("action", "actions") for name in table.column_names])
    mixed = table.take(np.random.default_rng(3).permutation(90))
    pq.write_table(mixed.slice(0, 30), dataset / DATA)
    (dataset / "data/chunk-001").mkdir()
    pq.write_table(mixed.slice(30), dataset / "data/chunk-001/file-000.parquet")
    pq.write_table(mixed.select(["index"]), dataset / "data/chunk-001/foreign.parquet")
    plain = import_logs(DATASET, ARM, out=tmp_path / "1", options=DEGREES).logs
    other = import_logs(dataset, ARM, out=tmp_path / "2", options=DEGREES).logs
    for a, b in zip(plain, other, strict=True):
        assert a.time.tolist() == b.time.tolist()
        assert a.position.tolist() == b.position.tolist()
        assert a.command.tolist() == b.command.tolist()
