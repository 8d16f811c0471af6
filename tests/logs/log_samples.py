"""Motions of an SO-101 whose every number is known."""

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rejoint.arms import Array, so101

ARM = so101()
PERIOD = 0.02
SAGE_NAMES = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    time: Array
    position: Array
    command: Array


def sample(rows: int = 60) -> Sample:
    """Five joints on five different sinusoids, states two rows behind the commands and sagging a little."""
    time = PERIOD * np.arange(rows)
    phase = 2 * np.pi * np.outer(np.arange(rows + 2) - 2, np.array([1.0, 1.7, 2.3, 3.1, 4.3])) / rows
    moving = 0.6 * np.sin(phase) + 0.05 * np.arange(5)
    return Sample(time=time, position=0.97 * moving[:-2], command=moving[2:])


COUNT = 2 * np.pi / 4096
"""[rad] of an encoder"""


def worn_sample(seconds: float = 20.0, stepping: bool = False) -> Sample:
    """A log of an arm that answers late, with play in the direction of its motion, in whole counts of its encoders."""
    fine = np.arange(-2.0, seconds, PERIOD / 4)
    speeds = np.array([0.9, 1.3, 1.7, 2.2, 2.9])
    asked = 0.5 * np.sin(np.outer(fine, speeds)) + 0.2 * np.sin(np.outer(fine, 1.9 * speeds)) + 0.05 * np.arange(5)
    if stepping:
        asked = 0.4 * np.sign(np.sin(np.outer(fine, np.full(5, 2 * np.pi / 6.0)))) + 0.05 * np.arange(5)
    late = np.maximum(np.arange(len(fine)) - 16, 0)  # 80 ms
    position, play = np.empty_like(asked), 0.02
    position[0] = asked[0]
    for k in range(1, len(fine)):
        goal = np.clip(position[k - 1], asked[late[k]] - play, asked[late[k]] + play)
        most = 0.6 * PERIOD / 4 if stepping else np.inf
        position[k] = position[k - 1] + np.clip(goal - position[k - 1], -most, most)
    rows = np.flatnonzero(fine >= 0)[::4]
    time = PERIOD * np.arange(len(rows))
    return Sample(time=time, position=np.round(position[rows] / COUNT) * COUNT, command=asked[rows])


def rows_of(values: Array) -> list[list[float]]:
    """Values with a gripper column behind the joints."""
    return [[*row, 0.5] for row in values.tolist()]


def write_sage(folder: Path, found: Sample, names: tuple[str, ...] = SAGE_NAMES) -> Path:
    """Write a motion as SAGE does, through the csv and json modules."""
    folder.mkdir(parents=True)
    (folder / "joint_list.txt").write_text("\n".join(names) + "\n")
    order = [SAGE_NAMES.index(name) for name in names]
    for file, kind, values in (("control.csv", "CONTROL", found.command), ("state_motor.csv", "STATE", found.position)):
        rest = ["velocities", "torques"] if kind == "STATE" else []
        with (folder / file).open("w", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(["type", "timestamp", "positions", *rest])
            for time, row in zip(found.time, rows_of(values), strict=True):
                shuffled = json.dumps([row[i] for i in order])
                writer.writerow([kind, repr(float(time) * 1e6), shuffled, *["[0.0]" for _ in rest]])
    return folder


def write_table(path: Path, found: Sample, titles: dict[str, str] | None = None, scale: float = 1.0) -> Path:
    """Write a CSV file through the csv module; `titles` renames columns."""
    columns = {"time_s": found.time}
    for group in ("position", "command"):
        for i, name in enumerate(ARM.joint_names):
            columns[f"{group}.{name}_rad"] = getattr(found, group)[:, i] * scale
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow([(titles or {}).get(title, title) for title in columns])
        writer.writerows(np.stack(list(columns.values()), axis=1).tolist())
    return path
