"""A disk that is full or read-only: known before an arm moves, and no result lost with its file."""

import errno
import os
import shutil
from pathlib import Path

import pytest

import rejoint
from hearing import Hears
from rejoint.arms import mycobot280
from rejoint.logs.runfolder import locked
from rejoint.logs.runlog import RunLog
from rejoint.runs.run import Run
from rejoint.system.errors import UnsavedError
from rejoint.system.files import saving, write_json


@pytest.fixture
def folder(tmp_path):
    return Run.create(tmp_path / "run", "emulated:worn", mycobot280()).folder


@pytest.fixture
def points(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text("x,y,z\n170,0,200\n")
    return path


def fill(monkeypatch, name):
    """Let the disk be full when a file whose name holds ``name`` is to be kept."""
    replace = Path.replace

    def full(self, target):
        if name in self.name:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", full)


@pytest.mark.parametrize(
    "words",
    [
        ("deploy", "emulated:worn", "{run}", "--controller", "integrator"),
        ("compare", "emulated:worn", "{run}", "--controllers", "integrator"),
        ("diagnose", "emulated:worn", "--run", "{run}"),
    ],
)
def test_an_arm_does_not_move_where_its_log_may_not_fit(words, folder, cli, monkeypatch):
    usage = shutil.disk_usage(folder.path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=12_300_000))

    monkeypatch.setattr("rejoint_lab.emulated.EmulatedRobot.step", lambda *_: pytest.fail("the arm was moved"))
    err = cli(*(word.format(run=folder.path) for word in words), code=2).err
    assert f"{folder.path}: 12.3 MB free on that disk, 50.0 MB needed; free some space" in err


def test_a_deployment_is_shown_and_kept_on_a_disk_that_filled_meanwhile(folder, points, cli, monkeypatch):
    words = ("deploy", "emulated:worn", folder.path, "--controller", "integrator", "--targets", points)
    with monkeypatch.context() as full:
        fill(full, ".deploy-")
        done = cli(*words, code=2)
    assert "encoder error" in done.out
    assert "170.0" in done.out
    (line,) = [line for line in done.err.splitlines() if line.startswith("error: ")]
    assert "logs/deploy-" in line
    assert ".parquet: cannot be written (No space left on device); free some space" in line
    assert "the next command in this folder makes a log of it" in done.err
    with locked(folder):  # as it would
        ((name, path),) = folder.logs().items()
    log = RunLog.load(path)
    assert name.endswith("-cut-short")
    assert log.label == "deploy/integrator/cut-short"
    assert log.time[-1] - log.time[0] == pytest.approx(4.2, abs=0.3)
    assert {file.name for file in path.parent.iterdir()} == {path.name}


def test_an_error_ends_no_run_without_its_log_and_no_log_hides_the_error(folder, monkeypatch):
    run = Run.open(folder.path)
    fill(monkeypatch, ".deploy-")

    def interrupt(share, _):
        if share > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as caught:
        rejoint.deploy(
            "emulated:worn",
            [[0.17, 0.0, 0.2]],
            run=run,
            settings=rejoint.Settings(controller="integrator", dwell=1.0),
            observer=Hears(progress=interrupt),
        )
    assert "cannot be written (No space left on device)" in caught.value.__notes__[-1]
    monkeypatch.undo()
    with locked(folder):
        ((_, path),) = folder.logs().items()
    assert RunLog.load(path).time[-1] > 0.4


def test_an_unsaved_result_comes_with_the_error(tmp_path):
    (tmp_path / "value.json").mkdir()
    with pytest.raises(UnsavedError, match=r"value\.json: cannot be written") as caught, saving([1, 2]):
        write_json(tmp_path / "value.json", [1, 2])
    assert caught.value.result == [1, 2]
    assert caught.value.exit_code == 2


def test_a_folder_that_cannot_be_written_is_named_before_anything_is_done(folder, cli, monkeypatch):
    opened = Path.open

    def read_only(self, mode="r", *arguments, **options):
        if mode != "r" and self.name == ".lock":
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(self))
        return opened(self, mode, *arguments, **options)

    monkeypatch.setattr(Path, "open", read_only)
    for words in (("report", folder.path), ("deploy", "emulated:worn", folder.path), ("train", folder.path)):
        err = cli(*words, code=2).error
        assert err.startswith(f"error: {folder.path}: nothing can be written there (Read-only file system)")
