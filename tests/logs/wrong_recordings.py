"""Wrong recordings of programs: bags, LeRobot datasets and SAGE folders (see `wrong_files`)."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from log_samples import write_sage
from test_logs_doubts import dataset
from test_logs_mcap import messages, write_json, write_rosbag
from test_logs_ros import ARRAYS, TRAJECTORIES, array, states, trajectory, write
from wrong_files import FOUND, ROWS, Case, Maker, flipped

DEG = ("--angle-unit", "deg")


def wrong_bags(make: Maker) -> Iterator[Case]:
    """MCAP and sqlite3 bags that are cut, damaged, or lack what a log needs."""
    sent = [(ARRAYS, round(1e9 * t), array(u)) for t, u in zip(FOUND.time, FOUND.command, strict=True)]
    order = ("--order", "shoulder_pan,shoulder_lift,elbow_flex,wrist_flex,wrist_roll")
    for storage, ending in (("mcap", "mcap"), ("rosbag", "db3")):
        whole = write(make.place("bag"), storage, states(FOUND) + sent)
        yield Case(name=f"{ending} right", path=whole, options=order, odd=True)
        yield Case(name=f"{ending} without order", path=whole, said="--order")
        yield Case(
            name=f"{ending} wrong order",
            path=whole,
            options=("--order", "shoulder_lift,shoulder_pan,elbow_flex,wrist_flex,wrist_roll"),
        )
        yield Case(name=f"{ending} short order", path=whole, options=("--order", "a,b"))
        yield Case(name=f"{ending} other topic", path=whole, options=("--state-topic", "/robot/joints"), said="50 Hz")
        yield Case(name=f"{ending} one topic", path=whole, options=("--command-topic", "/joint_states"))
        yield Case(name=f"{ending} in degrees", path=whole, options=(*order, *DEG))
        data = whole.read_bytes()
        for share in (0.001, 0.1, 0.5, 0.9, 0.999):
            yield Case(
                name=f"{ending} cut at {share}",
                path=make.file(f"a.{ending}", data[: int(share * len(data))]),
                options=order,
            )
        for seed in range(8):
            yield Case(
                name=f"{ending} flip {seed}",
                path=make.file(f"a.{ending}", flipped(data, seed)),
                options=order,
                said="?",
            )
        yield Case(name=f"{ending} called csv", path=make.file("a.csv", data), options=order, odd=ending == "mcap")
        for name, more in {
            "commands alone": sent,
            "no message about joints": [("/tf", 0, array(np.zeros(2)))],
            "arrays too short": states(FOUND) + [(ARRAYS, t, array(np.zeros(3))) for _, t, _ in sent],
            "late start": [(topic, t, m) for topic, t, m in states(FOUND) if t < 10**9]
            + [one for one in sent if one[1] > 2 * 10**9],
            "trajectory without points": [*states(FOUND), (TRAJECTORIES, 0, trajectory([], np.zeros((0, 5))))],
            "trajectory of others": [
                *states(FOUND),
                (TRAJECTORIES, 0, trajectory([1.0], np.zeros((1, 5)), names=[*"abcde"])),
            ],
            "velocities": states(FOUND) + [("/arm_velocity_controller/commands", t, m) for _, t, m in sent],
        }.items():
            yield Case(name=f"{ending} {name}", path=write(make.place("bag"), storage, more), options=order)
    bag = write_rosbag(make.place("bag"), FOUND)
    yield Case(name="joint states as commands", path=bag, odd=True)
    plain = write_json(make.place("a.mcap"), FOUND)
    yield Case(name="json right", path=plain, odd=True)
    names = [f"joint{i}" for i in range(5)]
    for name, content in {
        "other names": {"name": names, "position": [0.0] * 5},
        "no positions": {"name": names},
        "text": {"name": names, "position": ["a"] * 5},
        "a list": [1, 2, 3],
        "null": None,
        "null positions": {"name": names, "position": [None] * 5},
    }.items():
        both = {topic: [content] * 30 for topic in ("/joint_states", "/joint_commands")}
        yield Case(name=f"json {name}", path=messages(make.place("a.mcap"), both))
    yield Case(name="json of no topic", path=messages(make.place("a.mcap"), {}))


def wrong_datasets(make: Maker) -> Iterator[Case]:
    """LeRobot datasets whose metadata or frames are damaged, or say something else."""
    degrees = np.full(5, 180 / np.pi)
    base = dataset(make.place("set"), degrees, FOUND)
    info, frames = "meta/info.json", "data/chunk-000/file-000.parquet"

    def copy(change: Callable[[Path], object]) -> Path:
        place = make.place("set")
        shutil.copytree(base, place)
        change(place)
        return place

    def meta(**entries: object) -> Callable[[Path], object]:
        def change(place: Path) -> None:
            held = json.loads((place / info).read_text()) | entries
            (place / info).write_text(json.dumps(held))

        return change

    def table(change: Callable[[pa.Table], pa.Table]) -> Callable[[Path], object]:
        return lambda place: pq.write_table(change(pq.read_table(place / frames)), place / frames)

    def column(name: str, values: object) -> Callable[[Path], object]:
        return table(lambda t: t.set_column(t.column_names.index(name), name, values))

    state = pq.read_table(base / frames)["observation.state"].to_pylist()
    names = [f"{name}.pos" for name in "abcde"]
    feature = {"dtype": "float32", "shape": [5], "names": names}
    yield Case(name="dataset right", path=base, options=DEG, odd=True)
    yield Case(name="dataset without unit", path=base)
    yield Case(name="dataset in radians", path=base, options=("--angle-unit", "rad"))
    yield Case(name="normalised without calibration", path=base, options=("--angle-unit", "normalised"))
    yield Case(
        name="calibration of nothing",
        path=base,
        options=("--angle-unit", "normalised", "--calibration", str(base / info)),
    )
    for name, change in {
        "without info": lambda p: (p / info).unlink(),
        "without data": lambda p: shutil.rmtree(p / "data"),
        "without a file": lambda p: (p / frames).unlink(),
        "empty info": lambda p: (p / info).write_text(""),
        "half an info": lambda p: os.truncate(p / info, 60),
        "info a list": lambda p: (p / info).write_text("[]"),
        "deep info": lambda p: (p / info).write_text("[" * 100_000),
        "huge info": lambda p: os.truncate(p / info, 200_000_000),
        "version 2": meta(codebase_version="v2.1"),
        "version 4": meta(codebase_version="v4.0"),
        "no version": meta(codebase_version=None),
        "no rate": meta(fps=0),
        "negative rate": meta(fps=-50),
        "rate in words": meta(fps="fast"),
        "infinite rate": meta(fps=1e999),
        "other count": meta(total_frames=ROWS + 1),
        "no features": meta(features={}),
        "features a list": meta(features=[1]),
        "other names": meta(features={"observation.state": feature, "action": feature}),
        "short names": meta(features={"observation.state": feature | {"names": names[:3]}, "action": feature}),
        "two dimensions": meta(features={"observation.state": feature | {"shape": [5, 1]}, "action": feature}),
        "half the frames": lambda p: os.truncate(p / frames, 3000),
        "empty frames": lambda p: (p / frames).write_bytes(b""),
        "frames of text": lambda p: (p / frames).write_text("time_s,q\n0,1\n"),
        "frames a folder": lambda p: ((p / frames).unlink(), (p / frames).mkdir()),
        "no action": table(lambda t: t.drop_columns(["action"])),
        "no stamps": table(lambda t: t.drop_columns(["timestamp"])),
        "texts": column("observation.state", pa.array([[str(v) for v in row] for row in state])),
        "null rows": column("observation.state", pa.array([None, *state[1:]])),
        "null values": column("observation.state", pa.array([[None, *row[1:]] for row in state])),
        "short rows": column("observation.state", pa.array([row[:4] for row in state])),
        "one short row": column("observation.state", pa.array([state[0][:4], *state[1:]])),
        "not finite": column("observation.state", pa.array([[float("inf"), *row[1:]] for row in state])),
        "frames doubled": column("frame_index", pa.array(np.arange(ROWS) // 2)),
        "stamps in ms": column("timestamp", pa.array((FOUND.time * 1e3).astype(np.float32))),
        "stamps of text": column("timestamp", pa.array([str(t) for t in FOUND.time])),
        "copied": column("action", pa.array(state)),
        "copied from the next": column("action", pa.array([*state[1:], state[-1]])),
        "joints turned over": column("observation.state", pa.array([row[::-1] for row in state])),
    }.items():
        yield Case(name=f"dataset {name}", path=copy(change), options=DEG)
    for seed in range(4):
        place = copy(lambda p, s=seed: (p / frames).write_bytes(flipped((p / frames).read_bytes(), s)))
        yield Case(name=f"dataset flip {seed}", path=place, options=DEG, said="?")
    yield Case(name="dataset without tasks", path=copy(lambda _: None), options=DEG, odd=True)


def wrong_folders(make: Maker) -> Iterator[Case]:
    """Motions of SAGE whose files are missing, cut, or contradict one another."""

    def motion(change: Callable[[Path], object]) -> Path:
        folder = write_sage(make.place("motion"), FOUND)
        change(folder)
        return folder

    def edit(file: str, change: Callable[[str], str]) -> Callable[[Path], object]:
        return lambda folder: (folder / file).write_text(change((folder / file).read_text()))

    yield Case(name="sage right", path=motion(lambda _: None), odd=True)
    yield Case(name="sage in degrees", path=motion(lambda _: None), options=DEG)
    yield Case(name="sage in s", path=motion(lambda _: None), options=("--time-unit", "s"))
    for name, change in {
        "without states": lambda f: (f / "state_motor.csv").unlink(),
        "without joints": lambda f: (f / "joint_list.txt").unlink(),
        "without commands": lambda f: (f / "control.csv").unlink(),
        "no joints": edit("joint_list.txt", lambda _: ""),
        "fewer joints": edit("joint_list.txt", lambda t: t.split("\n")[0]),
        "a joint twice": edit("joint_list.txt", lambda t: t.replace("Elbow", "Pitch")),
        "other joints": edit("joint_list.txt", lambda t: t.replace("Elbow", "Knee")),
        "cut states": edit("state_motor.csv", lambda t: t[: len(t) // 2]),
        "empty states": edit("state_motor.csv", lambda _: ""),
        "titles alone": edit("state_motor.csv", lambda t: t.split("\n")[0] + "\n"),
        "other titles": edit("control.csv", lambda t: t.replace("timestamp", "time")),
        "nan": edit("state_motor.csv", lambda t: t.replace("[0.", "[NaN, 0.", 1)),
        "huge": edit("control.csv", lambda t: t.replace("[0.", "[1e30", 1)),
        "negative time": edit("control.csv", lambda t: t.replace("20000.0", "-20000.0")),
        "stamps in s": edit("control.csv", lambda t: t.replace("0000.0,", ".0,")),
    }.items():
        yield Case(name=f"sage {name}", path=motion(change))
    for seed in range(6):
        folder = motion(lambda f, s=seed: (f / "control.csv").write_bytes(flipped((f / "control.csv").read_bytes(), s)))
        yield Case(name=f"sage flip {seed}", path=folder, said="?")
