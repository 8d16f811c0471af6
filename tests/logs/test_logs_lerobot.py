"""A dataset that LeRobot 0.4.4 itself wrote (lerobot_v3/make.py), as it is and with one thing changed."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from log_samples import ARM

from rejoint.logs import ImportOptions, detect, import_logs
from rejoint.logs.doubts import forced_reasons
from rejoint.system.errors import FileError, InputError

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


def test_each_episode_becomes_a_log(tmp_path: Path):
    assert detect(DATASET) == "lerobot"
    imported = import_logs(DATASET, ARM, out=tmp_path / "logs", options=DEGREES)
    assert [path.stem for path in sorted((tmp_path / "logs").iterdir())] == ["episode_000000", "episode_000001"]
    for episode, log in enumerate(imported.logs):
        assert log.command.tolist() == np.deg2rad(sent(episode)).tolist()
        lagging = np.concatenate([sent(episode)[:1], sent(episode)[:1], sent(episode)[:-2]])
        assert log.position.tolist() == np.deg2rad(lagging).tolist()
        assert log.time.tolist() == (np.arange(len(log)) / 30).tolist()
    assert any("frame numbers over 30 Hz, no measured times" in note for note in imported.notes)
    assert any("gripper.pos" in note for note in imported.notes)


def test_a_robot_that_repeats_its_commands_is_none(tmp_path: Path):
    with pytest.raises(FileError, match=r"states of all joints are copies of the commands, 2 row.s. later.*--force"):
        import_logs(DATASET, ARM, out=tmp_path / "logs", options=ImportOptions(angle_unit="deg"))
    forced = import_logs(DATASET, ARM, out=tmp_path / "logs", options=DEGREES)
    for log in forced.logs:
        assert "copies of the commands" in forced_reasons(log.extra)[0]


def test_the_unit_has_to_be_declared(tmp_path: Path):
    with pytest.raises(FileError, match=r"does not say the unit of observation.state and action; set --angle-unit"):
        import_logs(DATASET, ARM, out=tmp_path / "logs")
    with pytest.raises(FileError, match="surely degrees"):
        import_logs(DATASET, ARM, out=tmp_path / "logs", options=ImportOptions(angle_unit="rad"))
    with pytest.raises(InputError, match="belong together"):
        ImportOptions(angle_unit="normalised")


def test_normalised_values_need_the_calibration(tmp_path: Path):
    motors = {
        name: {"id": i, "drive_mode": int(name == "wrist_roll"), "homing_offset": 0, "range_min": 1000,
               "range_max": 3048 - 100 * i}
        for i, name in enumerate([*ARM.joint_names, "gripper"])
    }  # fmt: skip
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


def test_several_files_and_mixed_rows_make_the_same_logs(dataset: Path, tmp_path: Path):
    table = pq.read_table(dataset / DATA)
    mixed = table.take(np.random.default_rng(3).permutation(90))
    pq.write_table(mixed.slice(0, 30), dataset / DATA)
    (dataset / "data/chunk-001").mkdir()
    pq.write_table(mixed.slice(30), dataset / "data/chunk-001/file-000.parquet")
    plain = import_logs(DATASET, ARM, out=tmp_path / "1", options=DEGREES).logs
    other = import_logs(dataset, ARM, out=tmp_path / "2", options=DEGREES).logs
    for a, b in zip(plain, other, strict=True):
        assert a.time.tolist() == b.time.tolist()
        assert a.position.tolist() == b.position.tolist()
        assert a.command.tolist() == b.command.tolist()


def test_columns_without_names_are_named_by_the_user(dataset: Path, tmp_path: Path):
    info = json.loads((dataset / "meta/info.json").read_text())
    for key in ("observation.state", "action"):
        info["features"][key]["names"] = None
    (dataset / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(FileError, match=r"observation.state has 6 columns with the names None; .*--order"):
        import_logs(dataset, ARM, out=tmp_path / "logs", options=DEGREES)
    options = ImportOptions(angle_unit="deg", force=True, joint_order=(*ARM.joint_names, "gripper"))
    log = import_logs(dataset, ARM, out=tmp_path / "logs", options=options).logs[0]
    assert log.command.tolist() == np.deg2rad(sent(0)).tolist()


def test_swapped_names_of_the_state_are_noticed(dataset: Path, tmp_path: Path):
    info = json.loads((dataset / "meta/info.json").read_text())
    names = info["features"]["observation.state"]["names"]
    names[0], names[1] = names[1], names[0]
    (dataset / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(FileError, match="follows the command of"):
        import_logs(dataset, ARM, out=tmp_path / "logs", options=DEGREES)


def without_frames(dataset: Path) -> None:
    table = pq.read_table(dataset / DATA)
    pq.write_table(table.slice(0, 80), dataset / DATA)


def with_short_row(dataset: Path) -> None:
    table = pq.read_table(dataset / DATA)
    rows = table["action"].to_pylist()
    rows[11] = rows[11][:4]
    index = table.column_names.index("action")
    pq.write_table(table.set_column(index, "action", pa.array(rows, pa.list_(pa.float32()))), dataset / DATA)


def with_hole(dataset: Path) -> None:
    table = pq.read_table(dataset / DATA)
    rows = table["action"].to_pylist()
    rows[11][2] = None
    index = table.column_names.index("action")
    pq.write_table(table.set_column(index, "action", pa.array(rows, pa.list_(pa.float32()))), dataset / DATA)


def without_action(dataset: Path) -> None:
    pq.write_table(pq.read_table(dataset / DATA).drop_columns(["action"]), dataset / DATA)


def of_version_2(dataset: Path) -> None:
    path = dataset / "meta/info.json"
    path.write_text(path.read_text().replace("v3.0", "v2.1"))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (without_frames, "80 frames in data, but meta/info.json promises 90"),
        (with_short_row, "row 12: 4 values in action, expected 6"),
        (with_hole, "row 12: action elbow_flex.pos is nan"),
        (without_action, r"file-000.parquet: has no column action; found observation.state, .*timestamp"),
        (of_version_2, "dataset version v2.1, expected v3"),
    ],
)
def test_damage_is_named(dataset: Path, tmp_path: Path, damage, message: str):
    damage(dataset)
    with pytest.raises(FileError, match=message):
        import_logs(dataset, ARM, out=tmp_path / "logs", options=DEGREES)
    assert not (tmp_path / "logs").exists()
