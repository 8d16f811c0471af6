"""Recordings of messages, whatever file they lie in: which topic holds what, and on which clock."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.arms import Arm
from rejoint.logs.messages import (
    ARRAY,
    NANOSECONDS,
    REMEDY,
    STATES,
    TRAJECTORY,
    Sample,
    goals_of,
    kind_of,
    points_of,
    samples_of,
    track_of,
)
from rejoint.logs.options import OPTIONS, ImportOptions
from rejoint.logs.track import RecordedMotion, Track
from rejoint.logs.trajectory import commands_of
from rejoint.system.errors import FileError, InputError
from rejoint.system.extras import require

STATE_TOPIC, COMMAND_TOPIC = "/joint_states", "/joint_commands"
"""Where ROS 2's joint_state_broadcaster publishes; and, chosen, its counterpart."""
POINT_TOPICS = {"target": "/target", "true_tcp": "/true_tcp"}
METADATA = "rejoint"
"""Name of the metadata record in which an exported log keeps what messages cannot hold."""
MESSAGES_MOST = 5_000_000
"""Most messages of a topic that are read (chosen: an hour at 1 kHz, and a half)"""
OTHER_INTERFACES = ("velocity", "effort", "gripper", "hand")
"""Words in the names of topics whose numbers are no positions of the arm's joints (chosen)"""

Message = tuple[int, Any]
"""time of recording [ns], and what a decoder made of it"""


@dataclass(frozen=True, kw_only=True)
class Topic:
    """One topic of a recording."""

    schema: str
    count: int
    seconds: float
    """[s] that the recording lasts"""

    def __str__(self) -> str:
        rate = f", {(self.count - 1) / self.seconds:.3g} Hz" if self.seconds > 0 and self.count > 1 else ""
        return f"({self.schema or 'no type'}, {self.count} message{'s' * (self.count != 1)}{rate})"


@dataclass(frozen=True, kw_only=True)
class Inventory:
    """What a recording holds."""

    topics: dict[str, Topic]
    header: dict[str, str]
    """what an exported log keeps beside its messages; empty for any other"""


@dataclass(frozen=True, kw_only=True)
class Store:
    """A kind of file that holds messages."""

    name: str
    inventory: Callable[[Path], Inventory]
    messages: Callable[[Path, set[str]], dict[str, list[Message]]]


def motions(
    store: Store, files: list[Path], arm: Arm, options: ImportOptions
) -> tuple[int, Iterator[RecordedMotion]]:  # fmt: skip
    """Count recordings and read them one by one."""
    return len(files), (_read(store, file, arm, options) for file in files)


def _read(store: Store, file: Path, arm: Arm, options: ImportOptions) -> RecordedMotion:
    with _reporting(store, file):
        inventory = store.inventory(file)
    state_topic = _state_topic(inventory, options, file)
    command_topic, notes = _command_topic(inventory, state_topic, options, file)
    names = {state_topic, *([command_topic] if command_topic else [])}
    points = POINT_TOPICS if inventory.header else {}
    for topic in names:
        _check_count(inventory.topics[topic], topic, file)
    with _reporting(store, file):
        messages = store.messages(file, names | {*points.values()})
    states = samples_of(messages.get(state_topic, []), file, state_topic, inventory.topics[state_topic].schema)
    commands = _Commands(file, command_topic, inventory, messages.get(command_topic or "", []))
    if options.joint_order and all(sample.names for sample in [*states, *commands.samples]):
        raise FileError(file, "all messages name their joints", "use --joints, not --order")
    stamp, remarks = _stamp(states, state_topic, commands, options, file)
    notes += remarks
    header = inventory.header
    if header and header.get("arm") != arm.name:
        notes.append(f"the log says that it is of arm {header.get('arm')}, it is taken as one of {arm.name}")
    time, track, remarks = track_of(states, stamp, (file, state_topic, "state"), arm, options)
    origin = min([time[0], *commands.first(stamp)]) // NANOSECONDS * NANOSECONDS
    origin = origin if origin > 10**17 else 0  # counted from 1970; smaller numbers a float64 resolves to 1e-8 s
    state = _on_clock(track, time, origin)
    command, more = commands.track(state, stamp, origin, arm, options)
    name, robot = header.get("label", file.stem), header.get("robot", f"{store.name}:{file.stem}")
    extra = {"source": file.name, "format": store.name}
    extra |= {"clock_origin_s": f"{origin // NANOSECONDS}"} if origin else {}
    return RecordedMotion(
        name=name, state=state, command=command, angle_unit=options.angle_unit or "rad", robot=robot,
        points={group: points_of(messages.get(topic, []), origin, file) for group, topic in points.items()},
        extra=_kept_extra(header, file) if header else extra, notes=(*notes, *remarks, *more),
    )  # fmt: skip


class _Commands:
    """The messages of the command topic, if there is one, whatever their form."""

    def __init__(self, file: Path, topic: str | None, inventory: Inventory, messages: list[Message]) -> None:
        self.file, self.topic, self.messages = file, topic, messages
        schema = inventory.topics[topic].schema if topic else ""
        self.kind = kind_of(schema)
        self.goals = goals_of(messages, file, topic or "") if self.kind == TRAJECTORY else []
        self.samples: list[Sample] = []
        if topic and self.kind != TRAJECTORY:
            self.samples = samples_of(messages, file, topic, schema)

    def stamped(self) -> bool | None:
        """Whether the messages say their time; None for a kind that cannot."""
        if self.kind == ARRAY:
            return None
        if self.kind == TRAJECTORY:  # an empty stamp asks for a start at once
            return True if all(goal.header_ns for goal in self.goals) else None
        return any(sample.header_ns for sample in self.samples)

    def first(self, stamp: str) -> list[int]:
        """Time [ns] of the first message."""
        found = (self.goals or self.samples)[:1]
        return [one.header_ns if stamp == "header" else one.log_ns for one in found]

    def track(
        self, state: Track, stamp: str, origin: int, arm: Arm, options: ImportOptions
    ) -> tuple[Track | None, list[str]]:
        if self.topic is None:
            return None, []
        if self.goals:
            return commands_of(self.goals, state, stamp, origin, (self.file, self.topic), arm, options), []
        time, track, notes = track_of(self.samples, stamp, (self.file, self.topic, "command"), arm, options)
        return _on_clock(track, time, origin), notes


@contextmanager
def _reporting(store: Store, file: Path) -> Iterator[None]:
    """Turn whatever the decoders raise on damaged bytes into a FileError."""
    require(f"{file}: reading {store.name}", "logs")
    try:
        yield
    except FileError:
        raise
    except ImportError as error:  # of what those bring themselves, such as decompressors
        raise InputError(
            f"{file}: {store.name} needs {error.name}; install it with: pip install 'rejoint[logs]'"
        ) from error
    except FileNotFoundError as error:
        raise FileError(file, "no such file", "check the path") from error
    # Decoders, decompressors and message compilers stand behind this; none lists what it raises.
    except Exception as error:
        reason = (str(error).splitlines() or [""])[0][:200]
        raise FileError(file, f"damaged or not readable ({type(error).__name__}: {reason})", REMEDY) from error


def _found(inventory: Inventory) -> str:
    named = [f"{name} {topic}" for name, topic in sorted(inventory.topics.items())]
    return (", ".join(named[:12]) or "none") + (f" and {len(named) - 12} more" if len(named) > 12 else "")


def _state_topic(inventory: Inventory, options: ImportOptions, file: Path) -> str:
    topic = options.state_topic or STATE_TOPIC
    if topic in inventory.topics:
        return topic
    raise FileError(file, f"no topic {topic}; found {_found(inventory)}", f"name one with {OPTIONS['state_topic']}")


def _command_topic(
    inventory: Inventory, state_topic: str, options: ImportOptions, file: Path
) -> tuple[str | None, list[str]]:  # fmt: skip
    """Choose the topic of the commands: the one named, ours, or the one that a controller can have; None for none."""
    option = f"name one with {OPTIONS['command_topic']}"
    topic = options.command_topic or COMMAND_TOPIC
    if topic == state_topic:
        raise FileError(file, f"states and commands cannot both come from {state_topic}", "name two topics")
    if topic in inventory.topics:
        return topic, []
    if options.command_topic is not None:
        raise FileError(file, f"no topic {topic}; found {_found(inventory)}", option)
    kinds = (*STATES, TRAJECTORY, ARRAY)
    able = {name: one for name, one in inventory.topics.items() if kind_of(one.schema) in kinds and name != state_topic}
    ours = [
        name for name, one in able.items()
        if kind_of(one.schema) not in STATES and not any(word in name for word in OTHER_INTERFACES)
    ]  # fmt: skip
    if len(ours) == 1:
        return ours[0], [f"commands from {ours[0]} {inventory.topics[ours[0]]}"]
    if able:
        raise FileError(file, f"no topic {topic}; found {_found(inventory)}", option)
    return None, [f"no topic with commands; found {_found(inventory)}"]


def _check_count(topic: Topic, name: str, file: Path) -> None:
    if topic.count > MESSAGES_MOST:
        raise FileError(file, f"{topic.count} messages on {name}, expected at most {MESSAGES_MOST}", "cut it in parts")


def _stamp(
    states: list[Sample], state_topic: str, commands: _Commands, options: ImportOptions, file: Path
) -> tuple[str, list[str]]:
    """Choose between the stamps in the messages and the times of recording; both topics take the same."""
    for topic, found in ((state_topic, states), (commands.topic, commands.messages)):
        if topic is not None and not found:
            raise FileError(file, f"no message on {topic}", "record it again or name another topic")
    told = "times are those of the recording"
    if options.stamp is not None:
        return options.stamp, []
    stamped = any(sample.header_ns for sample in states)
    if commands.topic is None or commands.stamped() == stamped:
        return ("header", []) if stamped else ("log", [f"{told}, the messages have no stamps"])
    if commands.stamped() is None:
        return "log", [f"{told}, the commands on {commands.topic} have no stamps"]
    bare = commands.topic if stamped else state_topic
    raise FileError(file, f"the messages on {bare} have no stamps, the others do", "set stamp to log for both")


def _on_clock(track: Track, stamps: list[int], origin: int) -> Track:
    """Fill in the times: whole nanoseconds are subtracted before they become float64, which keeps them exact."""
    return replace(track, time=np.array([(stamp - origin) / NANOSECONDS for stamp in stamps]))


def _kept_extra(header: dict[str, str], file: Path) -> dict[str, str]:
    try:
        extra = json.loads(header.get("extra", "{}"))
        return {str(key): str(value) for key, value in extra.items()}
    except (ValueError, AttributeError, RecursionError) as error:
        raise FileError(file, f"metadata {METADATA} is damaged ({error})", REMEDY) from error
