"""An image sequence: pictures of a board in many postures of one arm, with encoder readings.

Columns of ``views.parquet``: ``picture``, ``number``, ``posture``, ``side``; ``position.JOINT`` and ``approach.JOINT``
[rad]; the lists ``corner``, ``x`` and ``y`` [px]; ``why`` it is unusable. Those of ``postures.csv`` beside pictures:
``picture``, ``position.JOINT_deg``; optional ``approach.JOINT_deg``, ``posture``, ``side``.
"""

from __future__ import annotations

import csv
import io
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.camera.board import Board, BoardView
from rejoint.arms.camera.views import KINDS, Detector, Unusable, read_picture
from rejoint.diagnosis.calibration.measurementfile import COUNT, read_columns, read_table, write_table
from rejoint.system.errors import FileError, InputError, first_line
from rejoint.system.files import write_whole
from rejoint.system.textfile import ANGLES


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """One picture and its posture."""

    number: int
    """in the plan, from 1"""
    position: Array
    """(n,) [rad] by encoders"""
    approach: Array
    """(n,) [rad] before the last motion; NaN where unknown"""
    posture: int
    """shots of the same number visit one posture from different sides"""
    side: int
    """1: joints approached upwards, -1: downwards, 0: unknown"""
    seen: BoardView | Unusable

    @property
    def name(self) -> str:
        """Name of the picture."""
        return self.seen.name


@dataclass(frozen=True, kw_only=True, eq=False)
class Film:
    """Pictures by one camera of one board in a fixed setup."""

    board: Board
    carried: str
    """by the tool, one of `rejoint.arms.camera.rig.MOUNTINGS`"""
    size: tuple[int, int] | None = None
    """[px] width and height"""
    shots: tuple[Shot, ...] = field(default=())
    """by number"""
    fresh: bool = False
    """ignore earlier calibrations"""

    def __len__(self) -> int:
        return len(self.shots)

    def with_shot(self, shot: Shot, size: tuple[int, int]) -> Film:
        """Add a picture; InputError for another ``size``."""
        if self.size is not None and size != self.size:
            raise InputError(
                f"picture {shot.name} has {size[0]} x {size[1]} px, those before it {self.size[0]} x {self.size[1]}; "
                "take all of them with one camera and one setting"
            )
        return replace(self, size=size, shots=tuple(sorted((*self.shots, shot), key=lambda one: one.number)))

    @property
    def usable(self) -> tuple[Shot, ...]:
        """Shots that show the board well."""
        return tuple(shot for shot in self.shots if isinstance(shot.seen, BoardView))

    @property
    def unusable(self) -> tuple[Unusable, ...]:
        """The other shots, and why."""
        return tuple(shot.seen for shot in self.shots if isinstance(shot.seen, Unusable))

    @property
    def views(self) -> tuple[BoardView, ...]:
        """Views of the usable shots."""
        return tuple(shot.seen for shot in self.shots if isinstance(shot.seen, BoardView))

    def numbered(self, first: int, last: int) -> Film:
        """Part of the plan, both ends included."""
        return replace(self, shots=tuple(shot for shot in self.shots if first <= shot.number <= last))

    def again(self) -> Film:
        """Return the film to resume, without unusable shots."""
        return replace(self, shots=self.usable)


def positions(shots: tuple[Shot, ...], arm: Arm) -> tuple[Array, Array]:
    """Positions and approaches (V, n) [rad] of shots."""
    rows = [(shot.position, shot.approach) for shot in shots]
    return tuple(np.array([row[i] for row in rows]).reshape(-1, arm.joints) for i in (0, 1))  # type: ignore[return-value]


POSTURES = "postures.csv"


def write_film(path: Path, arm: Arm, film: Film, *, ended: bool = False) -> None:
    """Write pictures, atomically; ``ended``: they are complete."""
    about = {
        "board": asdict(film.board),
        "carried": film.carried,
        "size": film.size,
        "ended": ended,
        "fresh": film.fresh,
    }
    write_table(path, arm, "views", _rows(arm, film), about)


def read_film(path: Path, arm: Arm) -> tuple[Film, bool]:
    """Read pictures and whether they are complete; FileError if unusable."""

    def build(columns: dict[str, list[Any]], about: dict[str, Any]) -> tuple[Film, bool]:
        rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        film = Film(
            board=msgspec.convert(about["board"], Board),
            carried=about["carried"],
            size=msgspec.convert(about["size"], tuple[int, int] | None),
            shots=tuple(_shot(row, arm) for row in rows),
            fresh=about["fresh"],
        )
        return film, bool(about["ended"])

    return read_table(path, arm, "views", build)


def _rows(arm: Arm, film: Film) -> dict[str, list[Any]]:
    shots = film.shots
    rows: dict[str, list[Any]] = {
        "picture": [shot.name for shot in shots],
        "number": [shot.number for shot in shots],
        "posture": [shot.posture for shot in shots],
        "side": [shot.side for shot in shots],
    }
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
        number=row["number"],
        position=joints[0],
        approach=joints[1],
        posture=row["posture"],
        side=row["side"],
        seen=seen
        or BoardView(
            name=name,
            number=np.array(row["corner"], dtype=np.int64),
            pixel=np.array([row["x"], row["y"]], dtype=float).T.reshape(-1, 2),
        ),
    )


def write_postures(path: Path, arm: Arm, film: Film) -> None:
    """Write ``postures.csv``."""
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
    """Find ``board`` in the pictures of a folder, or of a pattern such as ``pictures/*.jpg``.

    FileError without pictures or `POSTURES`, InputError for several sizes.
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
            number=number,
            position=row["position"],
            approach=row["approach"],
            posture=row.get("posture", number),
            side=row.get("side", 0),
            seen=seen,
        )
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
    position = np.array([found.filled(name) for name in joints]).T
    if len(found) > 1 and (np.abs(np.degrees(position)) <= np.pi).all():
        raise FileError(path, "every joint position lies between -3.14 and 3.14", "give degrees, not radians")
    approach = np.array([found.numbers(name) for name in came]).T
    whole = {name: found.numbers(name) for name in ("posture", "side")}
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
