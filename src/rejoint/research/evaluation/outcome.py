"""Results of one controller on one variant, a row per arm, as a Parquet file."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from rejoint.arms import Array
from rejoint.logs.runlog import read_parquet
from rejoint.system.errors import FileError
from rejoint.system.files import write_whole

_METADATA_KEY = b"rejoint.research.evaluation"


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """Holds of A arms at K targets each, and the protocol of Park et al. 2024 with C targets."""

    wear_seed: Array
    """(A,) seeds of the arms"""
    target: Array
    """(A, K, 3) [m]"""
    settled: Array
    """(A, K) [m] encoder error in the last second; NaN after a guard's stop"""
    settled_true: Array
    """(A, K) [m] true error over the same time"""
    oscillation: Array
    """(A, K) [m] rms distance of the encoder TCP from its mean"""
    stay: Array
    """(A, K, W) [s] after which the error stays below each distance, or infinite"""
    tripped: Array
    """(A,) flags with which the guard stopped the arm"""
    crossed: Array
    """(A, C) 1 for crossings in time; NaN without the protocol"""
    crossing_error: Array
    """(A, C) [m] encoder error at that moment, or at the time-out"""
    crossing_true: Array
    """(A, C) [m] true error at that moment"""
    crossing_time: Array
    """(A, C) [s]"""


def write_outcome(path: Path, outcome: Outcome, identity: dict[str, Any]) -> None:
    """Write an outcome; ``identity`` says what it belongs to."""
    arrays = {f.name: np.asarray(getattr(outcome, f.name), dtype=float) for f in fields(Outcome)}
    columns = {name: pa.array(list(array.reshape(len(array), -1))) for name, array in arrays.items()}
    header = {"identity": identity, "shapes": {name: array.shape[1:] for name, array in arrays.items()}}
    table = pa.table(columns).replace_schema_metadata({_METADATA_KEY: json.dumps(header).encode()})
    write_whole(path, lambda temporary: pq.write_table(table, temporary, compression="zstd", write_page_checksum=True))


def read_outcome(path: Path, identity: dict[str, Any]) -> Outcome | None:
    """Read an outcome; None if missing, damaged, or of another identity."""
    try:
        table = read_parquet(path, "delete it")
        header = json.loads((table.schema.metadata or {})[_METADATA_KEY])
        if header["identity"] != json.loads(json.dumps(identity)):
            return None
        rows = len(table)
        return Outcome(
            **{
                f.name: np.array(table[f.name].to_pylist(), dtype=float).reshape(rows, *header["shapes"][f.name])
                for f in fields(Outcome)
            }
        )
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError, RecursionError, FileError):
        return None
