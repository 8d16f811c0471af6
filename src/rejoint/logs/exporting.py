"""Run logs for other programs: CSV for any of them, MCAP for PlotJuggler, Foxglove and Rerun.

MCAP is written as ROS 2 does: ``sensor_msgs/msg/JointState`` in CDR with its ``ros2msg`` definition in the
file. That is the one form of joint states that all three draw without a plug-in: Rerun turns ROS 2
messages into plots but not JSON (rerun.io/docs/reference/mcap), PlotJuggler's MCAP loader parses ``cdr``
with ``ros2msg`` schemas (PlotJuggler/PlotJuggler, issue 878), and Foxglove reads ROS 2 bags
(docs.foxglove.dev/docs/visualization/message-schemas/introduction).
"""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.logs.bags import COMMAND_TOPIC, METADATA, POINT_TOPICS, STATE_TOPIC
from rejoint.logs.messages import NANOSECONDS
from rejoint.logs.runlog import AXES, RunLog
from rejoint.system.errors import InputError
from rejoint.system.extras import require
from rejoint.system.files import write_whole

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
"""Definitions: github.com/ros2/common_interfaces and rcl_interfaces, folders msg."""

_LAST_SECOND = 2**31
"""The stamp of a ROS 2 message counts seconds in an int32."""


def export_log(log: RunLog, path: Path) -> None:
    """Write a log as ``.csv`` or ``.mcap``, whole or not at all.

    CSV keeps every bit of the five arrays. MCAP keeps every bit of the angles and positions, and the label,
    robot and ``extra`` in a metadata record; its clock counts nanoseconds, to which times are rounded.
    Raises InputError for another ending or times that MCAP cannot hold.
    """
    if path.suffix == ".csv":
        write_whole(path, lambda temporary: _write_csv(log, temporary))
    elif path.suffix == ".mcap":
        stamps = _stamps(log)
        write_whole(path, lambda temporary: _write_mcap(log, stamps, temporary))
    else:
        raise InputError(f"{path}: a log is exported to .csv or .mcap, not to {path.suffix or 'a name without ending'}")


def _write_csv(log: RunLog, path: Path) -> None:
    titles, columns = ["time_s"], [log.time]
    for group in ("position", "command") if log.commanded else ("position",):
        titles += [f"{group}.{name}_rad" for name in log.joint_names]
        columns += list(getattr(log, group).T)
    for group in ("target", "true_tcp"):
        if not np.isnan(getattr(log, group)).all():
            titles += [f"{group}.{axis}_m" for axis in AXES]
            columns += list(getattr(log, group).T)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(titles)
        for row in np.stack(columns, axis=-1).tolist():
            # repr gives the shortest text that reads back as the same float64; NaN becomes an empty cell
            writer.writerow(["" if value != value else repr(value) for value in row])


def _stamps(log: RunLog) -> list[int]:
    stamps = [round(float(time) * NANOSECONDS) for time in log.time]
    if stamps and (stamps[0] < 0 or stamps[-1] >= _LAST_SECOND * NANOSECONDS):
        raise InputError(f"log {log.label}: times from {log.time[0]:g} to {log.time[-1]:g} s do not fit a ROS stamp")
    if len(set(stamps)) != len(stamps):
        raise InputError(f"log {log.label}: rows less than a nanosecond apart; export it to .csv")
    return stamps


def _write_mcap(log: RunLog, stamps: list[int], path: Path) -> None:
    require("exporting MCAP (a .csv file would do without)", "logs")
    from mcap_ros2.writer import Writer

    with path.open("wb") as stream, Writer(stream) as writer:
        writer.add_metadata(
            METADATA, {"arm": log.arm, "robot": log.robot, "label": log.label, "extra": json.dumps(log.extra)}
        )
        joints = writer.register_msgdef("sensor_msgs/msg/JointState", _JOINT_STATE)
        point = writer.register_msgdef("geometry_msgs/msg/PointStamped", _POINT_STAMPED)
        for row, stamp in enumerate(stamps):
            header = {"stamp": {"sec": stamp // NANOSECONDS, "nanosec": stamp % NANOSECONDS}, "frame_id": "base"}
            messages: list[tuple[str, Any, dict[str, Any]]] = [
                (
                    topic,
                    joints,
                    {"name": list(log.joint_names), "position": values.tolist(), "velocity": [], "effort": []},
                )
                for topic, values in ((STATE_TOPIC, log.position[row]), (COMMAND_TOPIC, log.command[row]))
                if log.commanded or topic == STATE_TOPIC
            ]
            for group, topic in POINT_TOPICS.items():
                values = getattr(log, group)[row]
                if not np.isnan(values).all():
                    messages.append((topic, point, {"point": dict(zip(AXES, values.tolist(), strict=True))}))
            for topic, schema, content in messages:
                writer.write_message(topic, schema, {"header": header, **content}, log_time=stamp)
