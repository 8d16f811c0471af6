"""LeRobot datasets of versions 2 and 3 (huggingface/lerobot, folder ``datasets``).

``observation.state`` was measured, ``action`` sent. The user declares the unit. Each episode becomes one log.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
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
_REMEDY = "download or record the dataset again"


@dataclass(frozen=True, kw_only=True)
class _Info:
    path: Path
    fps: float
    frames: int
    names: dict[str, tuple[str, ...]]
    """columns of state and action"""


def found(source: Path, options: ImportOptions) -> list[Path]:  # noqa: ARG001 - it declares nothing about this
    """Path itself, if it is a LeRobot dataset."""
    return [source] * (source / _INFO).is_file()


def motions(paths: Sequence[Path], arm: Arm, options: ImportOptions) -> list[Pending]:
    """Episodes of a dataset."""
    (source,) = paths
    info = _read_info(source / _INFO, options)
    if options.angle_unit is None:
        said = f"a LeRobot dataset does not say the unit of {' and '.join(_GROUPS)}"
        remedy = "set --angle-unit: deg or rad, or normalised, with the calibration file where you have it"
        raise FileError(source / _INFO, said, remedy)
    columns = _read_frames(source, info)
    numbers = np.unique(columns["episode_index"]).astype(int).tolist()
    return [(f"episode_{number:06d}", partial(_episode, columns, number, arm, options, info)) for number in numbers]


def _read_info(path: Path, options: ImportOptions) -> _Info:
    try:
        data = json.loads(read_bounded(path, JSON_MOST, _REMEDY))
        version = str(data["codebase_version"])
        if not version.startswith(("v2.", "v3.")):
            said = f"dataset version {version}, expected v2 or v3"
            raise FileError(path, said, "convert it with LeRobot's converter")
        names = {key: _names(data["features"][key], options, path, key) for key in _GROUPS}
        info = _Info(path=path, fps=float(data["fps"]), frames=int(data["total_frames"]), names=names)
    except FileNotFoundError as error:
        raise FileError(path, "no such file", "give the folder of a LeRobot dataset") from error
    except KeyError as error:
        raise FileError(path, f"has no entry {error}", "a log needs joint states and actions") from error
    except (OSError, ArithmeticError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise FileError(path, f"damaged ({error})", _REMEDY) from error
    if not 0 < info.fps < np.inf:
        raise FileError(path, f"fps is {info.fps}", _REMEDY)
    return info


def _names(feature: dict[str, object], options: ImportOptions, path: Path, key: str) -> tuple[str, ...]:
    shape, held = feature["shape"], feature["names"]
    if isinstance(held, dict) and len(held) == 1:
        held = next(iter(held.values()))
    if options.names is not None:
        if isinstance(held, list):
            raise FileError(path, f"{key} names its columns: {', '.join(map(str, held))}", "use --map, not --order")
        held = list(options.names)
    if not isinstance(held, list) or shape != [len(held)]:
        raise FileError(path, f"{key} has the shape {shape} and the names {held}", "name all columns with --order")
    return tuple(str(name) for name in held)


def _read_frames(source: Path, info: _Info) -> dict[str, Array]:
    """Columns of all frames: (T,), of state and action (T, n)."""
    files = sorted((source / "data").glob("*/*.parquet"))
    if not files:
        raise FileError(source / "data", "no Parquet file in it", _REMEDY)
    parts = []
    for file in files:
        try:
            table = read_parquet(file, _REMEDY, [*_GROUPS, *_SCALARS]).combine_chunks()
            parts.append({key: _matrix(table[key], len(info.names[key])) for key in _GROUPS})
            parts[-1] |= {key: _matrix(table[key], 1)[:, 0] for key in _SCALARS}
        except KeyError as error:
            found = shown(tuple(pq.read_schema(file).names))
            raise FileError(file, f"has no column {error}; found {found}", _REMEDY) from error
        except (OSError, pa.ArrowException, ValueError) as error:
            raise FileError(file, f"not the frames of a dataset ({first_line(error)})", _REMEDY) from error
    whole = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    if (rows := len(whole["timestamp"])) != info.frames:
        raise FileError(source, f"{rows} frames in data, but {_INFO} promises {info.frames}", _REMEDY)
    return whole


def _matrix(column: pa.ChunkedArray, width: int) -> Array:
    """Numbers (T, width) of a column of numbers or of lists; ValueError for missing ones or another width."""
    values = column.combine_chunks()
    lists = hasattr(values.type, "value_type")
    if lists and not pc.all(pc.equal(pc.list_value_length(values), width)).as_py():
        raise ValueError(f"lists of other lengths than {width}")
    numbers = values.flatten() if lists else values
    if values.null_count or numbers.null_count or len(numbers) != len(values) * width:
        raise ValueError(f"rows without {width} value(s)")
    return np.asarray(numbers.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)).reshape(-1, width)


def _episode(columns: dict[str, Array], number: int, arm: Arm, options: ImportOptions, info: _Info) -> RecordedMotion:
    folder, rows = info.path.parents[1], np.flatnonzero(columns["episode_index"] == number)
    rows = rows[np.argsort(columns["frame_index"][rows], kind="stable")]
    index, stamps = columns["frame_index"][rows], columns["timestamp"][rows]
    if (np.diff(index) == 0).any():
        raise FileError(folder, f"episode {number} has frame {index[1:][np.diff(index) == 0][0]:g} twice", _REMEDY)
    nominal = index / info.fps
    even = bool((np.abs(stamps - nominal) < _TOLERANCE).all())
    told = "are" if even else "differ from"
    note = f"the stamps {told} frame numbers over {info.fps:g} Hz" + (", no measured times" if even else "")
    values = np.concatenate([columns[key][rows] for key in _GROUPS], axis=1)
    name = f"episode_{number:06d}"
    frame = ColumnFrame(
        path=folder,
        titles=tuple(f"{group}.{one}" for key, group in _GROUPS.items() for one in info.names[key]),
        values=lambda chosen: values[:, chosen],
        number=rows + 1,
        place=f"{name}, row",
        time=nominal if even else stamps,
        found="a LeRobot dataset",
    )
    extra = {"source": folder.name, "format": "lerobot", "episode": str(number)}
    return read_motion(name, [frame], arm, options, robot=f"lerobot:{folder.name}", notes=[note], extra=extra)
