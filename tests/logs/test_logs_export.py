"""Logs on their way out and back, and through the readers of other projects."""

import numpy as np
import pytest
from log_samples import ARM, sample
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from rejoint.logs.exporting import export_log
from rejoint.logs.importing import import_logs
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError


def run_log(seed: int = 0, time: np.ndarray | None = None) -> RunLog:
    found = sample()
    rng = np.random.default_rng(seed)
    target, tcp = rng.normal(size=(2, 60, 3))
    target[:10] = np.nan
    return RunLog(
        arm="so101",
        joint_names=ARM.joint_names,
        robot="emulated:worn",
        label="hold/policy/0/2",
        time=found.time + np.cumsum(rng.uniform(0, 1e-3, 60)) if time is None else time,
        position=found.position + rng.normal(0, 1e-4, (60, 5)),
        command=found.command,
        target=target,
        true_tcp=tcp,
        extra={"seed": "7", "profile": "worn"},
    )


def same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    return a.shape == b.shape and a.tobytes() == b.tobytes()


@pytest.mark.parametrize("ending", ["csv", "mcap"])
@pytest.mark.parametrize("seed", range(3))
def test_logs_come_back_bit_for_bit(tmp_path, seed: int, ending: str):
    log = run_log(seed)
    for turn in range(2):
        export_log(log, tmp_path / f"{turn}.{ending}")
        (back,) = import_logs(tmp_path / f"{turn}.{ending}", ARM, out=tmp_path / f"{turn}").logs
        assert np.abs(log.time - back.time).max() <= (0.5e-9 if ending == "mcap" and turn == 0 else 0.0)
        for name in ("position", "command") + (("target", "true_tcp") if ending == "csv" else ()):
            assert same_bits(getattr(log, name), getattr(back, name)), name
        log = back


def test_rosbags_reads_the_mcap_with_its_own_definitions(tmp_path):
    log = run_log()
    export_log(log, tmp_path / "log.mcap")
    store = get_typestore(Stores.ROS2_JAZZY)
    found, texts = {}, {}
    with (tmp_path / "log.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        for schema, channel, message in reader.iter_messages():
            assert (channel.message_encoding, schema.encoding) == ("cdr", "ros2msg")
            content = store.deserialize_cdr(message.data, schema.name)
            stamp = content.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == message.log_time
            found.setdefault(channel.topic, []).append(content)
            texts[schema.name] = schema.data.decode()
    assert [list(state.name) for state in found["/joint_states"]] == [list(ARM.joint_names)] * 60
    for topic, values in (("/joint_states", log.position), ("/joint_commands", log.command)):
        assert same_bits(np.array([state.position for state in found[topic]]), values)
    points = np.array([[p.point.x, p.point.y, p.point.z] for p in found["/target"]])
    assert same_bits(points, log.target[10:])
    # the definition in the file is the one that ROS 2 ships
    kind = "sensor_msgs/msg/JointState"
    own = get_typestore(Stores.EMPTY)
    own.register(get_types_from_msg(texts[kind], kind))
    assert own.hash_rihs01(kind) == store.hash_rihs01(kind)


def test_what_cannot_be_exported_leaves_nothing(tmp_path):
    with pytest.raises(InputError, match=r"exported to .csv or .mcap, not to .xlsx"):
        export_log(run_log(), tmp_path / "log.xlsx")
    with pytest.raises(InputError, match="do not fit a ROS stamp"):
        export_log(run_log(time=np.arange(60) - 5.0), tmp_path / "log.mcap")
    assert list(tmp_path.iterdir()) == []
