"""Run folders: which one is gone on with, who may work in it, and what a killed process leaves there."""

import logging
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rejoint
from modelfiles import ur5e
from rejoint.arms import load_arm, mycobot280, write_arm_toml
from rejoint.arms.loaded import loaded
from rejoint.cli import main
from rejoint.logs.journal import Journal
from rejoint.logs.runfolder.folder import FORMAT, LOGS, RunFolder, RunInfo, locked
from rejoint.logs.runlog import RunLog, write_log
from rejoint.robots.emulated import EmulatedRobot
from rejoint.runs.run import Run, exclusive, finish, is_finished, mark_quick, newest_or_new, require_same_pace
from rejoint.system.errors import FileError, InputError, NotReadyError
from rejoint.system.files import write_json

ARM = mycobot280()
STAGES = ("diagnosis.json", "twin.toml", "policy.onnx", "comparison.json")


def folder_of(path: Path, robot: str = "emulated:worn", version: int = FORMAT) -> RunFolder:
    info = RunInfo(robot=robot, arm="mycobot280", seed=0, version="1", created="now", format=version)
    write_json(path / "run.json", info)
    return RunFolder(path)


def leave(folder: RunFolder, *names: str) -> None:
    """Leave files that were written one after the other, a second apart."""
    for age, name in enumerate(reversed(names)):
        (folder.path / name).write_text("done")
        os.utime(folder.path / name, (0, 1_000_000_000 - age))


def test_a_report_alone_is_no_end(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    for count in range(len(STAGES)):
        leave(folder, *STAGES[:count], "report.html")
        assert not is_finished(folder)
    leave(folder, *STAGES, "report.html")
    assert is_finished(folder)


def test_a_report_of_before_the_last_stage_is_no_end(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    leave(folder, *STAGES[:3], "report.html", STAGES[3])
    assert not is_finished(folder)
    finish(Run(folder=folder, info=RunInfo(robot="", arm="", seed=0, version="", created=""), arm=ARM))
    assert is_finished(folder)


def test_runs_of_before_repair_noted_its_end_stay_finished(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, version=1)
    leave(folder, *STAGES[:3], "report.html", STAGES[3])
    assert is_finished(folder)
    folder.comparison.unlink()
    assert not is_finished(folder)


def test_a_run_of_logs_ends_with_its_twin_and_the_report(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, robot=f"{LOGS}here")
    leave(folder, "diagnosis.json", "report.html")
    assert not is_finished(folder)
    leave(folder, "diagnosis.json", "twin.toml", "judgement.json", "report.html")
    assert is_finished(folder)


def test_a_run_that_was_killed_while_it_was_begun_is_begun_again(tmp_path: Path) -> None:
    arm, path = replace(ARM, name="mine"), tmp_path / "run"
    path.mkdir()
    for name in (".lock", "arm.toml", ".run.json.abcd1234.partial"):
        (path / name).write_text("half")
    assert Run.create(path, "emulated:worn", arm, 0).arm.name == "mine"
    assert Run.open(path).arm.name == "mine"
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").touch()
    with pytest.raises(InputError, match="not a run folder and not empty"):
        Run.create(other, "emulated:worn", arm, 0)


def test_a_corrected_description_does_not_go_on_in_the_run_of_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    arm = replace(ur5e(), name="mine")
    heavier = replace(arm, mass=1.2 * arm.mass)
    first, _ = newest_or_new("emulated:worn", arm, 0)
    run = Run.create(first, "emulated:worn", arm, 0)
    write_arm_toml(tmp_path / "same.toml", arm)
    for same in (arm, load_arm(tmp_path / "same.toml"), loaded(arm, payload=0.5)):  # written and read, and a full hand
        assert Run.plan(first, "emulated:worn", same, 0).arm.name == "mine"
        assert run.is_of("emulated:worn", same)
    with pytest.raises(InputError, match=r"another description of mine \(it differs in mass\); give another"):
        Run.plan(first, "emulated:worn", heavier, 0)
    assert not run.is_of("emulated:worn", heavier)
    assert newest_or_new("emulated:worn", arm, 0) == (first, True)
    assert newest_or_new("emulated:worn", heavier, 0) == (first.with_name("002"), False)


def test_what_killed_writers_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    folder, kept = folder_of(tmp_path), {"run.json", ".lock", "notes.partial", ".hidden.settings"}
    for place in (tmp_path, tmp_path / "logs", folder.outputs.folder, folder.figures):
        place.mkdir(exist_ok=True)
        (place / ".policy.onnx.x7_kqpz1.partial").write_bytes(b"half")
    for name in kept - {"run.json", ".lock"}:
        (tmp_path / name).touch()
    with locked(folder):
        pass
    assert {path.name for path in tmp_path.rglob("*") if path.is_file()} == kept


def test_a_log_that_was_cut_short_is_told_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = folder_of(tmp_path)
    row = (np.zeros(1), np.zeros(1), np.zeros(3), np.zeros(3))
    journal = Journal.begin(folder.log("deploy-1"), arm="x", joint_names=("a",), robot="tcp://x", label="deploy/policy")
    journal.append(0.0, *row)
    journal.close()
    with caplog.at_level(logging.WARNING, logger="rejoint"), locked(folder):
        pass
    assert [record.getMessage() for record in caplog.records] == [
        f"A run that was cut short is kept: {folder.log('deploy-1-cut-short')}"
    ]


def example() -> RunLog:
    time, still = np.arange(0.0, 2.0, 0.025), np.tile(ARM.rest, (80, 1))
    return RunLog(
        arm=ARM.name, joint_names=ARM.joint_names, robot="x", label="x", time=time, position=still, command=still,
        target=np.full((80, 3), np.nan), true_tcp=np.full((80, 3), np.nan),
    )  # fmt: skip


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
def test_every_command_that_writes_in_a_run_waits_for_nobody(
    words: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    logs, path = tmp_path / "logs", tmp_path / "run"
    write_log(logs / "one.parquet", example())
    folder = folder_of(path, robot=f"{LOGS}{logs}" if "--logs" in words else "emulated:worn")
    places = {"{run}": str(path), "{logs}": str(logs)}
    monkeypatch.setattr(sys, "argv", ["rejoint", *(places.get(word, word) for word in words)])
    with locked(folder):
        before = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
        with pytest.raises(SystemExit) as stopped:
            main()
        assert stopped.value.code == 2
        assert "this program is working there already; close what it has open there" in capsys.readouterr().err
        assert {file: file.read_bytes() for file in path.rglob("*") if file.is_file()} == before


def test_a_folder_is_free_at_the_end_also_where_a_process_was_forked_meanwhile(tmp_path: Path) -> None:
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


def test_a_stage_that_fails_leaves_no_folder_that_it_has_not_begun(tmp_path: Path) -> None:
    run = Run.plan(tmp_path / "new", "logs:x", ARM, 0)

    def stage(run: Run) -> None:
        with exclusive(run):
            raise FileError(run.folder.path, "nothing to work on", "do something")

    with pytest.raises(FileError, match="nothing to work on"):
        stage(run)
    assert not run.folder.path.exists()
    begun = Run.create(tmp_path / "begun", "logs:x", ARM, 0)
    with pytest.raises(FileError, match="nothing to work on"):
        stage(begun)
    assert begun.folder.info.exists()


def test_a_full_repair_does_not_build_on_a_quick_one(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "run", "emulated:worn", ARM, 0)
    mark_quick(run, quick=False)
    require_same_pace(run, quick=False)
    mark_quick(run, quick=True)
    require_same_pace(run, quick=True)
    with pytest.raises(InputError, match="a quick try, which is no result; give another --run"):
        rejoint.repair(run=run)
    assert sorted(path.name for path in run.path.iterdir()) == ["quick.json", "run.json"], "nothing has been begun"


@pytest.mark.parametrize(
    ("what", "error"), [("read", NotReadyError), ("read", ZeroDivisionError), ("__init__", ZeroDivisionError)]
)
def test_a_first_contact_that_fails_leaves_nothing(
    what: str, error: type[Exception], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error("made for this test")

    monkeypatch.setattr(EmulatedRobot, what, fail)
    for run in (tmp_path / "one", Run.create(tmp_path / "two", "emulated:worn", ARM)):
        with pytest.raises(error):
            rejoint.diagnose("emulated:worn", run=run)
    assert not list(tmp_path.iterdir())
