"""LeRobot datasets of version 3 (huggingface/lerobot, ``datasets/utils.py`` and ``datasets/lerobot_dataset.py``).

``meta/info.json`` says version, frame rate and the names of the columns, ``data/chunk-*/file-*.parquet`` hold the
frames of all episodes one after another: ``observation.state`` is what was measured, ``action`` what was sent in
the same frame. Neither says its unit, so the user has to. Each episode becomes one log.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from rejoint.arms import Arm
from rejoint.logs.joints import Match, match_joints, radians
from rejoint.logs.options import ImportOptions
from rejoint.logs.runlog import Array, read_parquet
from rejoint.logs.textfile import shown
from rejoint.logs.track import RecordedMotion, Track
from rejoint.system.errors import FileError, first_line
from rejoint.system.files import JSON_MOST, read_bounded

_INFO = "meta/info.json"
_STATE, _ACTION = "observation.state", "action"
_SCALARS = ("timestamp", "frame_index", "episode_index")
_TOLERANCE = 1e-4
"""[s] how far a stamp may be from frame / fps. Source: ``tolerance_s`` of LeRobotDataset."""
_NEEDED = "a log needs joint states and actions"
_REMEDY = "download or record the dataset again"


@dataclass(frozen=True, kw_only=True)
class _Info:
    path: Path
    fps: float
    frames: int
    names: dict[str, tuple[str, ...]]
    """names of the columns of state and action"""


def fits(source: Path, options: ImportOptions) -> bool:  # noqa: ARG001 - it declares nothing about this
    """Tell whether a folder is a LeRobot dataset."""
    return (source / _INFO).is_file()


def motions(source: Path, arm: Arm, options: ImportOptions) -> tuple[int, Iterator[RecordedMotion]]:
    """Count the episodes of a dataset and read them one by one."""
    options.refuse_others(source, "lerobot", "angle_unit", "joint_map", "joint_order", "calibration")
    info = _read_info(source / _INFO, options)
    if options.angle_unit is None:
        raise FileError(
            source / _INFO, f"a LeRobot dataset does not say the unit of {_STATE} and {_ACTION}",
            "set --angle-unit: deg or rad, or normalised with the calibration file",
        )  # fmt: skip
    table = _read_frames(source, info)
    episode = table["episode_index"].to_numpy()
    numbers = np.unique(episode)
    return len(numbers), (_episode(table, int(number), arm, options, info) for number in numbers)


def _read_info(path: Path, options: ImportOptions) -> _Info:
    try:
        data = json.loads(read_bounded(path, JSON_MOST, _REMEDY))
        version = str(data["codebase_version"])
        if not version.startswith("v3."):
            raise FileError(path, f"dataset version {version}, expected v3", "convert it with LeRobot's own converter")
        absent = [key for key in (_STATE, _ACTION) if key not in data["features"]]
        if absent:
            found = shown(tuple(map(str, data["features"])))
            raise FileError(path, f"has no feature {', '.join(absent)}; found {found}", _NEEDED)
        features = {key: data["features"][key] for key in (_STATE, _ACTION)}
        names = {key: _names(features[key], options, path, key) for key in features}
        info = _Info(path=path, fps=float(data["fps"]), frames=int(data["total_frames"]), names=names)
    except FileNotFoundError as error:
        raise FileError(path, "no such file", "give the folder of a LeRobot dataset") from error
    except KeyError as error:
        raise FileError(path, f"has no entry {error}", _NEEDED) from error
    except (OSError, ArithmeticError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise FileError(path, f"damaged ({error})", _REMEDY) from error
    if not 0 < info.fps < np.inf:
        raise FileError(path, f"fps is {info.fps}", _REMEDY)
    return info


def _names(feature: dict[str, object], options: ImportOptions, path: Path, key: str) -> tuple[str, ...]:
    """Names of a feature's columns; LeRobot keeps a list, older recorders a list under a key such as motors."""
    shape, held = feature["shape"], feature["names"]
    if isinstance(held, dict) and len(held) == 1:
        held = next(iter(held.values()))
    if not isinstance(shape, list) or len(shape) != 1:
        raise FileError(path, f"{key} has shape {shape}, expected one number of columns", "take another dataset")
    if options.joint_order is not None:
        if isinstance(held, list):
            raise FileError(path, f"{key} names its columns: {', '.join(map(str, held))}", "use --joints, not --order")
        held = list(options.joint_order)
    if not isinstance(held, list) or len(held) != shape[0]:
        raise FileError(path, f"{key} has {shape[0]} columns with the names {held}", "name them all with --order")
    return tuple(str(name) for name in held)


def _read_frames(source: Path, info: _Info) -> pa.Table:
    files = sorted((source / "data").glob("*/*.parquet"))
    if not files:
        raise FileError(source / "data", "no Parquet file in it", _REMEDY)
    tables = []
    for file in files:
        try:
            tables.append(read_parquet(file, _REMEDY, [_STATE, _ACTION, *_SCALARS]).combine_chunks())
        except (OSError, pa.ArrowException, ValueError, KeyError) as error:
            raise FileError(file, f"not the frames of a dataset ({first_line(error)})", _REMEDY) from error
        held = set(tables[-1].column_names)
        missing = [name for name in (_STATE, _ACTION, *_SCALARS) if name not in held]
        if missing:
            found = shown(tuple(pq.read_schema(file).names))
            raise FileError(file, f"has no column {', '.join(missing)}; found {found}", _REMEDY)
        if any(column.null_count for column in tables[-1].columns):
            raise FileError(file, "has rows without a value", _REMEDY)
        _check_types(tables[-1], file, info)
    table = pa.concat_tables(tables, promote_options="permissive")
    if table.num_rows != info.frames:
        raise FileError(source, f"{table.num_rows} frames in data, but {_INFO} promises {info.frames}", _REMEDY)
    return table


def _check_types(table: pa.Table, file: Path, info: _Info) -> None:
    for key in _SCALARS:
        kind = table[key].type
        if not (pa.types.is_integer(kind) or (key == "timestamp" and pa.types.is_floating(kind))):
            raise FileError(file, f"column {key} holds {kind}", _REMEDY)
    for key in (_STATE, _ACTION):
        kind, width = table[key].type, len(info.names[key])
        if not (pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind) or pa.types.is_large_list(kind)):
            raise FileError(file, f"column {key} holds {kind}, expected lists of numbers", _REMEDY)
        if not pa.types.is_floating(kind.value_type):
            raise FileError(file, f"column {key} holds {kind}, expected lists of numbers", _REMEDY)
        lengths = pc.list_value_length(table[key]).to_numpy()
        if (lengths != width).any():
            row = int(np.argmax(lengths != width))
            raise FileError(file, f"row {row + 1}: {lengths[row]} values in {key}, expected {width}", _REMEDY)


def _episode(table: pa.Table, number: int, arm: Arm, options: ImportOptions, info: _Info) -> RecordedMotion:
    rows = np.flatnonzero(table["episode_index"].to_numpy() == number)
    chosen = table.take(rows)
    index = chosen["frame_index"].to_numpy()
    order = np.argsort(index, kind="stable")
    if len(np.unique(index)) < len(index):
        twice = int(index[order][1:][np.diff(index[order]) == 0][0])
        raise FileError(info.path.parents[1], f"episode {number} has frame {twice} twice", _REMEDY)
    time, note = _time(chosen, info)
    name = f"episode_{number:06d}"
    unit = options.angle_unit or ""
    notes = [note]

    def track(key: str, what: str) -> Track:
        match = match_joints(info.names[key], arm, options, info.path, key)
        notes.extend(_dropped(match, key))
        values = radians(_matrix(chosen, key)[:, match.columns], unit, arm, options, info.path.parents[1])
        columns = tuple(f"{key} {name}" for name in match.names)
        return Track(
            path=info.path.parents[1], what=what, time=time[order], value=values[order], columns=columns,
            place=f"{name}, row", number=rows[order] + 1,
        )  # fmt: skip

    state, command = track(_STATE, "state"), track(_ACTION, "command")
    return RecordedMotion(
        name=name, state=state, command=command, angle_unit=unit, robot=f"lerobot:{info.path.parents[1].name}",
        extra={"source": info.path.parents[1].name, "format": "lerobot", "episode": str(number)}, notes=tuple(notes),
    )  # fmt: skip


def _dropped(match: Match, key: str) -> list[str]:
    return [f"columns of {key} that are no joints dropped: {', '.join(match.dropped)}"] * bool(match.dropped)


def _matrix(table: pa.Table, key: str) -> Array:
    column = table[key].combine_chunks()
    values = column.flatten().to_numpy(zero_copy_only=False)
    return values.astype(float).reshape(table.num_rows, -1)


def _time(table: pa.Table, info: _Info) -> tuple[Array, str]:
    """Seconds of each frame: the frame number over the frame rate where the float32 stamps agree with it."""
    stamps = table["timestamp"].to_numpy().astype(float)
    nominal = table["frame_index"].to_numpy() / info.fps
    if (np.abs(stamps - nominal) < _TOLERANCE).all():
        return nominal, f"the stamps are frame numbers over {info.fps:g} Hz, no measured times"
    return stamps, f"the stamps differ from frame numbers over {info.fps:g} Hz and are taken as they are"
