"""Readers of files and folders with columns: SAGE, tables, LeRobot's datasets, bags of ROS 1 and 2, MCAP files.

SAGE (github.com/isaac-sim2real/sage): a folder per motion. ``control.csv`` (type, timestamp, positions) holds commands,
``state_motor.csv`` states, in the order of ``joint_list.txt``, in microseconds and radians. Tables: text, JSON records,
NumPy archives. LeRobot, versions 2 and 3 (huggingface/lerobot, folder ``datasets``): ``observation.state`` was
measured, ``action`` sent; each episode is one log.

Messages of bags are ``sensor_msgs/JointState``, ``foxglove.JointStates`` (docs.foxglove.dev/docs/sdk/schemas),
``control_msgs/JointTrajectoryControllerState`` and ``std_msgs/Float64MultiArray``. A trajectory's goals do not tell
what was commanded: the controller's state does.
"""

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from rejoint.arms import Array
from rejoint.logs.columns import RawMotion
from rejoint.logs.joints import NAMES, TIME_UNITS, ImportOptions, ordered
from rejoint.logs.runlog import LOG_MOST, read_parquet
from rejoint.system.errors import FileError, InputError, first_line
from rejoint.system.extras import require
from rejoint.system.files import begins_with, read_bounded, reading, require_file
from rejoint.system.numbers import as_floats
from rejoint.system.textfile import TEXT_MOST, head, read_sheet, shown


class Reader(NamedTuple):
    """Reads one format."""

    fits: Callable[[Path, bool], bool]
    """whether it reads a file or folder, which was named itself, or else its folder was"""
    read: Callable[[Path, ImportOptions], Iterable[RawMotion]]
    """the motions in it"""

    def found(self, source: Path) -> list[Path]:
        """Return what it reads at a path: in a folder and in folders there, sorted."""
        if self.fits(source, True):
            return [source]
        return [path for depth in ("*", "*/*") for path in sorted(source.glob(depth)) if self.fits(path, False)]


_CONTROL, _STATE, _JOINTS = "control.csv", "state_motor.csv", "joint_list.txt"
_CUT = "cut it into several motions"


def _read_sage(folder: Path, options: ImportOptions) -> list[RawMotion]:
    file = folder / _JOINTS
    with reading(file, "a SAGE motion needs it, and it is no readable text", "copy it"):
        text = read_bounded(file, _CUT).decode("utf-8-sig")
    names = [name.strip() for name in text.splitlines() if name.strip()]
    ticks = TIME_UNITS[options.time_unit or "us"]
    sent = _sage_motion(folder / _CONTROL, names, "command", ticks)
    return [_sage_motion(folder / _STATE, names, "position", ticks).with_commands(sent)]


def _sage_motion(path: Path, names: list[str], group: str, ticks: float) -> RawMotion:
    sheet, remedy = read_sheet(path), f"mend the line or leave this motion out; {_JOINTS} names the joints"
    if sheet.titles[1:3] != ("timestamp", "positions"):
        raise FileError(path, f"line 1: columns {shown(sheet.titles)}, expected type, timestamp, positions", remedy)
    values = np.empty((len(sheet), len(names)))
    for row, text in enumerate(sheet.words(2)):
        with reading(path, f"line {sheet.lines[row]}: {text[:40]!r} are no {len(names)} positions", remedy):
            numbers = json.loads(text)
            values[row] = numbers if len(numbers) == len(names) else "of another length"
    return RawMotion.of(
        path.parent.resolve().name,
        path,
        {f"{group}.{name}": numbers for name, numbers in zip(names, values.T, strict=True)},
        time=sheet.numbers([1])[:, 0] / ticks,
        number=sheet.lines,
        place="line",
        angle_unit="rad",
    )


_ENDINGS = (".tsv", ".txt", ".dat", ".log")
_AGAIN = "record it again, or write its columns as text"


def _is_table(file: Path, named: bool) -> bool:
    suffix = file.suffix.lower()
    # what calls itself a table is refused by name where it is none
    return file.is_file() and (
        suffix in (".csv", *_KINDS) or ((named or suffix in _ENDINGS) and head(file) is not None)
    )


def _read_table(file: Path, options: ImportOptions) -> list[RawMotion]:
    if read := _KINDS.get(file.suffix.lower()):
        columns, found = read(file)
        return [RawMotion.of(file.stem, file, columns, found=found)]
    sheet = read_sheet(file, whole=False)
    return [
        RawMotion(
            name=file.stem,
            path=file,
            titles=tuple(ordered(sheet.titles, options)),
            values=sheet.numbers,
            number=sheet.lines,
            place="line",
            found=sheet.found,
            notes=sheet.remarks,
            time_unit="s" if sheet.dated else None,
        )
    ]


def _records(file: Path) -> tuple[dict[str, Array], str]:
    """Columns of JSON: a list of records, also one in each line, or lists of numbers by name."""
    with reading(file, "JSON without one list of records, or lists, of numbers", _AGAIN):
        text = read_bounded(file, "cut it into several files", TEXT_MOST)
        try:
            data = json.loads(text)
        except ValueError:
            *whole, last = [line for line in text.splitlines() if line.strip()]
            data = [json.loads(line) for line in whole or [last]]
            with suppress(ValueError):  # a recorder that was killed left a part of it
                data.append(json.loads(last))
        held = dict(_flat(data))
        tables = [key for key, one in held.items() if isinstance(one, list) and one and isinstance(one[0], dict)]
        if not tables:
            return _columns(held), "JSON with columns"
        (rows,) = map(held.pop, tables)
        rows = [held | dict(_flat(row, dict | list)) for row in rows]
        names = dict.fromkeys(name for row in rows for name in row)
        return _columns({name: [row.get(name) for row in rows] for name in names}), "JSON with records"


def _flat(value: object, kinds: Any = dict, name: str = "") -> Iterator[tuple[str, Any]]:  # noqa: ANN401 - or a union
    """Yield what dicts and lists of these ``kinds`` hold, with the `_title` of each part."""
    if isinstance(value, kinds):
        for part, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _flat(inner, kinds, _title(name, part))
    else:
        yield name, value


def _title(name: str, part: str | int) -> str:
    """NAME.KEY or NAME_0 of a part."""
    return f"{name}{'_' if isinstance(part, int) else '.' * bool(name)}{part}"


def _archive(file: Path) -> tuple[dict[str, Array], str]:
    with reading(file, "no archive of NumPy arrays", _AGAIN):
        require_file(file, LOG_MOST, "cut it into several files")
        with np.load(file, allow_pickle=False) as arrays:
            return _columns(arrays), "a NumPy archive"


def _columns(held: Mapping[str, Any]) -> dict[str, Array]:
    """Columns of numbers of the usual length; (T, n) become NAME_0 and so on."""
    found = {}
    for name, one in held.items():
        with suppress(InputError):
            values = as_floats(name, one)
            if values.ndim == 1:
                found[name] = values
            elif values.ndim == 2:
                found |= {_title(name, i): column for i, column in enumerate(values.T)}
    lengths = [*map(len, found.values())]
    rows = max(lengths, key=lengths.count, default=0)
    return {name: one for name, one in found.items() if len(one) == rows}


_KINDS = {".npz": _archive, ".json": _records, ".jsonl": _records}
_INFO = "meta/info.json"
_GROUPS = {"position": ("observation.state", "state"), "command": ("action", "actions")}
_SCALARS = ("frame_index", "timestamp", "episode_index")
_TOLERANCE = 1e-4
"""[s] ``tolerance_s`` of LeRobotDataset"""
_REMEDY = "download or record the dataset again"


def _episodes(source: Path, options: ImportOptions) -> Iterator[RawMotion]:
    path = source / _INFO
    with reading(path, "damaged", _REMEDY):
        data = json.loads(read_bounded(path, _REMEDY))
        version, fps, frames = str(data["codebase_version"]), float(data["fps"]), int(data["total_frames"])
        if not version.startswith(("v2.", "v3.")):
            raise FileError(
                path, f"dataset version {version}, expected v2 or v3", "convert it with LeRobot's converter"
            )
        if not 0 < fps < np.inf:
            raise FileError(path, f"fps is {fps}", _REMEDY)
        features = data["features"]
        keys = [next((one for one in ones if one in features), "") for ones in _GROUPS.values()]
        if not all(keys):
            expected = " and ".join(" or ".join(ones) for ones in _GROUPS.values())
            raise FileError(
                path, f"features {', '.join(features)}, expected {expected}", "rename them, here and in data"
            )
        names = [_names(features[key], options, path, key) for key in keys]
    if options.angle_unit is None:
        said = f"a LeRobot dataset does not say the unit of {' and '.join(keys)}"
        remedy = "set --angle-unit: deg or rad, or normalised, with the calibration file where you have it"
        raise FileError(path, said, remedy)
    held, left_out = _read_frames(source, keys)
    index, stamps, episodes = (held.pop(key)[:, 0] for key in _SCALARS)
    if len(index) != frames:
        said = "; ".join([f"{len(index)} frames in data, but {_INFO} promises {frames}", *left_out])
        raise FileError(source, said, _REMEDY)
    with reading(source, "frames of another width than its names", _REMEDY):
        columns = {
            f"{group}.{name}": one
            for group, known, key in zip(_GROUPS, names, keys, strict=True)
            for name, one in zip(known, held[key].T, strict=True)
        }
    for number in np.unique(episodes).astype(int).tolist():
        rows = np.flatnonzero(episodes == number)
        rows = rows[np.argsort(index[rows], kind="stable")]
        nominal, measured, name = index[rows] / fps, stamps[rows], f"episode_{number:06d}"
        even = bool((np.abs(measured - nominal) < _TOLERANCE).all())
        said = "are" if even else "differ from"
        note = f"the stamps {said} frame numbers over {fps:g} Hz" + ", no measured times" * even
        yield RawMotion.of(
            name,
            source,
            {title: column[rows] for title, column in columns.items()},
            time=nominal if even else measured,
            number=rows + 1,
            place=f"{name}, row",
            found="a LeRobot dataset",
            notes=[note, *left_out],
        )


def _names(feature: dict[str, object], options: ImportOptions, path: Path, key: str) -> list[str]:
    shape, held = feature["shape"], feature["names"]
    if isinstance(held, dict) and len(held) == 1:
        held = next(iter(held.values()))
    if not isinstance(held, list):
        held = options.names
    if not held or shape != [len({*map(str, held)})]:
        raise FileError(path, f"{key} has the shape {shape} and the names {held}", "name all columns with --order")
    return [str(name) for name in held]


def _read_frames(source: Path, features: Sequence[str]) -> tuple[dict[str, Array], list[str]]:
    """State, action and scalars (T, k) of all frames, and which files hold others."""
    files = sorted((source / "data").glob("*/*.parquet"))
    if not files:
        raise FileError(source / "data", "no Parquet file in it", _REMEDY)
    keys, found, left_out = [*features, *_SCALARS], [], []
    for file in files:
        try:
            with reading(file, "not the frames of a dataset", _REMEDY):
                table = read_parquet(file, _REMEDY, keys)
                found.append([np.array(table[key].to_pylist(), dtype=float).reshape(len(table), -1) for key in keys])
        except FileError as error:
            left_out.append(f"left out: {file.name}, {error.problem}")
    if not found:
        raise FileError(source / "data", f"{len(files)} files, none with frames; {left_out[0]}", _REMEDY)
    with reading(source, "files of different width", _REMEDY):
        return {key: np.concatenate(parts) for key, parts in zip(keys, zip(*found, strict=True), strict=True)}, left_out


NANOSECONDS = 1_000_000_000
REMEDY = (
    "name the folder of a ROS 2 bag, record it again, or save what is whole with `mcap recover` or `ros2 bag reindex`"
)
_RECORD_LIMIT = 1 << 28
"""[bytes] (chosen: larger than recorded chunks)"""

Opened = tuple[dict[str, str], Callable[[set[str]], Iterator[tuple[str, int, Any]]]]
"""Types by topic; and decoded messages of some, with topic and time of recording [ns]"""
Opener = Callable[[Path], AbstractContextManager[Opened]]


@contextmanager
def _open_mcap(file: Path) -> Iterator[Opened]:
    from mcap.decoder import DecoderFactory
    from mcap.reader import SeekingReader
    from mcap_protobuf.decoder import DecoderFactory as ProtobufFactory
    from mcap_ros2.decoder import DecoderFactory as Ros2Factory

    class JsonFactory(DecoderFactory):
        def decoder_for(self, message_encoding: str, schema: object) -> Callable[[bytes], Any] | None:  # noqa: ARG002
            return json.loads if message_encoding == "json" else None

    factories = [Ros2Factory(), ProtobufFactory(), JsonFactory()]
    with file.open("rb") as stream:
        reader = SeekingReader(stream, validate_crcs=True, record_size_limit=_RECORD_LIMIT, decoder_factories=factories)
        summary = reader.get_summary()
        if summary is None:
            channels = ((schema, channel) for schema, channel, _ in reader.iter_messages(log_time_order=False))
        else:
            channels = ((summary.schemas.get(one.schema_id), one) for one in summary.channels.values())

        def messages(topics: set[str]) -> Iterator[tuple[str, int, Any]]:
            for _, channel, message, content in reader.iter_decoded_messages(topics=[*topics], log_time_order=False):
                yield channel.topic, message.log_time, content

        yield {channel.topic: schema.name if schema else "" for schema, channel in channels}, messages


@contextmanager
def _open_rosbag(source: Path) -> Iterator[Opened]:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    for file in filter(Path.is_file, source.iterdir()) if source.is_dir() else [source]:
        require_file(file, LOG_MOST, "cut it into several bags")
        unwritten = file.with_name(f"{file.name}-wal")
        if unwritten.is_file() and unwritten.stat().st_size:
            raise FileError(file, f"was not closed: part of it is still in {unwritten.name}", "run `ros2 bag reindex`")
    # bags that hold no definitions: messages about joints are the same in all distributions
    with AnyReader([source], default_typestore=get_typestore(Stores.LATEST)) as bag:

        def messages(topics: set[str]) -> Iterator[tuple[str, int, Any]]:
            chosen = [connection for connection in bag.connections if connection.topic in topics]
            for connection, time, data in bag.messages(connections=chosen):
                yield connection.topic, time, bag.deserialize(data, connection.msgtype)

        yield {name: info.msgtype or "" for name, info in bag.topics.items()}, messages


STATES = ("JointState", "JointStates")
"""Message types with joint positions and names"""
ARRAY, CONTROLLER = "Float64MultiArray", "JointTrajectoryControllerState"
STATE_TOPIC, COMMAND_TOPIC = "/joint_states", "/joint_commands"
"""As of ROS 2's joint_state_broadcaster; and, chosen, its counterpart"""
OTHER_INTERFACES, TOOLS = ("velocity", "effort"), ("gripper", "hand")
"""Words in topics without joint positions, and without joints of an arm (chosen)"""


class Message(NamedTuple):
    """Joints in one message of states or commands."""

    stamp: int
    """[ns] of the message, or 0"""
    logged: int
    """[ns] of the recording"""
    columns: Mapping[str, float]
    """``position.elbow`` and the like"""


def _read(opened: Opener, file: Path, options: ImportOptions) -> list[RawMotion]:
    require(f"{file}: reading bags", "logs")
    notes: list[str] = []
    found: dict[str, list[Message]] = {}
    try:
        with opened(file) as (held, read):
            groups = _topics(held, options, file, notes)
            for topic, time, content in read({*groups}):
                messages = found.setdefault(topic, [])
                said = f"topic {topic}, message {len(messages) + 1}: no positions to read in {held[topic] or 'no type'}"
                with reading(file, said, "name a topic with sensor_msgs/JointState, or record it again"):
                    messages.append(_message(content, groups[topic], time, options))
    except FileError:
        raise
    # Decoders, decompressors and message compilers stand behind this; none lists what it raises.
    except Exception as error:
        said = f"damaged or not readable ({type(error).__name__}: {first_line(error)[:200]})"
        raise FileError(file, said, REMEDY) from error
    if silent := [topic for topic in groups if topic not in found]:
        raise FileError(file, f"no message on {silent[0]}", "record it again or name another topic")
    bare = [topic for topic, messages in found.items() if not any(one.stamp for one in messages)]
    stamped = options.stamp == "header" or (options.stamp is None and not bare)
    if options.stamp is None and bare:
        notes.append(f"times are those of the recording, messages on {bare[0]} have no stamps")
    clocks = {
        topic: np.array([one.stamp if stamped else one.logged for one in messages]) for topic, messages in found.items()
    }
    origin = min(int(clock.min()) for clock in clocks.values()) // NANOSECONDS * NANOSECONDS
    origin = origin if origin > 10**17 else 0  # counted from 1970; smaller numbers a float64 resolves to 1e-8 s

    def motion(topic: str) -> RawMotion:
        titles = dict.fromkeys(title for one in found[topic] for title in one.columns)
        return RawMotion.of(
            file.stem,
            file,
            {title: np.array([one.columns.get(title, np.nan) for one in found[topic]]) for title in titles},
            # whole nanoseconds are subtracted before they become float64, which keeps them exact
            time=(clocks[topic] - origin) / NANOSECONDS,
            notes=notes,
            place=f"topic {topic}, message",
            angle_unit="rad",
            found=f"topic {topic}",
        )

    state, *sent = map(motion, groups)
    return [state.with_commands(*sent) if sent else state]


def _topics(held: dict[str, str], options: ImportOptions, file: Path, notes: list[str]) -> dict[str, str]:
    kinds = {name: schema.replace("/", ".").rpartition(".")[2] for name, schema in held.items()}
    found = shown([f"{name} ({held[name] or 'no type'})" for name in sorted(held)])
    state, command = options.state_topic, options.command_topic

    def only(of: str, without: Sequence[str], option: str, *, needed: bool = True) -> str | None:
        able = {n for n, kind in kinds.items() if kind == of and n != state and not any(word in n for word in without)}
        able -= {f"{n.removesuffix('controller_state')}state" for n in able}  # ROS Humble's older name
        if len(able) > 1 and needed:
            raise FileError(file, f"several topics with {of}: {shown(sorted(able))}", f"name one with {option}")
        if len(able) != 1:
            return None
        (name,) = able
        notes.append(f"commands from {name} ({held[name]})")
        return name

    if not (state or command or COMMAND_TOPIC in held):
        state = only(CONTROLLER, TOOLS, "--state-topic", needed=STATE_TOPIC not in held)
    state = state or STATE_TOPIC
    if state not in held:
        raise FileError(file, f"no topic {state}; found {found}", "name one with --state-topic")
    if kinds[state] == CONTROLLER:
        return {state: "position"}
    if not (command or COMMAND_TOPIC in held):
        command = only(ARRAY, (*TOOLS, *OTHER_INTERFACES), "--command-topic")
    if not (command or any(kind in (*STATES, ARRAY) for name, kind in kinds.items() if name != state)):
        notes.append(f"no topic with commands; found {found}")
        return {state: "position"}
    command = command or COMMAND_TOPIC
    if command not in held or command == state:
        raise FileError(
            file, f"no topic {command} beside that of the states; found {found}", "name one with --command-topic"
        )
    return {state: "position", command: "command"}


def _message(content: Any, group: str, logged: int, options: ImportOptions) -> Message:  # noqa: ANN401
    """Joints of a decoded message; TypeError, ValueError."""
    held = {key: _some(content, paths) for key, paths in NAMES["messages"].items()}
    names, stamp = [*map(str, held["names"] or options.names)], _nanoseconds(held["stamp"])
    if held["values"] is None:
        raise TypeError(f"none of {', '.join(NAMES['messages']['values'])} in it")
    given = {group: held["values"]}
    if len(names) != len(given[group]):
        raise ValueError(f"{len(names)} names for {len(given[group])} {group}s; set --order if it holds no names")
    if group == "position":
        given |= {"command": held["sent"], "torque": held["effort"]}
    return Message(
        stamp,
        logged,
        {
            f"{key}.{name}": np.nan if value is None else float(value)
            for key, values in given.items()
            if values is not None and len(values) == len(names)
            for name, value in zip(names, values, strict=True)
        },
    )


def _some(content: Any, paths: Sequence[str]) -> Any:  # noqa: ANN401
    fields = (_field(content, path.split(".")) for path in paths)
    return next((field for field in fields if field is not None and np.size(field)), None)


def _field(message: Any, path: Sequence[str]) -> Any:  # noqa: ANN401
    """Field of a field of a dict, an object, protobuf, or each of a list; or None."""
    if not path or message is None:
        return message
    if not isinstance(message, dict | str) and hasattr(message, "__getitem__"):
        return [_field(one, path) for one in message]
    if isinstance(message, dict):
        return _field(message.get(path[0]), path[1:])
    declared = getattr(getattr(message, "DESCRIPTOR", None), "fields_by_name", {}).get(path[0])
    absent = declared is not None and declared.has_presence and not message.HasField(path[0])
    return None if absent else _field(getattr(message, path[0], None), path[1:])


def _nanoseconds(stamp: Any) -> int:  # noqa: ANN401
    """Time or duration [ns], or 0; TypeError."""
    if stamp is None:
        return 0
    seconds, rest = (
        _some(stamp, names) for names in (("sec", "seconds", "secs"), ("nanosec", "nsec", "nanos", "nsecs"))
    )
    return int(seconds) * NANOSECONDS + int(rest)


_PACKED = re.compile(rb"compression_mode: ['\"]?(file|message)", re.IGNORECASE)


def _is_bag(folder: Path) -> bool:
    """Whether a folder is a bag of ROS 2, packed or of databases."""
    metadata = folder / "metadata.yaml"
    if not begins_with(metadata, b"rosbag2_bagfile_information"):
        return False
    return bool(_PACKED.search(metadata.read_bytes())) or not any(folder.glob("*.mcap"))


_ROSBAGS = {".db3": b"SQLite format 3\x00", ".bag": b"#ROSBAG V2.0"}
Format = Literal["sage", "table", "mcap", "rosbag", "lerobot"]
READERS: dict[Format, Reader] = {
    "sage": Reader(
        lambda path, _: (path / _STATE).is_file() or ((path / _CONTROL).is_file() and (path / _JOINTS).is_file()),
        _read_sage,
    ),
    "table": Reader(_is_table, _read_table),
    "mcap": Reader(lambda path, _: begins_with(path, b"\x89MCAP0\r\n"), partial(_read, _open_mcap)),
    "rosbag": Reader(
        lambda path, _: _is_bag(path) or (path.suffix in _ROSBAGS and begins_with(path, _ROSBAGS[path.suffix])),
        partial(_read, _open_rosbag),
    ),
    "lerobot": Reader(lambda path, _: (path / _INFO).is_file(), _episodes),
}
"""Importable formats"""
