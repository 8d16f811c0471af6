"""Run logs as CSV, and as MCAP for PlotJuggler, Foxglove and Rerun.

MCAP holds ``sensor_msgs/msg/JointState`` in CDR with its ``ros2msg`` definition, which all three read.
"""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv

from rejoint.logs.readers import COMMAND_TOPIC, NANOSECONDS, STATE_TOPIC
from rejoint.logs.runlog import AXES, RunLog
from rejoint.system.errors import InputError
from rejoint.system.extras import require
from rejoint.system.files import write_whole

POINT_TOPICS = {"target": "/target", "true_tcp": "/true_tcp"}
_SEPARATOR = "=" * 80
_HEADER = f"""{_SEPARATOR}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_SEPARATOR}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_JOINT_STATE = f"""std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
{_HEADER}"""
_POINT_STAMPED = f"""std_msgs/Header header
geometry_msgs/Point point
{_HEADER}{_SEPARATOR}
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
"""
"""github.com/ros2/common_interfaces and rcl_interfaces, folders msg"""

_LAST_SECOND = 2**31
"""ROS 2 stamps are int32 seconds"""


def export_log(log: RunLog, path: Path) -> None:
    """Write a log as ``.csv`` or ``.mcap``, whole or not at all.

    MCAP rounds times to nanoseconds. InputError for another ending or impossible times.
    """
    if path.suffix == ".csv":
        write_whole(path, lambda temporary: _write_csv(log, temporary))
    elif path.suffix == ".mcap":
        require("exporting MCAP (a .csv file would do without)", "logs")
        write_whole(path, lambda temporary: _write_mcap(log, temporary))
    else:
        raise InputError(f"{path}: a log is exported to .csv or .mcap, not to {path.suffix or 'a name without ending'}")


def _write_csv(log: RunLog, path: Path) -> None:
    units = {"position": "rad", "command": "rad", "target": "m", "true_tcp": "m"} | log.units
    columns = {"time_s": log.time}
    for group in ("position", "command", "torque", "current", "gain", "target", "true_tcp"):
        values = getattr(log, group)
        if values is not None and not np.isnan(values).all():
            ending = f"_{units[group].replace(' ', '')}" if units.get(group) else ""
            columns |= {f"{group}.{name}{ending}": values[:, i] for i, name in enumerate(log.parts(group))}
    # Arrow writes the shortest text that reads back as the same float64; NaN becomes an empty cell
    table = pa.table({name: pa.array(values, from_pandas=True) for name, values in columns.items()})
    with path.open("wb") as file:
        file.write(f"{','.join(columns)}\n".encode())
        pacsv.write_csv(table, file, pacsv.WriteOptions(include_header=False))


def _write_mcap(log: RunLog, path: Path) -> None:
    from mcap_ros2.writer import Writer

    stamps = np.round(log.time * NANOSECONDS)
    if ((stamps < 0) | (stamps >= _LAST_SECOND * NANOSECONDS)).any():
        raise InputError(f"log {log.label}: times from {log.time[0]:g} to {log.time[-1]:g} s do not fit a ROS stamp")
    with path.open("wb") as stream, Writer(stream) as writer:
        joints = writer.register_msgdef("sensor_msgs/msg/JointState", _JOINT_STATE)
        point = writer.register_msgdef("geometry_msgs/msg/PointStamped", _POINT_STAMPED)
        none = np.zeros((len(log), 0))
        torque = log.torque if log.torque is not None and log.units.get("torque") == "N m" else none
        joint_topics = {STATE_TOPIC: (log.position, torque)}
        if log.commanded:
            joint_topics[COMMAND_TOPIC] = (log.command, none)
        for row, stamp in enumerate(stamps.astype(np.int64).tolist()):
            header = {"stamp": {"sec": stamp // NANOSECONDS, "nanosec": stamp % NANOSECONDS}, "frame_id": "base"}
            for topic, (position, effort) in joint_topics.items():
                content = {
                    "header": header,
                    "name": list(log.joint_names),
                    "position": position[row].tolist(),
                    "velocity": [],
                    "effort": effort[row].tolist(),
                }
                writer.write_message(topic, joints, content, log_time=stamp)
            for group, topic in POINT_TOPICS.items():
                place = getattr(log, group)[row].tolist()
                if not np.isnan(place).all():
                    content = {"header": header, "point": dict(zip(AXES, place, strict=True))}
                    writer.write_message(topic, point, content, log_time=stamp)
