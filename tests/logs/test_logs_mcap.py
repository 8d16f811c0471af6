"""MCAP files written by the Foxglove SDK, by rosbags and by the libraries of mcap.dev."""

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import foxglove
import mcap.reader
import numpy as np
import pytest
from foxglove.channels import JointStatesChannel
from foxglove.messages import JointState, JointStates, Timestamp
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from log_samples import ARM, Sample, rows_of, sample
from mcap.writer import CompressionType, IndexType, Writer
from mcap_protobuf.writer import Writer as ProtobufWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from rejoint.logs import ImportOptions, detect, import_logs
from rejoint.system.errors import FileError, InputError, MissingExtraError

BARE = {
    "use_chunking": False, "index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False,
    "repeat_channels": False, "repeat_schemas": False,
}  # fmt: skip
"""Layout of an MCAP file that has no summary at all."""
EPOCH_NS = 1_750_000_000_123_456_789
NAMES = [*ARM.joint_names, "gripper"]


def stamps(found: Sample, origin: int = EPOCH_NS) -> list[int]:
    return [origin + round(1e9 * float(time)) for time in found.time]


def streams(found: Sample) -> Iterator[tuple[str, int, list[float]]]:
    """Topic, stamp and positions of every message, in the order of their times."""
    rows = zip(stamps(found), rows_of(found.position), rows_of(found.command), strict=True)
    for stamp, position, command in rows:
        yield "/joint_states", stamp, position
        yield "/joint_commands", stamp, command


def write_foxglove(path: Path, found: Sample) -> Path:
    """foxglove.JointStates in protobuf, by the Foxglove SDK."""
    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context):
        channels = {topic: JointStatesChannel(topic, context=context) for topic in ("/joint_states", "/joint_commands")}
        for topic, stamp, values in streams(found):
            joints = [JointState(name=name, position=value) for name, value in zip(NAMES, values, strict=True)]
            time = Timestamp(sec=stamp // 10**9, nsec=stamp % 10**9)
            channels[topic].log(JointStates(timestamp=time, joints=joints), log_time=stamp + 7_000_000)
    return path


def write_json(path: Path, found: Sample, stamped: bool = True) -> Path:
    """sensor_msgs/JointState in JSON, by the Foxglove SDK."""
    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context):
        schema = foxglove.Schema(
            name="sensor_msgs/JointState", encoding="jsonschema", data=json.dumps({"type": "object"}).encode()
        )
        channels = {
            topic: foxglove.Channel(topic, schema=schema, message_encoding="json", context=context)
            for topic in ("/joint_states", "/joint_commands")
        }
        for topic, stamp, values in streams(found):
            time = {"sec": stamp // 10**9, "nsec": stamp % 10**9} if stamped else {"sec": 0, "nsec": 0}
            content = {"header": {"stamp": time}, "name": NAMES, "position": values}
            channels[topic].log(json.dumps(content).encode(), log_time=stamp)
    return path


def write_rosbag(path: Path, found: Sample) -> Path:
    """sensor_msgs/msg/JointState in CDR as `ros2 bag record` stores it, by rosbags; returns the MCAP file."""
    store = get_typestore(Stores.ROS2_JAZZY)
    kinds = store.types
    state = kinds["sensor_msgs/msg/JointState"]
    with BagWriter(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        links = {
            topic: bag.add_connection(topic, state.__msgtype__, typestore=store)
            for topic in ("/joint_states", "/joint_commands")
        }
        for topic, stamp, values in streams(found):
            time = kinds["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
            header = kinds["std_msgs/msg/Header"](stamp=time, frame_id="base")
            order = [5, 3, 1, 0, 2, 4] if topic == "/joint_states" else [0, 1, 2, 3, 4, 5]
            message = state(
                header=header, name=[NAMES[i] for i in order], position=np.array(values)[order],
                velocity=np.zeros(0), effort=np.zeros(0),
            )  # fmt: skip
            bag.write(links[topic], stamp + 5_000_000, store.serialize_cdr(message, state.__msgtype__))
    return next(path.glob("*.mcap"))


def joint_state_class() -> type:
    """The protobuf mirror of sensor_msgs/JointState."""
    field = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="joint_state.proto", package="ros.sensor_msgs", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    header = file.message_type.add(name="Header")
    header.field.add(
        name="stamp", number=1, type=field.TYPE_MESSAGE, label=field.LABEL_OPTIONAL,
        type_name=".google.protobuf.Timestamp",
    )  # fmt: skip
    state = file.message_type.add(name="JointState")
    state.field.add(
        name="header",
        number=1,
        type=field.TYPE_MESSAGE,
        label=field.LABEL_OPTIONAL,
        type_name=".ros.sensor_msgs.Header",
    )
    state.field.add(name="name", number=2, type=field.TYPE_STRING, label=field.LABEL_REPEATED)
    state.field.add(name="position", number=3, type=field.TYPE_DOUBLE, label=field.LABEL_REPEATED)
    pool = descriptor_pool.DescriptorPool()
    from google.protobuf import timestamp_pb2

    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("ros.sensor_msgs.JointState"))


def write_protobuf(path: Path, found: Sample) -> Path:
    """sensor_msgs/JointState in protobuf, by mcap-protobuf-support."""
    kind = joint_state_class()
    with path.open("wb") as stream, ProtobufWriter(stream) as writer:
        for topic, stamp, values in streams(found):
            message = kind(name=NAMES, position=values)
            message.header.stamp.FromNanoseconds(stamp)
            writer.write_message(topic, message, log_time=stamp, publish_time=stamp)
    return path


WRITERS: dict[str, Callable[[Path, Sample], Path]] = {
    "foxglove": write_foxglove, "json": write_json, "rosbag": write_rosbag, "protobuf": write_protobuf,
}  # fmt: skip


def test_a_file_that_broke_off_after_its_first_bytes_is_no_text(tmp_path: Path):
    (tmp_path / "log.mcap").write_bytes(b"\x89MCAP0\r\n and nothing more")
    assert detect(tmp_path / "log.mcap") == "mcap"


@pytest.mark.parametrize("kind", WRITERS)
def test_every_number_arrives(tmp_path: Path, kind: str):
    found = sample()
    source = WRITERS[kind](tmp_path / ("bag" if kind == "rosbag" else "bag.mcap"), found)
    assert detect(source) == "mcap"
    imported = import_logs(source, ARM, out=tmp_path / "logs")
    log = imported.logs[0]
    assert log.position.tolist() == found.position.tolist()
    assert log.command.tolist() == found.command.tolist()
    whole = EPOCH_NS // 10**9
    assert log.extra["clock_origin_s"] == str(whole)
    assert log.time.tolist() == [(stamp - whole * 10**9) / 10**9 for stamp in stamps(found)]
    assert log.label == source.stem
    assert {note.partition(": ")[2] for note in imported.notes} == {
        "state: names that are no joints dropped: gripper", "command: names that are no joints dropped: gripper",
    }  # fmt: skip


def test_a_folder_of_a_bag_is_read(tmp_path: Path):
    write_rosbag(tmp_path / "bag", sample())
    assert detect(tmp_path / "bag") == "mcap"
    assert len(import_logs(tmp_path / "bag", ARM, out=tmp_path / "logs").logs) == 1


def test_missing_stamps_are_told_and_half_missing_ones_refused(tmp_path: Path):
    bare = write_json(tmp_path / "bare.mcap", sample(), stamped=False)
    imported = import_logs(bare, ARM, out=tmp_path / "logs")
    assert any("times are those of the recording" in note for note in imported.notes)
    np.testing.assert_allclose(np.diff(imported.logs[0].time), 0.02, atol=1e-9)
    mixed = messages(tmp_path / "mixed.mcap", {
        "/joint_states": [state(k, 0) for k in range(5)], "/joint_commands": [state(k, k + 1) for k in range(5)],
    })  # fmt: skip
    with pytest.raises(FileError, match="messages on /joint_states have no stamps, the others do; set stamp to log"):
        import_logs(mixed, ARM, out=tmp_path / "other")
    log = import_logs(mixed, ARM, out=tmp_path / "other", options=ImportOptions(stamp="log")).logs[0]
    np.testing.assert_allclose(log.time, 0.02 * np.arange(5))


def test_topics_are_named_never_guessed(tmp_path: Path):
    source = messages(tmp_path / "own.mcap", {"/arm/a": [state(k, k) for k in range(5)], "/arm/b": [state(0, 0)] * 2})
    with pytest.raises(
        FileError,
        match=r"no topic /joint_states; .*/arm/a \(sensor_msgs/JointState, 5 messages, 50 Hz\).*--state-topic",
    ):
        import_logs(source, ARM, out=tmp_path / "logs")
    same = ImportOptions(state_topic="/arm/a", command_topic="/arm/a")
    with pytest.raises(FileError, match="cannot both come from /arm/a"):
        import_logs(source, ARM, out=tmp_path / "logs", options=same)


def test_messages_of_a_separate_gripper_are_left_out(tmp_path: Path):
    gripper = {"header": {"stamp": {"sec": 0, "nsec": 30}}, "name": ["gripper"], "position": [0.5]}
    states = [state(k, k) for k in range(8)]
    source = messages(
        tmp_path / "two.mcap",
        {
            "/joint_states": [states[0], gripper, *states[1:], gripper],
            "/joint_commands": [state(k, k) for k in range(8)],
        },
    )
    imported = import_logs(source, ARM, out=tmp_path / "logs")
    assert len(imported.logs[0]) == 8
    assert any("2 messages about other joints left out" in note for note in imported.notes)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"name": list(ARM.joint_names)[:3], "position": [0.0] * 3}, "message 4: no column for joint wrist_flex"),
        ({"name": list(ARM.joint_names), "position": [0.0] * 3}, "message 4: 5 names for 3 positions"),
        ({"name": [], "position": [0.0] * 5}, "message 4: 0 names for 5 positions; set --order"),
        ({"name": list(ARM.joint_names), "position": ["a"] * 5}, "message 4: no joint state"),
        ({"name": list(ARM.joint_names), "position": [0, 0, float("nan"), 0, 0]}, "message 4: elbow_flex is nan"),
        ([1, 2], "message 4: no joint state .it has no positions"),
    ],
)
def test_a_bad_message_is_named(tmp_path: Path, content: object, message: str):
    if isinstance(content, dict):
        content = {"header": {"stamp": {"sec": 0, "nsec": 60_000_001}}} | content
    states = [state(k, k) for k in range(8)]
    states[3] = content
    source = messages(
        tmp_path / "bad.mcap", {"/joint_states": states, "/joint_commands": [state(k, k) for k in range(8)]}
    )
    with pytest.raises(FileError, match=message):
        import_logs(source, ARM, out=tmp_path / "logs")
    assert not (tmp_path / "logs").exists()


def test_an_unset_position_is_no_zero(tmp_path: Path):
    context = foxglove.Context()
    with foxglove.open_mcap(tmp_path / "unset.mcap", context=context):
        for topic in ("/joint_states", "/joint_commands"):
            channel = JointStatesChannel(topic, context=context)
            for k in range(4):
                joints = [JointState(name=name, position=0.1 * k) for name in ARM.joint_names[:4]]
                joints.append(JointState(name="wrist_roll", velocity=1.0))
                channel.log(JointStates(timestamp=Timestamp(sec=1, nsec=20_000_000 * k), joints=joints), log_time=k)
    with pytest.raises(FileError, match="message 1: wrist_roll is nan"):
        import_logs(tmp_path / "unset.mcap", ARM, out=tmp_path / "logs")


def test_names_can_be_declared_where_there_are_none(tmp_path: Path):
    def bare(k: int) -> dict[str, object]:
        return state(k, k) | {"name": [], "position": [0.5, 0.1 * k, 0.0, 0.01 * k, 0.0, 0.2]}

    source = messages(
        tmp_path / "bare.mcap",
        {"/joint_states": [bare(k) for k in range(8)], "/joint_commands": [bare(k) for k in range(8)]},
    )
    order = ("gripper", "elbow_flex", "shoulder_pan", "shoulder_lift", "wrist_flex", "wrist_roll")
    log = import_logs(source, ARM, out=tmp_path / "logs", options=ImportOptions(joint_order=order)).logs[0]
    np.testing.assert_array_equal(log.position[3], [0.0, 0.03, 0.1 * 3, 0.0, 0.2])
    with pytest.raises(InputError, match="--order names a joint twice"):
        ImportOptions(joint_order=("elbow_flex", "elbow_flex"))


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    source = write_json(tmp_path / "bag.mcap", sample())
    with monkeypatch.context() as without:
        without.setattr("rejoint.system.extras.find_spec", lambda name: None if name == "mcap_ros2" else name)
        with pytest.raises(MissingExtraError, match=r"missing: mcap_ros2\); .* pip install 'rejoint\[logs\]'"):
            import_logs(source, ARM, out=tmp_path / "logs")
    monkeypatch.setitem(sys.modules, "mcap_ros2.decoder", None)
    with pytest.raises(InputError, match=r"pip install 'rejoint\[logs\]'"):
        import_logs(source, ARM, out=tmp_path / "logs")


def test_a_reader_that_loses_messages_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    source = write_json(tmp_path / "bag.mcap", sample())
    whole = mcap.reader.SeekingReader.iter_decoded_messages

    def lossy(self: object, **options: object) -> Iterator[object]:
        return (message for i, message in enumerate(whole(self, **options)) if i != 17)

    monkeypatch.setattr(mcap.reader.SeekingReader, "iter_decoded_messages", lossy)
    with pytest.raises(FileError, match="59 messages on /joint_commands, its statistics promise 60"):
        import_logs(source, ARM, out=tmp_path / "logs")


def test_a_changed_digit_is_found_by_its_checksum(tmp_path: Path):
    topics = {name: [state(k, k) for k in range(8)] for name in ("/joint_states", "/joint_commands")}
    source = messages(tmp_path / "bag.mcap", topics, compression=CompressionType.NONE)
    data = source.read_bytes()
    assert data.count(b"[0.5, 0.5,") == 2
    source.write_bytes(data.replace(b"[0.5, 0.5,", b"[0.6, 0.5,", 1))
    with pytest.raises(FileError, match="damaged or not readable"):
        import_logs(source, ARM, out=tmp_path / "logs")


@pytest.mark.parametrize(
    "layout", [{"use_chunking": False}, {"index_types": IndexType.NONE, "use_statistics": False}, BARE], ids=str
)
def test_an_index_is_not_needed(tmp_path: Path, layout: dict[str, object]):
    topics = {name: [state(k, k) for k in range(8)] for name in ("/joint_states", "/joint_commands")}
    log = import_logs(messages(tmp_path / "bag.mcap", topics, **layout), ARM, out=tmp_path / "logs").logs[0]
    np.testing.assert_array_equal(log.position, np.outer(0.1 * np.arange(8), np.ones(5)))


def state(row: int, stamp: int) -> dict[str, object]:
    time = {"sec": 0, "nsec": 20_000_000 * stamp}
    return {"header": {"stamp": time}, "name": list(ARM.joint_names), "position": [0.1 * row] * 5}


def messages(path: Path, topics: dict[str, list[object]], **layout: object) -> Path:
    """Write JSON messages 20 ms apart through the mcap library."""
    with path.open("wb") as stream:
        writer = Writer(stream, **layout)
        writer.start()
        schema = writer.register_schema("sensor_msgs/JointState", "jsonschema", b"{}")
        for topic, contents in topics.items():
            channel = writer.register_channel(topic, "json", schema)
            for row, content in enumerate(contents):
                time = 20_000_000 * row
                writer.add_message(channel, log_time=time, data=json.dumps(content).encode(), publish_time=time)
        writer.finish()
    return path
