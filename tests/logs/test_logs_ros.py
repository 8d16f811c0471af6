"""Bags of ros2_control, in MCAP and sqlite3: commands as its controllers take them; written by rosbags."""

from pathlib import Path

import numpy as np
import pytest
from log_samples import ARM, Sample, worn_sample
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from rejoint.logs.importing import detect, import_logs
from rejoint.logs.joints import ImportOptions
from rejoint.system.errors import FileError

STORE = get_typestore(Stores.ROS2_JAZZY)
KINDS = STORE.types
STORAGES = {"mcap": StoragePlugin.MCAP, "rosbag": StoragePlugin.SQLITE3}
START = 1_750_000_000_000_000_000
NAMES = [*ARM.joint_names, "gripper"]
ARRAYS = "/forward_position_controller/commands"


def header(stamp: int):
    time = KINDS["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    return KINDS["std_msgs/msg/Header"](stamp=time, frame_id="")


def state(stamp: int, position: np.ndarray):
    none = np.full(len(NAMES), np.nan)
    return KINDS["sensor_msgs/msg/JointState"](
        header=header(stamp), name=NAMES, position=np.append(position, 0.5), velocity=none, effort=none
    )


def array(values: np.ndarray):
    layout = KINDS["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    return KINDS["std_msgs/msg/Float64MultiArray"](layout=layout, data=np.asarray(values, dtype=float))


def write(path: Path, storage: str, messages: list[tuple[str, int, object]], packed: str = "NONE") -> Path:
    """Write a bag of messages at times [ns] since its start; returns its data file."""
    bag = BagWriter(path, version=9, storage_plugin=STORAGES[storage])
    bag.set_compression(CompressionMode[packed], CompressionFormat.ZSTD)
    with bag:
        links = {}
        for topic, time, message in sorted(messages, key=lambda one: one[1]):
            if topic not in links:
                links[topic] = bag.add_connection(topic, message.__msgtype__, typestore=STORE)
            bag.write(links[topic], START + time, STORE.serialize_cdr(message, message.__msgtype__))
    return next(file for file in path.iterdir() if file.suffix in (".mcap", ".db3", ".zstd"))


def states(found: Sample) -> list[tuple[str, int, object]]:
    """Joint states that are recorded at their stamps."""
    rows = zip((found.time * 1e9).round().astype(int).tolist(), found.position, strict=True)
    return [("/joint_states", t, state(START + t, q)) for t, q in rows]


@pytest.mark.parametrize("packed", ["NONE", "FILE", "MESSAGE"])
@pytest.mark.parametrize("storage", STORAGES)
def test_arrays_are_commands_in_the_order_of_the_controller(tmp_path, storage: str, packed: str):
    found = worn_sample(seconds=6)
    order = [3, 0, 4, 1, 2]
    sent = [(ARRAYS, round(1e9 * t), array(u[order])) for t, u in zip(found.time, found.command, strict=True)]
    source = write(tmp_path / "bag", storage, states(found) + sent, packed)
    assert packed == "FILE" or detect(source) == storage
    assert {detect(place) for place in (source.parent, tmp_path)} == {storage if packed == "NONE" else "rosbag"}
    with pytest.raises(FileError, match=r"topic /forward.*, message 1.*0 names for 5 commands; set --order"):
        import_logs(source.parent, ARM, out=tmp_path / "logs")
    options = ImportOptions(names=tuple(ARM.joint_names[i] for i in order))
    imported = import_logs(tmp_path, ARM, out=tmp_path / "logs", options=options)
    log = imported.logs[0]
    assert log.position.tolist() == found.position.tolist()
    assert log.command.tolist() == found.command.tolist()
    assert log.torque is None
    said = " ".join(imported.notes)
    assert f"commands from {ARRAYS} (std_msgs/msg/Float64MultiArray)" in said
    assert "times are those of the recording" in said


def test_a_bag_that_holds_no_positions_or_was_not_closed_is_refused(tmp_path):
    source = write(tmp_path / "bag", "rosbag", [*states(worn_sample(seconds=6)), ("/cmd", 0, header(START))])
    with pytest.raises(
        FileError, match=r"no positions to read in std_msgs/msg/Header \(TypeError: none of position, data"
    ):
        import_logs(source, ARM, out=tmp_path / "logs", options=ImportOptions(command_topic="/cmd"))
    source.with_name(f"{source.name}-wal").write_bytes(b"rest")
    with pytest.raises(FileError, match=r"was not closed: part of it is still in .*db3-wal"):
        import_logs(source, ARM, out=tmp_path / "logs")
