"""Two hundred wrong files through the command line: none silent, one line each, nothing left behind."""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import typer
import wrong_files as wrong
from wrong_files import FOUND, Case, Maker
from wrong_recordings import wrong_bags, wrong_datasets, wrong_folders

import rejoint.cli
from commandline import run_cli
from rejoint.arms import so101
from rejoint.logs import ImportOptions, import_logs
from rejoint.logs.runlog import RunLog, read_log, write_log
from rejoint.system.errors import FileError

COMMANDS = typer.main.get_command(rejoint.cli.app)
"""The command line, built once: as it is called, four hundred times"""
GROUPS: dict[str, tuple[Callable[[Maker], Iterator[Case]], int]] = {
    "cells": (wrong.wrong_cells, 60),
    "shapes": (wrong.wrong_shapes, 40),
    "columns": (wrong.wrong_columns, 35),
    "clocks": (wrong.wrong_clocks, 35),
    "angles": (wrong.wrong_angles, 25),
    "places": (wrong.wrong_places, 13),
    "bags": (wrong_bags, 40),
    "datasets": (wrong_datasets, 45),
    "folders": (wrong_folders, 20),
}
"""Cases by what is wrong, and how many there are at least"""
DEVIATION = 0.051
"""[rad] by which a reading may differ where one bit was turned around and nothing said: above it, it jumps out"""


@pytest.fixture
def spare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for all that a program puts aside."""
    (tmp_path / "spare").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "spare"))
    monkeypatch.chdir(tmp_path / "spare")
    return tmp_path / "spare"


def run(words: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> tuple[int, str, str]:
    monkeypatch.setattr(rejoint.cli, "app", COMMANDS)
    return run_cli(*words, capsys=capsys, monkeypatch=monkeypatch)


def left(folder: Path) -> set[str]:
    return {os.path.relpath(Path(top) / name, folder) for top, dirs, files in os.walk(folder) for name in dirs + files}


def verdict(case: Case, done: tuple[int, str, str], out: Path) -> str:
    """Say what is wrong with how a case was taken; empty if nothing is."""
    code, told, errors = done
    if code != 0:
        if case.odd or case.noted:
            return f"refused: {errors}"
        if code != 2 or told or len(errors.splitlines()) != 1 or not errors.startswith("error: ") or len(errors) > 900:
            return f"not one clear line: {code} {told} {errors}"
        return "" if case.said.strip("?") in errors else f"{case.said!r} is not in: {errors}"
    if case.noted:
        return "" if case.said in errors else f"silent: {errors}"
    log = read_log(next(out.glob("*.parquet")))
    if case.said == "?" and len(log) <= len(FOUND.time) and "jump" not in errors:
        rows = np.clip(
            np.searchsorted(FOUND.time, log.time - log.time[0] + FOUND.time[0] - 1e-3), 0, len(FOUND.time) - 1
        )
        off = np.abs(log.position - FOUND.position[rows]).max() if errors.count("\n") < 5 else 0.0
        return "" if off < DEVIATION or "left out" in errors else f"silent by {off} rad: {errors}"
    if case.said == "?":
        return ""
    if not case.odd:
        return f"imported: {errors}"
    same = slice(0, case.rows)
    if len(log) != case.rows or not np.allclose(log.position, FOUND.position[same], atol=1e-6):
        return f"{len(log)} rows that are not those of the file"
    if log.commanded and not np.allclose(log.command, FOUND.command[same], atol=1e-6):
        return "other commands than those of the file"
    return "" if np.allclose(np.diff(log.time), 0.02, atol=1e-6) else "other times than those of the file"


@pytest.mark.parametrize("group", GROUPS)
def test_none_is_silent(
    group: str, tmp_path: Path, spare: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    make, least = GROUPS[group]
    failed = []
    cases = list(make(Maker(folder=tmp_path / "in")))
    assert len(cases) >= least
    for case in cases:
        before = left(tmp_path)
        arm = () if "--arm" in case.options else ("--arm", "so101")
        done = run(["import", str(case.path), "out", *arm, *case.options], capsys, monkeypatch)
        wrong_with_it = verdict(case, done, spare / "out")
        shutil.rmtree(spare / "out", ignore_errors=True)
        if left(tmp_path) != before:
            wrong_with_it += f" left behind: {left(tmp_path) - before}"
        if wrong_with_it:
            failed.append(f"{case.name}: {wrong_with_it}")
    assert not failed, "\n".join(failed)


def test_there_are_two_hundred():
    assert sum(least for _, least in GROUPS.values()) >= 200


def a_log(folder: Path, **changes: object) -> RunLog:
    folder.mkdir(parents=True, exist_ok=True)
    log = RunLog.of(FOUND.time, FOUND.command, FOUND.position, arm="so101", label="a")
    write_log(folder / "a.parquet", log)
    return log


def wrong_logs(make: Maker) -> Iterator[tuple[str, Path, tuple[str, ...]]]:
    """Folders that are no folders of run logs, or hold wrong ones."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    def folder(change: Callable[[Path], object]) -> Path:
        place = make.place("logs")
        a_log(place)
        change(place)
        return place

    whole = (folder(lambda _: None) / "a.parquet").read_bytes()
    yield "too short", folder(lambda _: None), ()
    yield "another arm", folder(lambda _: None), ("--arm", "mycobot280")
    yield "no such arm", folder(lambda _: None), ("--arm", "puma560")
    yield "nothing there", make.place("logs"), ()
    yield "text", make.file("log.csv", wrong.text(wrong.lines())), ()
    yield "a folder of text", make.file("log.csv", wrong.text(wrong.lines())).parent, ()
    for name, change in {
        "empty": lambda p: (p / "a.parquet").unlink(),
        "no bytes": lambda p: (p / "a.parquet").write_bytes(b""),
        "another table": lambda p: pq.write_table(pa.table({"t": [0.0], "q": [1.0]}), p / "b.parquet"),
        "text as parquet": lambda p: (p / "b.parquet").write_text("time,q\n0,1\n"),
        "a folder as parquet": lambda p: (p / "b.parquet").mkdir(),
        "a pipe": lambda p: os.mkfifo(p / "b.parquet"),
        "a link to nothing": lambda p: (p / "b.parquet").symlink_to("c"),
        "a link to itself": lambda p: (p / "b.parquet").symlink_to("b.parquet"),
        "1.2 GB of nothing": lambda p: os.truncate(p / "a.parquet", 1_200_000_000),
    }.items():
        yield name, folder(change), ()
    for share in (0.001, 0.3, 0.9, 0.999):
        yield f"cut at {share}", folder(lambda p, s=share: os.truncate(p / "a.parquet", int(s * len(whole)))), ()
    for seed in range(6):
        yield f"flip {seed}", folder(lambda p, s=seed: (p / "a.parquet").write_bytes(wrong.flipped(whole, s))), ()


@pytest.mark.parametrize("command", ["diagnose", "identify"])
def test_wrong_run_logs_are_refused(
    command: str, tmp_path: Path, spare: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    failed = []
    for name, logs, options in wrong_logs(Maker(folder=tmp_path / "in")):
        before = left(tmp_path)
        arm = () if "--arm" in options else ("--arm", "so101")
        code, told, errors = run([command, "--logs", str(logs), "--run", "run", *arm, *options], capsys, monkeypatch)
        if code != 2 or told or len(errors.splitlines()) != 1 or not errors.startswith("error: "):
            failed.append(f"{name}: {code} {told} {errors}")
        if left(tmp_path) != before:
            failed.append(f"{name} left behind: {left(tmp_path) - before}")
    assert not failed, "\n".join(failed)
    assert list(spare.iterdir()) == []


def test_what_unfolds_to_any_size_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    make = Maker(folder=tmp_path / "in")
    data = next(case.path for case in wrong_datasets(make) if case.name == "dataset right")
    bag = next(case.path for case in wrong_bags(make) if case.name == "json right")
    text = make.file("a.csv", wrong.text(wrong.lines()))
    monkeypatch.setattr("rejoint.logs.runlog.VALUES_MOST", 1000)
    monkeypatch.setattr("rejoint.logs.mcapfile._CHUNK_MOST", 1000)
    monkeypatch.setattr("rejoint.logs.textfile.TEXT_MOST", 1000)
    for source, said in (
        (data, r"3900 numbers, expected at most 1000"),
        (bag, "a chunk of"),
        (text, "expected at most"),
    ):
        options = ImportOptions(angle_unit="deg") if source is data else ImportOptions()
        with pytest.raises(FileError, match=said):
            import_logs(source, so101(), out=tmp_path / "out", options=options)
    assert not (tmp_path / "out").exists()
