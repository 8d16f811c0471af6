"""Run folders: what is written is read back; what is damaged is named."""

import errno
import os
import re
import subprocess
import sys
from datetime import datetime

import numpy as np
import pytest

import rejoint
from rejoint.arms import mycobot280
from rejoint.logs.journal import CUT_SHORT, Journal, recover
from rejoint.logs.runfolder import RunFolder, locked
from rejoint.runs import run as running
from rejoint.runs.run import Run
from rejoint.system.errors import FileError
from rejoint.system.files import read_json, set_aside, write_json, write_whole


def test_nobody_else_works_in_a_run_folder_meanwhile(tmp_path):
    code = "import sys\nfrom pathlib import Path\nfrom rejoint.logs.runfolder import RunFolder, locked\n"
    code += "with locked(RunFolder(Path(sys.argv[1]))): print('in', flush=True); sys.stdin.read()\n"
    words = [sys.executable, "-c", code, str(tmp_path)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "in\n"
        with pytest.raises(FileError, match=rf"another rejoint \(process {other.pid}\)"), locked(RunFolder(tmp_path)):
            pass
        other.kill()
    with locked(RunFolder(tmp_path)):  # a lock goes with its process
        pass


def test_what_cannot_be_written_is_a_file_error_and_leaves_what_was_there(tmp_path):
    path = tmp_path / "diagnosis.json"
    write_json(path, {"a": 1})
    full, read_only = (OSError(number, os.strerror(number)) for number in (errno.ENOSPC, errno.EROFS))
    for error, told in ((full, FileError), (read_only, FileError), (RuntimeError("interrupted"), RuntimeError)):

        def fail(temporary, error=error):
            temporary.write_text("half")
            raise error

        with pytest.raises(told, match=re.escape(error.args[-1])):
            write_whole(path, fail)
    assert read_json(path, dict[str, int]) == {"a": 1}
    assert list(tmp_path.iterdir()) == [path]
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(FileError, match="nothing can be written there"), locked(RunFolder(file)):
        pass


def test_what_another_result_replaces_is_kept_by_its_time(tmp_path):
    path = tmp_path / "comparison.json"
    set_aside(path)  # nothing there yet
    for day in (1, 2):
        write_json(path, day)
        os.utime(path, (0, datetime(2026, 1, day, 12, 0, 5).timestamp()))
        set_aside(path)
    write_json(path, 3)
    os.utime(path, (0, datetime(2026, 1, 1, 12, 0, 5).timestamp()))  # the clock was set back
    set_aside(path)
    kept = {file.name: read_json(file, int) for file in tmp_path.iterdir()}
    assert kept == {
        "comparison-20260101-120005.json": 1,
        "comparison-20260102-120005.json": 2,
        "comparison-20260101-120005-2.json": 3,
    }


def test_under_a_clock_that_stands_still_no_log_takes_the_place_of_another(tmp_path, monkeypatch):
    class Stopped(datetime):
        @classmethod
        def now(cls, tz=None):
            return cls(2026, 1, 1, 12, 0, 5, tzinfo=tz)

    monkeypatch.setattr(running, "datetime", Stopped)
    run = Run.create(tmp_path, "emulated:worn", mycobot280())
    for _ in range(2):
        rejoint.deploy(
            "emulated:worn",
            [[0.17, 0.0, 0.2]],
            run=run.path,
            settings=rejoint.Settings(controller="integrator", dwell=0.5),
        )
    assert set(run.folder.logs()) == {"deploy-20260101-120005", "deploy-20260101-120005-2"}
    whole = Journal(run.folder.log("deploy-20260101-120005-3"), mycobot280(), "emulated:worn", "deploy/killed")
    whole.append(0.0, *np.zeros((2, 6)), *np.zeros((2, 3)))
    whole.close()  # as `kill -9` leaves it
    (found,) = recover(run.path / "logs")
    assert found.stem == f"deploy-20260101-120005-3-{CUT_SHORT}"
