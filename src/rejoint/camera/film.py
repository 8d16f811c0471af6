"""An image sequence: pictures of a board in many postures of one arm, with encoder readings.

Columns of ``postures.csv`` beside pictures: ``picture``, ``position.JOINT_deg``; optional ``approach.JOINT_deg``,
``posture``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc

from rejoint.arms import Arm, Array
from rejoint.camera.board import KINDS, Board, BoardView, Detector, Unusable, read_picture
from rejoint.camera.rig import write_rig
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.measurements import (
    SHEET_MOST,
    joint_columns,
    require_degrees,
)
from rejoint.logs.runfolder import RunFolder
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import set_aside, write_whole
from rejoint.system.textfile import ANGLES, COUNT, read_columns

if TYPE_CHECKING:
    from rejoint.camera.fit import Filmed

POSTURES = "postures.csv"


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
    """by the tool, see `rejoint.camera.rig.Rig`"""
    size: tuple[int, int] | None = None
    """[px] width and height"""
    shots: tuple[Shot, ...] = ()
    """by number"""

    def __len__(self) -> int:
        return len(self.shots)

    def with_shot(self, shot: Shot, size: tuple[int, int]) -> Film:
        """Add a picture, in place of one of its number; InputError for another ``size``."""
        if self.size is not None and size != self.size:
            raise InputError(
                f"picture {shot.name} has {size[0]} x {size[1]} px, those before it {self.size[0]} x {self.size[1]}; "
                "take all of them with one camera and one setting"
            )
        shots = {one.number: one for one in (*self.shots, shot)}
        return replace(self, size=size, shots=tuple(shots[number] for number in sorted(shots)))

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

    def fit(self, arm: Arm, prior: Calibration | None = None, date: str = "") -> Filmed:
        """Fit lens, camera, board and displacement; see `rejoint.camera.fit.fit_film`."""
        from rejoint.camera.fit import fit_film

        return fit_film(arm, self, prior=prior, date=date)

    def write(self, folder: RunFolder, arm: Arm, found: Filmed) -> None:
        """Write camera setup to a run."""
        set_aside(folder.camera)
        write_rig(folder.camera, arm, found.rig, found.rig_sigma, found.calibration.date)


def positions(shots: tuple[Shot, ...], arm: Arm) -> tuple[Array, Array]:
    """Positions and approaches (V, n) [rad] of shots."""
    shape = (-1, arm.joints)
    position, approach = ([getattr(shot, name) for shot in shots] for name in ("position", "approach"))
    return np.array(position).reshape(shape), np.array(approach).reshape(shape)


def write_postures(path: Path, arm: Arm, film: Film) -> None:
    """Write ``postures.csv``."""
    columns = {
        "picture": [shot.name for shot in film.shots],
        "posture": [shot.posture for shot in film.shots],
    }
    for names, rows in zip(joint_columns(arm), positions(film.shots, arm), strict=True):
        columns |= {f"{name}_deg": np.degrees(row) for name, row in zip(names, rows.T, strict=True)}
    table = pa.table({name: pa.array(values, from_pandas=True) for name, values in columns.items()})
    write_whole(path, lambda temporary: pc.write_csv(table, temporary))


def read_folder(pattern: str, arm: Arm, board: Board, carried: str = "board") -> Film:
    """Find ``board`` in the pictures of a folder, or of a pattern such as ``pictures/*.jpg``.

    FileError without pictures or `POSTURES`, InputError for several sizes.
    """
    folder = Path(pattern)
    there = folder.iterdir() if folder.is_dir() else folder.parent.glob(folder.name)
    paths = sorted(path for path in there if path.suffix.lower() in KINDS)
    if not paths:
        remedy = f"give a folder or a pattern of pictures ({', '.join(KINDS)})"
        raise FileError(folder, "holds no pictures" if folder.is_dir() else "no such pictures", remedy)
    shots = _postures(paths[0].parent / POSTURES, arm, [path.name for path in paths])
    detector, film = Detector(board), Film(board=board, carried=carried)
    for path, shot in zip(paths, shots, strict=True):
        picture, size = read_picture(path), film.size or (0, 0)
        seen: BoardView | Unusable = Unusable(path.name, "is no picture that OpenCV can read")
        if picture is not None:
            seen, size = detector.find(path.name, picture), (picture.shape[1], picture.shape[0])
        film = film.with_shot(replace(shot, seen=seen), size)
    return film


def _postures(path: Path, arm: Arm, pictures: list[str]) -> list[Shot]:
    joints, came = joint_columns(arm)
    remedy = "write one line for each picture"
    meanings = {"picture": None, **dict.fromkeys(joints + came, ANGLES), "posture": COUNT}
    if not path.exists():
        raise FileError(path, "no such file: the joint positions of each picture are missing", remedy)
    found, lines = read_columns(path, meanings, ["picture", *joints], joints, most=SHEET_MOST)
    empty = np.full(len(lines), np.nan)
    position, approach = (np.array([found.get(name, empty) for name in names]).T for names in (joints, came))
    require_degrees(path, position)
    rows = {Path(word).name: row for row, word in enumerate(found["picture"])}
    if len(rows) < len(lines):
        raise FileError(path, "two lines name the same picture", "leave one line out")
    if without := [name for name in pictures if name not in rows]:
        raise FileError(path, f"no joint positions for {', '.join(without[:3])} ({len(without)} pictures)", remedy)
    place = found.get("posture", empty)
    return [
        Shot(
            number=number,
            position=position[rows[name]],
            approach=approach[rows[name]],
            posture=int(np.nan_to_num(place[rows[name]], nan=number)),
            seen=Unusable(name, ""),
        )
        for number, name in enumerate(pictures, start=1)
    ]
