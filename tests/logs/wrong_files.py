"""Two hundred files that are wrong, as strangers make them: each is refused in one line, or right in spite of it.

Every case is a file or folder below ``folder``, and what the command line has to do with it.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from log_samples import ARM, Sample, worn_sample

FOUND = worn_sample(seconds=6.0)
"""What every case began as: 300 readings"""
ROWS = len(FOUND.time)
TITLES = ["time_s", *(f"{group}.{name}_rad" for group in ("position", "command") for name in ARM.joint_names)]
TABLE = np.column_stack([FOUND.time, FOUND.position, FOUND.command])


@dataclass(frozen=True, kw_only=True)
class Case:
    """One file that is wrong, or odd."""

    name: str
    path: Path
    options: tuple[str, ...] = ()
    """of ``rejoint import``"""
    odd: bool = False
    """right in spite of being odd: imported with the numbers of `FOUND`"""
    rows: int = ROWS
    """that an odd one has"""
    said: str = ""
    """that the error has to say, or a note where the damage cannot be told from a measurement"""
    noted: bool = False
    """imported, and ``said`` in a note"""


@dataclass
class Maker:
    """Where cases are made, one folder for each."""

    folder: Path
    count: int = field(default=0)

    def place(self, name: str) -> Path:
        """Return a new path of that name."""
        self.count += 1
        folder = self.folder / f"{self.count:03d}"
        folder.mkdir(parents=True)
        return folder / name

    def file(self, name: str, data: bytes) -> Path:
        """Write a file of that name."""
        path = self.place(name)
        path.write_bytes(data)
        return path


def lines(table: np.ndarray = TABLE, titles: list[str] | None = None, separator: str = ",") -> list[str]:
    """Return a table as the lines of a text."""
    rows = [separator.join(repr(float(value)) for value in row) for row in table]
    return [separator.join(TITLES if titles is None else titles), *rows]


def text(rows: list[str]) -> bytes:
    """Return lines as a file."""
    return ("\n".join(rows) + "\n").encode()


def changed(column: str | int, change: Callable[[np.ndarray], np.ndarray], titles: list[str] | None = None) -> bytes:
    """Return the table with one column changed."""
    table = TABLE.copy()
    index = column if isinstance(column, int) else TITLES.index(column)
    table[:, index] = change(table[:, index])
    return text(lines(table, titles))


def scaled(position: float, command: float, unit: str = "rad") -> bytes:
    """Return the table with all angles scaled, called by another unit."""
    factors = np.array([1.0] + [position] * 5 + [command] * 5)
    return text(lines(TABLE * factors, [title.replace("_rad", f"_{unit}") for title in TITLES]))


def with_cell(row: int, column: int, cell: str) -> bytes:
    """Return the table with one cell as text."""
    rows = [line.split(",") for line in lines()]
    rows[row][column] = cell
    return text([",".join(line) for line in rows])


CELLS = (
    "nan",
    "NaN",
    "inf",
    "-inf",
    "",
    " ",
    "None",
    "NULL",
    "#N/A",
    "true",
    "0x10",
    "1.2.3",
    "1e999",
    "1e300",
    "1_0",
    "--1",
    "12:30:01",
    "1.0 rad",
    "٣",
    "=A1+B1",
)
"""What stands in cells of spreadsheets and prints of programs where a number should"""


def wrong_cells(make: Maker) -> Iterator[Case]:
    """One cell each in the columns of time, a position and a command."""
    for column in (0, 2, 8):
        for cell in CELLS:
            yield Case(name=f"cell {cell!r} in {TITLES[column]}", path=make.file("a.csv", with_cell(150, column, cell)))
    for value in ("5.0", "-300", "1e6"):
        yield Case(
            name=f"huge {value}",
            path=make.file("a.csv", with_cell(150, 3, value)),
            noted=value == "5.0",
            said="jump" * (value == "5.0"),
        )


def wrong_shapes(make: Maker) -> Iterator[Case]:
    """Cut, empty, renamed, compressed and binary files."""
    whole = text(lines())
    for share in (0.0, 0.001, 0.01, 0.02):
        yield Case(name=f"cut at {share}", path=make.file("a.csv", whole[: int(share * len(whole))]))
    cut = whole[: whole.index(b"\n", len(whole) // 2) - 9]
    yield Case(name="cut in a number", path=make.file("a.csv", cut), odd=True, rows=cut.count(b"\n") - 1)
    yield Case(name="cut in a row", path=make.file("a.csv", whole[: whole.index(b"\n", len(whole) // 2) - 90]))
    for name, data in {
        "ebcdic": whole.decode().encode("cp500"),
        "zlib": zlib.compress(whole),
        "gzip": b"\x1f\x8b\x08" + whole,
        "zip": b"PK\x03\x04" + whole,
        "noise": np.random.default_rng(0).bytes(5000),
        "zeros": bytes(5000),
        "png": b"\x89PNG\r\n\x1a\n" + bytes(100),
        "pdf": b"%PDF-1.7\n1 0 obj\n",
        "hdf5": b"\x89HDF\r\n\x1a\n" + bytes(100),
        "json": b'{"time": [0, 1], "q": [[0], [1]]}',
        "json list": b"[[0, 1], [2, 3]]",
        "xml": b"<log><q>1</q></log>",
        "html": b"<!DOCTYPE html>\n<table><tr><td>1,2</td></tr></table>",
        "pickle": b"\x80\x04\x95" + bytes(60),
        "numpy": b"\x93NUMPY\x01\x00" + bytes(60),
        "prose": b"Dear Sir,\nthe arm, I fear, is worn.\n",
        "half utf-16": whole.decode().encode("utf-16")[:-1],
        "utf-16 cut": whole.decode().encode("utf-16")[:151],
        "utf-8 and utf-16": whole[:5000] + whole[5000:].decode().encode("utf-16"),
        "bom alone": b"\xef\xbb\xbf",
        "blank": b"\n\n\n",
        "titles alone": text(lines()[:1]),
        "one row": text(lines()[:2]),
        "numbers alone": text(lines()[1:]),
        "titles again": text([*lines()[:99], lines()[0], *lines()[99:]]),
        "row of units": text([lines()[0], ",".join(["s"] + ["rad"] * 10), *lines()[1:]]),
        "unclosed quote": whole.replace(b"\n", b'\n"', 1),
        "one column": b"time_s\n0\n1\n",
        "long cell": b"time_s,position.shoulder_pan_rad\n" + b"1" * 2_000_000 + b",0\n",
        "many columns": b",".join(b"c%d" % i for i in range(20_000)) + b"\n" + b",".join([b"0"] * 20_000) + b"\n",
        "commas as points": text([line.replace(".", ",") if i else line for i, line in enumerate(lines())]),
    }.items():
        yield Case(name=name, path=make.file("a.csv", data))
    for end in (b"\r", b"\x0b", b"\x0c\n"):
        yield Case(name=f"lines that end in {end!r}", path=make.file("a.csv", whole.replace(b"\n", end)), odd=True)
    for ending in ("mcap", "db3", "parquet", "xlsx", "bag", "npz"):
        yield Case(name=f"renamed to {ending}", path=make.file(f"a.{ending}", whole), odd=True)
    for row in (7, 8, 150):
        yield Case(name=f"row {row} twice", path=make.file("a.csv", text(lines()[:row] + lines()[row - 1 :])), odd=True)


def wrong_columns(make: Maker) -> Iterator[Case]:
    """Titles that are missing, doubled, mixed up, or of something else."""
    for title in ("time_s", "position.elbow_flex_rad", "command.wrist_roll_rad"):
        index = TITLES.index(title)
        left = [TITLES[i] for i in range(11) if i != index]
        yield Case(name=f"without {title}", path=make.file("a.csv", text(lines(np.delete(TABLE, index, 1), left))))
        for other in ("position.shoulder_pan_rad", "Position.Elbow", "position.elbow_flex", "q3", "position._rad", ""):
            if other != title:
                renamed = [other if t == title else t for t in TITLES]
                yield Case(name=f"{title} called {other!r}", path=make.file("a.csv", text(lines(titles=renamed))))
    for first, second in ((1, 2), (1, 3), (2, 3), (3, 4), (4, 5), (1, 5)):
        order = list(range(11))
        order[first], order[second] = second, first
        yield Case(
            name=f"positions {first} and {second} mixed up", path=make.file("a.csv", text(lines(TABLE[:, order])))
        )
        shuffled = [TITLES[i] for i in order]
        right = text(lines(TABLE[:, order], shuffled))
        yield Case(name=f"columns {first} and {second} in another order", path=make.file("a.csv", right), odd=True)
    shifted = np.roll(TABLE, 1, axis=1)
    yield Case(name="one column to the right", path=make.file("a.csv", text(lines(shifted))))
    extra = np.column_stack([TABLE, 0.5 + 0 * TABLE[:, :2]])
    more = [*TITLES, "position.gripper_rad", "note"]
    yield Case(name="a gripper and a note", path=make.file("a.csv", text(lines(extra, more))), odd=True)
    yield Case(name="two times", path=make.file("a.csv", text(lines(extra, [*TITLES, "time_ms", "note"]))))
    yield Case(name="half a point", path=make.file("a.csv", text(lines(extra, [*TITLES, "target.x_m", "target.y_m"]))))
    yield Case(name="another arm", path=make.file("a.csv", text(lines())), options=("--arm", "mycobot280"))
    for pairs in ("elbow_flex=q", "time=t", "a=b", "elbow_flex", "time=time_s,time=time_s", "=,="):
        yield Case(name=f"map {pairs}", path=make.file("a.csv", text(lines())), options=("--map", pairs))


def wrong_clocks(make: Maker) -> Iterator[Case]:
    """Times in other units, that stand still, go back, are coarse, or belong to another clock."""

    def time(change: Callable[[np.ndarray], np.ndarray], unit: str = "s") -> bytes:
        return changed(0, change, [f"time_{unit}", *TITLES[1:]])

    for unit, factor in (("ms", 1e3), ("us", 1e6), ("ns", 1e9), ("min", 1 / 60), ("h", 1 / 3600)):
        yield Case(name=f"{unit} called s", path=make.file("a.csv", time(lambda t, f=factor: t * f)))
        if factor > 1:
            yield Case(name=f"s called {unit}", path=make.file("a.csv", time(lambda t: t, unit)))
            right = time(lambda t, f=factor: np.round(t * f), unit)
            yield Case(name=f"right {unit}", path=make.file("a.csv", right), odd=True)
    for name, change in {
        "all one": lambda t: 0 * t,
        "backwards": lambda t: t[::-1],
        "once back": lambda t: np.where(t > 3, t - 1, t),
        "wraps": lambda t: t % 2.0,
        "two swapped": lambda t: np.where(t == t[9], t[11], t),
        "rows": lambda t: 0 * t + np.arange(ROWS),
        "tenths": lambda t: np.floor(t * 10 + 1e-9) / 10,
        "halves": lambda t: np.floor(t * 2 + 1e-9) / 2,
        "pairs": lambda t: t[2 * (np.arange(ROWS) // 2)],
        "negative": lambda t: -t,
    }.items():
        yield Case(name=f"time {name}", path=make.file("a.csv", time(change)))
    uneven = time(lambda t: np.log(t + 1e-9))
    yield Case(
        name="logarithms of time", path=make.file("a.csv", uneven), noted=True, said="gap(s) longer than 5 periods"
    )
    for seconds in (-0.7, -0.5, -0.4, -0.3, -0.2, 0.3, 0.4, 0.5):
        rows = round(seconds / 0.02)
        table = np.column_stack([TABLE[:, :6], np.roll(TABLE[:, 6:], -rows, axis=0)])[
            max(-rows, 0) : ROWS - max(rows, 0)
        ]
        if seconds < 0:
            table = np.column_stack([TABLE[:, 0], np.roll(TABLE[:, 1:6], rows, axis=0), TABLE[:, 6:]])[: ROWS + rows]
            yield Case(name=f"states {-seconds} s early", path=make.file("a.csv", text(lines(table))), said="before")
        else:
            table = np.column_stack([TABLE[:, 0], np.roll(TABLE[:, 1:6], rows, axis=0), TABLE[:, 6:]])[rows:]
            yield Case(name=f"states {seconds} s late", path=make.file("a.csv", text(lines(table))), said="after")
    for period in (0.125, 0.2, 1 / 3, 0.5, 0.9, 2.0):
        slow = worn_sample(seconds=60.0, period=period)
        table = np.column_stack([slow.time, slow.position, slow.command])
        yield Case(name=f"{1 / period:.1f} Hz", path=make.file("a.csv", text(lines(table))))
    right = time(lambda t: t + 1_750_000_000.0)
    yield Case(name="unix time", path=make.file("a.csv", right), odd=True)


def wrong_angles(make: Maker) -> Iterator[Case]:
    """Angles in other units, with another zero, or that are no measurement at all."""
    degree = 180 / np.pi
    for name, data in {
        "degrees called radians": scaled(degree, degree),
        "radians called degrees": scaled(1, 1, "deg"),
        "milliradians": scaled(1e3, 1e3),
        "turns": scaled(0.5 / np.pi, 0.5 / np.pi),
        "counts": scaled(652, 652),
        "states in degrees": scaled(degree, 1),
        "commands in degrees": scaled(1, degree),
        "states in turns": scaled(0.5 / np.pi, 1),
        "percent": scaled(64, 64, "rad"),
        "turns called degrees": scaled(0.16, 0.16, "deg"),
        "copies": text(lines(np.column_stack([TABLE[:, 0], TABLE[:, 6:], TABLE[:, 6:]]))),
        "copies of the next": text(lines(np.column_stack([TABLE[:-1, 0], TABLE[1:, 6:], TABLE[:-1, 6:]]))),
        "commands made of states": text(lines(np.column_stack([TABLE[:-1, :6], TABLE[1:, 1:6]]))),
        "states and commands swapped": text(lines(TABLE[:, [0, *range(6, 11), *range(1, 6)]])),
    }.items():
        yield Case(name=name, path=make.file("a.csv", data))
    for column in (1, 3, 5):
        both = TABLE.copy()
        both[:, [column, column + 5]] *= degree
        yield Case(name=f"joint {column} in degrees", path=make.file("a.csv", text(lines(both))))
        titles = [title.replace("_rad", "_deg") for title in TITLES]
        mixed = TABLE * np.array([1.0] + [degree] * 10)
        mixed[:, [column, column + 5]] /= degree
        yield Case(name=f"joint {column} in radians", path=make.file("a.csv", text(lines(mixed, titles))))
        yield Case(
            name=f"joint {column} off by 90 degrees", path=make.file("a.csv", changed(column, lambda q: q + np.pi / 2))
        )
        yield Case(
            name=f"joint {column} off by a turn", path=make.file("a.csv", changed(column, lambda q: q + 2 * np.pi))
        )
        turned = changed(column, lambda q: -q)
        yield Case(
            name=f"joint {column} turned around",
            path=make.file("a.csv", turned),
            noted=True,
            said="against its command",
        )
        frozen = changed(column, lambda q: 0 * q + q[0])
        assert frozen  # a joint that does not move is a finding, and no wrong file
    dead = TABLE.copy()
    dead[100:200, 1:6] = dead[100, 1:6]
    yield Case(name="frozen", path=make.file("a.csv", text(lines(dead))), noted=True, said="the readings freeze")
    right = scaled(degree, degree, "deg")
    yield Case(name="right degrees", path=make.file("a.csv", right), odd=True)


def flipped(data: bytes, seed: int) -> bytes:
    """Turn one bit around."""
    rng = np.random.default_rng(seed)
    at, bit = int(rng.integers(len(data))), int(rng.integers(8))
    return data[:at] + bytes([data[at] ^ (1 << bit)]) + data[at + 1 :]


def wrong_places(make: Maker) -> Iterator[Case]:
    """What is no file, is too large, or leads nowhere."""
    yield Case(name="nothing there", path=make.place("a.csv"))
    empty = make.place("logs")
    empty.mkdir()
    yield Case(name="an empty folder", path=empty)
    folder = make.place("a.csv")
    folder.mkdir()
    yield Case(name="a folder called a.csv", path=folder)
    others = make.place("logs")
    others.mkdir()
    (others / "readme.md").write_text("see a, b and c")
    (others / "b.csv").write_text("x,y\n1,2\n")
    yield Case(name="a folder of other files", path=others)
    loop = make.place("loop.csv")
    loop.symlink_to(loop)
    yield Case(name="a link to itself", path=loop)
    dangling = make.place("gone.csv")
    dangling.symlink_to("nowhere.csv")
    yield Case(name="a link to nothing", path=dangling)
    linked = make.place("linked.csv")
    linked.symlink_to(make.file("b.csv", text(lines())))
    yield Case(name="a link to a log", path=linked, odd=True)
    within = make.place("logs")
    within.mkdir()
    (within / "self").symlink_to(within)
    yield Case(name="a folder that holds itself", path=within)
    device = make.place("zero.csv")
    device.symlink_to("/dev/zero")
    yield Case(name="a device without end", path=device)
    pipe = make.place("pipe.csv")
    os.mkfifo(pipe)
    yield Case(name="a pipe", path=pipe)
    for name in ("big.csv", "big.parquet", "big.mcap", "big.db3"):
        big = make.file(
            name,
            text(lines())
            if name == "big.csv"
            else {"mcap": b"\x89MCAP0\r\n", "db3": b"SQLite format 3\x00"}.get(name[4:], b"PAR1"),
        )
        os.truncate(big, 1_200_000_000)  # a hole: it takes no space
        yield Case(name=f"1.2 GB of nothing in {name}", path=big)


def sample() -> Sample:
    """Return what every case began as."""
    return FOUND
