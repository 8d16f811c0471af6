"""LeRobot datasets of versions 2 and 3 (huggingface/lerobot, folder ``datasets``).

``observation.state`` was measured, ``action`` sent. The user declares the unit. Each episode becomes one log.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from rejoint.arms import Arm
from rejoint.logs.columns import read_motion
from rejoint.logs.options import ImportOptions
from rejoint.logs.runlog import Array, read_parquet
from rejoint.logs.track import ColumnFrame, Pending, RecordedMotion
from rejoint.system.errors import FileError, first_line
from rejoint.system.files import JSON_MOST, read_bounded
from rejoint.system.textfile import shown

_INFO = "meta/info.json"
_GROUPS = {"observation.state": "position", "action": "command"}
_SCALARS = ("timestamp", "frame_index", "episode_index")
_TOLERANCE = 1e-4
"""[s] ``tolerance_s`` of LeRobotDataset"""
_NEEDED = "a log needs joint states and actions"
_REMEDY = "download or record the dataset again"


@dataclass(frozen=True, kw_only=True)
class _Info:
    path: Path
    fps: float
    frames: int
    names: dict[str, tuple[str, ...]]
    """columns of state and action"""


def fits(source: Path, options: ImportOptions) -> bool:  # noqa: ARG001 - it declares nothing about this
    """Whether a folder is a LeRobot dataset."""
    return (source / _INFO).is_file()


def motions(source: Path, arm: Arm, options: ImportOptions) -> list[Pending]:
    """Episodes of a dataset."""
    info = _read_info(source / _INFO, options)
    if options.angle_unit is None:
        raise FileError(
            source / _INFO,
            f"a LeRobot dataset does not say the unit of {' and '.join(_GROUPS)}",
            "set --angle-unit: deg or rad, or normalised, with the calibration file where you have it",
        )
    table = _read_frames(source, info)
    numbers = np.unique(table["episode_index"].to_numpy()).tolist()
    return [(f"episode_{number:06d}", partial(_episode, table, number, arm, options, info)) for number in numbers]


def _read_info(path: Path, options: ImportOptions) -> _Info:
    try:
        data = json.loads(read_bounded(path, JSON_MOST, _REMEDY))
        version = str(data["codebase_version"])
        if not version.startswith(("v2.", "v3.")):
            raise FileError(
                path, f"dataset version {version}, expected v2 or v3", "convert it with LeRobot's converter"
            )
        absent = [key for key in _GROUPS if key not in data["features"]]
        if absent:
            found = shown(tuple(map(str, data["features"])))
            raise FileError(path, f"has no feature {', '.join(absent)}; found {found}", _NEEDED)
        names = {key: _names(data["features"][key], options, path, key) for key in _GROUPS}
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
    shape, held = feature["shape"], feature["names"]
    if isinstance(held, dict) and len(held) == 1:
        held = next(iter(held.values()))
    if not isinstance(shape, list) or len(shape) != 1:
        raise FileError(path, f"{key} has shape {shape}, expected one number of columns", "take another dataset")
    if options.names is not None:
        if isinstance(held, list):
            raise FileError(path, f"{key} names its columns: {', '.join(map(str, held))}", "use --map, not --order")
        held = list(options.names)
    if not isinstance(held, list) or len(held) != shape[0]:
        raise FileError(path, f"{key} has {shape[0]} columns with the names {held}", "name them all with --order")
    return tuple(str(name) for name in held)


def _read_frames(source: Path, info: _Info) -> pa.Table:
    files = sorted((source / "data").glob("*/*.parquet"))
    if not files:
        raise FileError(source / "data", "no Parquet file in it", _REMEDY)
    tables, wanted = [], [*_GROUPS, *_SCALARS]
    for file in files:
        try:
            table = read_parquet(file, _REMEDY, wanted).combine_chunks()
        except (OSError, pa.ArrowException, ValueError, KeyError) as error:
            raise FileError(file, f"not the frames of a dataset ({first_line(error)})", _REMEDY) from error
        if missing := [name for name in wanted if name not in table.column_names]:
            found = shown(tuple(pq.read_schema(file).names))
            raise FileError(file, f"has no column {', '.join(missing)}; found {found}", _REMEDY)
        _check_types(table, file, info)
        tables.append(table)
    whole = pa.concat_tables(tables, promote_options="permissive")
    if whole.num_rows != info.frames:
        raise FileError(source, f"{whole.num_rows} frames in data, but {_INFO} promises {info.frames}", _REMEDY)
    return whole


def _check_types(table: pa.Table, file: Path, info: _Info) -> None:
    if any(column.null_count for column in table.columns):
        raise FileError(file, "has rows without a value", _REMEDY)
    for key in (*_SCALARS, *_GROUPS):
        kind = table[key].type
        whole = pa.types.is_integer(kind) or (key == "timestamp" and pa.types.is_floating(kind))
        if not (pa.types.is_floating(getattr(kind, "value_type", kind)) if key in _GROUPS else whole):
            raise FileError(
                file, f"column {key} holds {kind}, expected {'lists of ' * (key in _GROUPS)}numbers", _REMEDY
            )
    for key, names in info.names.items():
        lengths = pc.list_value_length(table[key]).to_numpy()
        if (lengths != len(names)).any():
            row = int(np.argmax(lengths != len(names)))
            raise FileError(file, f"row {row + 1}: {lengths[row]} values in {key}, expected {len(names)}", _REMEDY)


def _episode(table: pa.Table, number: int, arm: Arm, options: ImportOptions, info: _Info) -> RecordedMotion:
    folder, rows = info.path.parents[1], np.flatnonzero(table["episode_index"].to_numpy() == number)
    rows = rows[np.argsort(table["frame_index"].to_numpy()[rows], kind="stable")]
    chosen = table.take(rows)
    index = chosen["frame_index"].to_numpy()
    if (np.diff(index) == 0).any():
        raise FileError(folder, f"episode {number} has frame {index[1:][np.diff(index) == 0][0]} twice", _REMEDY)
    time, note = _time(chosen, info)
    values = np.concatenate([_matrix(chosen, key) for key in _GROUPS], axis=1)
    name = f"episode_{number:06d}"
    frame = ColumnFrame(
        path=folder,
        titles=tuple(f"{group}.{one}" for key, group in _GROUPS.items() for one in info.names[key]),
        values=lambda columns: values[:, columns],
        number=rows + 1,
        place=f"{name}, row",
        time=time,
        found="a LeRobot dataset",
    )
    return read_motion(
        name,
        [frame],
        arm,
        options,
        robot=f"lerobot:{folder.name}",
        notes=[note],
        extra={"source": folder.name, "format": "lerobot", "episode": str(number)},
    )


def _matrix(table: pa.Table, key: str) -> Array:
    values = table[key].combine_chunks().flatten().to_numpy(zero_copy_only=False)
    return values.astype(float).reshape(table.num_rows, -1)


def _time(table: pa.Table, info: _Info) -> tuple[Array, str]:
    """Return times [s] of frames: number over rate where the stamps agree."""
    stamps = table["timestamp"].to_numpy().astype(float)
    nominal = table["frame_index"].to_numpy() / info.fps
    if (np.abs(stamps - nominal) < _TOLERANCE).all():
        return nominal, f"the stamps are frame numbers over {info.fps:g} Hz, no measured times"
    return stamps, f"the stamps differ from frame numbers over {info.fps:g} Hz and are taken as they are"
