"""MCAP files written by the Foxglove SDK and by the libraries of mcap.dev."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import foxglove
import numpy as np
import pytest
from foxglove.channels import JointStatesChannel
from foxglove.messages import JointState, JointStates, Timestamp
from log_samples import ARM, Sample, rows_of, sample
from mcap.writer import CompressionType, Writer

from rejoint.logs.importing import detect, import_logs
from rejoint.logs.joints import ImportOptions
from rejoint.system.errors import FileError

EPOCH_NS = 1_750_000_000_123_456_789
NAMES = [*ARM.joint_names, "gripper"]


def stamps(found: Sample) -> list[int]:
    return [EPOCH_NS + round(1e9 * float(time)) for time in found.time]


def streams(found: Sample) -> Iterator[tuple[str, int, list[float]]]:
    """Topic, stamp and positions of every message, each second one before the first."""
    rows = [*zip(stamps(found), rows_of(found.position), rows_of(found.command), strict=True)]
    for stamp, position, command in [rows[k ^ 1] for k in range(len(rows))]:
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
    """sensor_msgs/JointState in JSON."""
    topics: dict[str, list[object]] = {}
    for topic, stamp, values in streams(found):
        time = {"sec": stamp // 10**9 * stamped, "nsec": stamp % 10**9 * stamped}
        topics.setdefault(topic, []).append({"header": {"stamp": time}, "name": NAMES, "position": values})
    return messages(path, topics)


WRITERS: dict[str, Callable[[Path, Sample], Path]] = {"foxglove": write_foxglove, "json": write_json}


@pytest.mark.parametrize("kind", WRITERS)
def test_every_number_arrives(tmp_path, kind: str):
    found = sample()
    source = WRITERS[kind](tmp_path / "bag.mcap", found)
    assert detect(source) == "mcap"
    imported = import_logs(source, ARM, out=tmp_path / "logs")
    log = imported.logs[0]
    assert log.position.tolist() == found.position.tolist()
    assert log.command.tolist() == found.command.tolist()
    whole = EPOCH_NS // 10**9
    assert log.time.tolist() == [(stamp - whole * 10**9) / 10**9 for stamp in stamps(found)]
    assert log.label == source.stem
    assert {note.partition(": ")[2] for note in imported.notes} == {
        f"{group}: names that are no joints dropped: {group}.gripper" for group in ("position", "command")
    }


def test_without_all_stamps_the_times_of_the_recording_count(tmp_path):
    bare = write_json(tmp_path / "bare.mcap", sample(), stamped=False)
    imported = import_logs(bare, ARM, out=tmp_path / "logs", options=ImportOptions(force=True))
    assert any("times are those of the recording" in note for note in imported.notes)
    np.testing.assert_allclose(np.diff(imported.logs[0].time), 0.02, atol=1e-9)
    mixed = messages(
        tmp_path / "mixed.mcap",
        {
            "/joint_states": [state(k, 0) for k in range(5)],
            "/joint_commands": [state(k, k + 1) for k in range(5)],
        },
    )
    for out, options in (("other", ImportOptions()), ("log", ImportOptions(stamp="log"))):
        log = import_logs(mixed, ARM, out=tmp_path / out, options=options).logs[0]
        np.testing.assert_allclose(log.time, 0.02 * np.arange(5))


def test_a_changed_digit_is_found_by_its_checksum(tmp_path):
    topics = {name: [state(k, k) for k in range(8)] for name in ("/joint_states", "/joint_commands")}
    source = messages(tmp_path / "bag.mcap", topics, compression=CompressionType.NONE)
    data = source.read_bytes()
    assert data.count(b"[0.5, 0.5,") == 2
    source.write_bytes(data.replace(b"[0.5, 0.5,", b"[0.6, 0.5,", 1))
    with pytest.raises(FileError, match="damaged or not readable"):
        import_logs(source, ARM, out=tmp_path / "logs")


def state(row: int, stamp: int) -> dict[str, object]:
    time = {"sec": 0, "nsec": 20_000_000 * stamp}
    return {"header": {"stamp": time}, "name": list(ARM.joint_names), "position": [0.1 * row] * 5}


def messages(path: Path, topics: dict[str, list[object]], **layout: object) -> Path:
    """Write JSON messages 20 ms apart through the mcap library."""
    with path.open("wb") as stream:
        writer = Writer(stream, **layout)
        writer.start()
        for topic, contents in topics.items():
            kind = "JointTrajectoryControllerState" if "controller" in topic else "JointState"
            schema = writer.register_schema(f"control_msgs/{kind}", "jsonschema", b"{}")
            channel = writer.register_channel(topic, "json", schema)
            for row, content in enumerate(contents):
                time = 20_000_000 * row
                writer.add_message(channel, log_time=time, data=json.dumps(content).encode(), publish_time=time)
        writer.finish()
    return path


def test_a_controller_that_tells_its_state_on_two_topics_has_commands(tmp_path):
    position = [[0.1 * row] * 5 for row in range(8)]
    told = [
        {"joint_names": list(ARM.joint_names), "actual": {"positions": q}, "desired": {"positions": q[::-1]}}
        for q in position
    ]
    told = {f"/arm_controller/{name}": told for name in ("state", "controller_state")}
    source = messages(tmp_path / "bag.mcap", {"/joint_states": [state(k, k) for k in range(8)], **told})
    np.testing.assert_allclose(import_logs(source, ARM, out=tmp_path / "logs").logs[0].command, position)
