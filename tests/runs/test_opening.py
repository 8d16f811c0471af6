"""Run folders: which one is gone on with, who may work in it, and what a killed process leaves there."""

import os
from dataclasses import replace

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.logs.runfolder import LOGS, RunFolder, RunInfo, locked, runs_below
from rejoint.logs.runlog import RunLog
from rejoint.runs.run import Run, exclusive
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import write_json

ARM = mycobot280()


def folder_of(path, robot="emulated:worn"):
    info = RunInfo(robot=robot, arm="mycobot280", seed=0, version="1", created="now")
    write_json(path / "run.json", info)
    return RunFolder(path)


def test_a_run_that_was_killed_while_it_was_begun_is_begun_again(tmp_path):
    arm, path = replace(ARM, name="mine"), tmp_path / "run"
    path.mkdir()
    for name in (".lock", "arm.toml", ".run.json.abcd1234.partial"):
        (path / name).write_text("half")
    assert Run.create(path, "emulated:worn", arm).arm.name == "mine"
    assert Run.open(path).arm.name == "mine"
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").touch()
    with pytest.raises(InputError, match="not a run folder and not empty"):
        Run.create(other, "emulated:worn", arm)
    assert [path.name for path in other.iterdir()] == ["thesis.tex"]


def test_runs_are_found_at_any_depth(tmp_path, caplog):
    deep, damaged = folder_of(tmp_path / "lab" / "repairs" / "a1" / "001"), tmp_path / "lab" / "run.json"
    damaged.write_text("{}")
    assert list(runs_below(tmp_path)) == [deep]
    assert str(damaged) in caplog.text


def test_what_killed_writers_left_is_removed_and_nothing_else(tmp_path):
    folder, kept = folder_of(tmp_path), {"run.json", ".lock", "notes.partial", ".hidden.settings"}
    for place in (tmp_path, tmp_path / "logs", folder.training, folder.figures):
        place.mkdir(exist_ok=True)
        (place / ".policy.onnx.x7_kqpz1.partial").write_bytes(b"half")
    for name in kept - {"run.json", ".lock"}:
        (tmp_path / name).touch()
    with locked(folder):
        pass
    assert {path.name for path in tmp_path.rglob("*") if path.is_file()} == kept


@pytest.mark.parametrize(
    "words",
    [
        ("report", "{run}"),
        ("diagnose", "--logs", "{logs}", "--run", "{run}"),
        ("identify", "--logs", "{logs}", "--run", "{run}"),
        ("identify", "{run}"),
        ("train", "{run}"),
        ("compare", "emulated:worn", "{run}"),
        ("deploy", "emulated:worn", "{run}"),
    ],
)
def test_every_command_that_writes_in_a_run_waits_for_nobody(words, tmp_path, cli):
    logs, path = tmp_path / "logs", tmp_path / "run"
    time, still = np.arange(0.0, 2.0, 0.025), np.tile(ARM.rest, (80, 1))
    RunLog.of(time, still, still, arm=ARM).save(logs / "one.parquet")
    folder = folder_of(path, robot=f"{LOGS}{logs}" if "--logs" in words else "emulated:worn")
    with locked(folder):
        before = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
        err = cli(*(word.format(run=path, logs=logs) for word in words), code=2).err
        assert "this program is working there already; close what it has open there" in err
        assert {file: file.read_bytes() for file in path.rglob("*") if file.is_file()} == before


def test_a_folder_is_free_at_the_end_also_where_a_process_was_forked_meanwhile(tmp_path):
    """What a forked process inherits is the lock itself: a pool of workers kept the folder."""
    folder = folder_of(tmp_path)
    hears, says = os.pipe()
    with locked(folder):
        child = os.fork()
        if not child:
            os.close(says)
            os.read(hears, 1)  # until the other end is closed
            os._exit(0)
    try:
        with locked(folder):
            pass
    finally:
        os.close(says)
        os.close(hears)
        os.waitpid(child, 0)


def test_a_stage_that_fails_leaves_no_folder_that_it_has_not_begun(tmp_path):
    new, begun = Run.plan(tmp_path / "new", "logs:x", ARM, 0), Run.create(tmp_path / "begun", "logs:x", ARM)
    for run in (new, begun):
        with pytest.raises(FileError, match="nothing to work on"), exclusive(run):
            raise FileError(run.folder.path, "nothing to work on", "do something")
    assert not new.folder.path.exists()
    assert begun.folder.info.exists()
