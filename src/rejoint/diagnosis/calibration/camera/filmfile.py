"""Files of a film: ``views.parquet``, written as it goes, and pictures with their postures from elsewhere.

One row of ``views.parquet`` is one picture. Columns: ``picture``, ``number``, ``posture``, ``side``; ``position.JOINT``
and ``approach.JOINT`` [rad]; ``corner``, ``x`` and ``y``, lists of the corners of the board that are seen and where
[px]; and ``why`` the picture is of no use, empty where it is. The header tells arm, board, what the tool carries, the
size of the pictures, and whether the film has ended.

A folder of pictures has a file ``postures.csv`` with the columns ``picture``, ``position.JOINT_deg`` and, where they
are known, ``approach.JOINT_deg``, ``posture`` and ``side``.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from rejoint.arms import Arm
from rejoint.arms.camera.board import Board, BoardView
from rejoint.arms.camera.views import KINDS, Detector, Unusable, read_picture
from rejoint.diagnosis.calibration.camera.film import Film, Shot
from rejoint.diagnosis.calibration.sheets import ANGLES, COUNT, read_columns
from rejoint.logs.runlog import read_parquet
from rejoint.system.errors import FileError, InputError, first_line
from rejoint.system.files import CHANGED, write_whole

FORMAT = 1
POSTURES = "postures.csv"
"""File beside pictures that says in which posture each was taken"""
_KEY = b"rejoint"
_REMEDY = "take the pictures again, or another folder"


def write_film(path: Path, arm: Arm, film: Film, *, ended: bool = False) -> None:
    """Write a film of ``arm``, whole or not at all; ``ended``: nothing goes on from it."""
    rows = _rows(arm, film)
    header = {
        "format": FORMAT, "arm": arm.name, "joints": list(arm.joint_names), "board": asdict(film.board),
        "carried": film.carried, "size": film.size, "ended": ended, "afresh": film.afresh,
        "digest": _digest(rows),
    }  # fmt: skip
    table = pa.table({name: pa.array(values, _type(name)) for name, values in rows.items()})
    table = table.replace_schema_metadata({_KEY: json.dumps(header).encode()})
    write_whole(path, lambda temporary: pq.write_table(table, temporary, write_page_checksum=True))


def read_film(path: Path, arm: Arm) -> tuple[Film, bool]:
    """Read a film of ``arm``, and whether it has ended; FileError says what cannot be used and why."""
    try:
        table = read_parquet(path, _REMEDY)
        header = json.loads((table.schema.metadata or {}).get(_KEY, b"{}"))
        if header.get("format") != FORMAT or "carried" not in header:
            raise FileError(path, f"no views of format {FORMAT}, but some other table", _REMEDY)
        if header["arm"] != arm.name or tuple(header["joints"]) != arm.joint_names:
            raise FileError(path, f"views of arm {header['arm']}, expected {arm.name}", "name the right arm")
        rows = table.to_pydict()
        if header["digest"] != _digest(rows):
            raise FileError(path, CHANGED, _REMEDY)
        film = Film(
            board=msgspec.convert(header["board"], Board), carried=str(header["carried"]),
            size=None if header["size"] is None else (int(header["size"][0]), int(header["size"][1])),
            shots=tuple(_shot({name: values[i] for name, values in rows.items()}, arm)
                        for i in range(table.num_rows)),
            afresh=bool(header.get("afresh", False)),
        )  # fmt: skip
        return film, bool(header["ended"])
    except FileNotFoundError as error:
        raise FileError(path, "no such file", "check the path") from error
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError, InputError, msgspec.MsgspecError) as error:
        raise FileError(path, f"not readable views ({first_line(error)})", _REMEDY) from error


def _rows(arm: Arm, film: Film) -> dict[str, list[Any]]:
    """Return columns of a film, as they are written."""
    shots = film.shots
    rows: dict[str, list[Any]] = {
        "picture": [shot.name for shot in shots], "number": [shot.number for shot in shots],
        "posture": [shot.posture for shot in shots], "side": [shot.side for shot in shots],
    }  # fmt: skip
    for group in ("position", "approach"):
        for i, name in enumerate(arm.joint_names):
            rows[f"{group}.{name}"] = [float(getattr(shot, group)[i]) for shot in shots]
    views = [shot.seen if isinstance(shot.seen, BoardView) else None for shot in shots]
    rows["corner"] = [[] if view is None else view.number.tolist() for view in views]
    for i, axis in enumerate("xy"):
        rows[axis] = [[] if view is None else view.pixel[:, i].tolist() for view in views]
    rows["why"] = [shot.seen.why if isinstance(shot.seen, Unusable) else "" for shot in shots]
    return rows


def _shot(row: dict[str, Any], arm: Arm) -> Shot:
    joints = [np.array([row[f"{group}.{name}"] for name in arm.joint_names]) for group in ("position", "approach")]
    name, seen = row["picture"], None
    if row["why"]:
        seen = Unusable(name=name, why=row["why"])
    return Shot(
        number=row["number"], position=joints[0], approach=joints[1], posture=row["posture"], side=row["side"],
        seen=seen or BoardView(name=name, number=np.array(row["corner"], dtype=np.int64),
                               pixel=np.array([row["x"], row["y"]], dtype=float).T.reshape(-1, 2)),
    )  # fmt: skip


def _type(name: str) -> pa.DataType:
    whole = {"number", "posture", "side"}
    lists = {"corner": pa.list_(pa.int64()), "x": pa.list_(pa.float64()), "y": pa.list_(pa.float64())}
    if name in ("picture", "why"):
        return pa.string()
    return lists.get(name, pa.int64() if name in whole else pa.float64())


def _digest(rows: dict[str, list[Any]]) -> str:
    return hashlib.sha256(json.dumps(rows, sort_keys=True).encode()).hexdigest()[:16]


def write_postures(path: Path, arm: Arm, film: Film) -> None:
    """Write ``postures.csv`` of the pictures of a film."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    names = [f"{group}.{name}_deg" for group in ("position", "approach") for name in arm.joint_names]
    writer.writerow(["picture", "posture", "side", *names])
    for shot in film.shots:
        angles = np.degrees(np.concatenate([shot.position, shot.approach]))
        cells = ["" if np.isnan(angle) else f"{angle:.6f}" for angle in angles]
        writer.writerow([shot.name, shot.posture, shot.side, *cells])
    write_whole(path, lambda temporary: temporary.write_text(text.getvalue(), encoding="utf-8"))


def read_folder(pattern: str, arm: Arm, board: Board, carried: str = "board") -> Film:
    """Look for ``board`` in the pictures of a folder, or in those that a pattern such as ``pictures/*.jpg`` names.

    Their postures are those of `POSTURES` beside them. FileError where pictures or postures are missing, InputError
    where pictures have several sizes.
    """
    paths = _pictures(pattern)
    rows = _postures(paths[0].parent / POSTURES, arm, {path.name for path in paths})
    detector, film = Detector(board), Film(board=board, carried=carried)
    for number, path in enumerate(paths, start=1):
        picture, row = read_picture(path), rows[path.name]
        if picture is None:
            seen: BoardView | Unusable = Unusable(name=path.name, why="is no picture that OpenCV can read")
            size = film.size or (0, 0)
        else:
            seen, size = detector.find(path.name, picture), (int(picture.shape[1]), int(picture.shape[0]))
        shot = Shot(
            number=number, position=row["position"], approach=row["approach"], posture=row.get("posture", number),
            side=row.get("side", 0), seen=seen,
        )  # fmt: skip
        film = film.with_shot(shot, size)
    return film


def _pictures(pattern: str) -> list[Path]:
    folder = Path(pattern)
    found = folder.iterdir() if folder.is_dir() else folder.parent.glob(folder.name)
    paths = sorted(path for path in found if path.suffix.lower() in KINDS)
    if not paths:
        remedy = f"give a folder or a pattern of pictures ({', '.join(KINDS)})"
        raise FileError(folder, "holds no pictures" if folder.is_dir() else "no such pictures", remedy)
    folders = {path.parent for path in paths}
    if len(folders) > 1:
        raise FileError(folder, f"names pictures of {len(folders)} folders, expected one", "take one folder")
    return paths


def _postures(path: Path, arm: Arm, pictures: set[str]) -> dict[str, dict[str, Any]]:
    """Read postures by the names of pictures, which are all to have one."""
    joints = [f"position.{name}" for name in arm.joint_names]
    came = [f"approach.{name}" for name in arm.joint_names]
    remedy = "write one line for each picture"
    meanings = {"picture": None, **dict.fromkeys(joints + came, ANGLES), **dict.fromkeys(("posture", "side"), COUNT)}
    try:
        found = read_columns(path, meanings, ["picture", *joints])
    except FileNotFoundError as error:
        raise FileError(path, "no such file: the joint positions of each picture are missing", remedy) from error
    except OSError as error:
        raise FileError(path, f"cannot be read ({first_line(error)})", remedy) from error
    blank = np.full(len(found), np.nan)
    position = np.array([found.filled(name) for name in joints]).T
    if len(found) > 1 and (np.abs(np.degrees(position)) <= np.pi).all():
        raise FileError(path, "every joint position lies between -3.14 and 3.14", "give degrees, not radians")
    approach = np.array([found.numbers(name) if name in found.places else blank for name in came]).T
    whole = {name: found.numbers(name) for name in ("posture", "side") if name in found.places}
    rows: dict[str, dict[str, Any]] = {}
    for row, name in enumerate(Path(word).name for word in found.words("picture")):
        one = {"position": position[row], "approach": approach[row]}
        one |= {kind: int(values[row]) for kind, values in whole.items() if np.isfinite(values[row])}
        if name in rows and not np.array_equal(rows[name]["position"], position[row]):
            raise FileError(path, f"line {found.line(row)}: other joint positions for {name}", "leave one line out")
        rows[name] = one
    if without := sorted(pictures - set(rows)):
        raise FileError(path, f"no joint positions for {', '.join(without[:3])} ({len(without)} pictures)", remedy)
    return rows
