"""The command line: exit codes, one clear line per error, JSON on the last line, runs and signals."""

import json
import os
import pty
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from commandline import python
from rejoint.arms import mycobot280
from rejoint.runs.run import Run, newest_or_new
from rejoint.system.errors import FileError
from rejoint.system.files import write_json


def test_a_bug_is_one_line_and_a_file(tmp_path, cli, monkeypatch):
    def fail(*_, **__):
        raise ZeroDivisionError("made for this test")

    monkeypatch.setattr("rejoint.deploy", fail)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    words = ("deploy", "emulated:worn", tmp_path, "--json")
    _, out, line = cli(*words, code=1)
    assert (json.loads(out)["exit_code"], json.loads(out)["error"]) == (1, "InternalError")
    found = re.fullmatch(
        r"error: a bug in rejoint itself: ZeroDivisionError: made for this test; where it is: (.+)\n", line
    )
    assert "raise ZeroDivisionError" in Path(found[1]).read_text()


def test_a_start_that_fails_leaves_nothing_and_takes_nothing(tmp_path, cli):
    words = ("diagnose", "tcp://127.0.0.1:1", "--run", tmp_path / "runs" / "one")
    cli(*words, code=2)
    far = tmp_path / "far.csv"
    far.write_text("x,y,z\n900,0,200\n")
    repair = ("repair", "emulated:worn", "--run", words[-1], "--targets", far)
    cli(*repair, code=2)
    assert not (tmp_path / "runs" / "one").exists()
    folder = Run.create(tmp_path / "runs" / "one", "tcp://127.0.0.1:1", mycobot280()).folder
    write_json(folder.diagnosis, {"kept": True})
    cli(*words, code=2)
    assert {path.name for path in folder.path.iterdir()} >= {"run.json", "diagnosis.json"}


def test_what_is_to_be_ignored_stays_ignored(tmp_path):
    words = [sys.executable, "-m", "rejoint", "repair", "--run", tmp_path / "run"]
    code = "import os, signal, sys; signal.signal(signal.SIGHUP, signal.SIG_IGN); os.execv(sys.argv[1], sys.argv[1:])"
    with subprocess.Popen([sys.executable, "-c", code, *words], stderr=subprocess.PIPE, text=True) as process:
        while "Diagnosis" not in process.stderr.readline():
            assert process.poll() is None
        process.send_signal(signal.SIGHUP)
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.5)
        process.terminate()
        assert "interrupted" in process.stderr.read()


def test_the_newest_unfinished_run_is_resumed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    robot, arm = "emulated:worn?seed=3", mycobot280()
    first = Run.plan(None, robot, arm).begin().path
    assert first == Path("runs/mycobot280-emulated-worn-seed-3-seed0/001")
    assert newest_or_new(robot, arm, first.parent) == first
    (first / "report.html").write_text("of what there is")
    assert newest_or_new(robot, arm, first.parent) == first
    (first / "finished.json").write_text("{}")
    assert newest_or_new(robot, arm, first.parent) == first.with_name("002")
    with pytest.raises(FileError, match=f"it holds runs, name one of: {first.parent.name}/001"):
        Run.open(first.parent.parent)


DEPLOY = ("deploy", "emulated:worn", "--dwell", "0.1", "--within", "0.01", "--json")


@pytest.mark.parametrize("stream", ["stdout", "stderr", "both"])
def test_a_reader_who_leaves_decides_nothing(stream):
    reading, writing = os.pipe()
    os.close(reading)  # as `head` does when it has seen enough
    gone = {"stdout": {"stdout"}, "stderr": {"stderr"}, "both": {"stdout", "stderr"}}[stream]
    done = subprocess.run(
        [sys.executable, "-m", "rejoint", *DEPLOY],
        check=False,
        text=True,
        **{name: writing if name in gone else subprocess.PIPE for name in ("stdout", "stderr")},
    )
    os.close(writing)
    assert done.returncode == 5
    assert "error" not in (done.stderr or "")
    if stream == "stderr":
        assert json.loads(done.stdout.splitlines()[-1])["controller"] == "shelf"


def test_a_terminal_that_was_closed_decides_nothing():
    """A deployment, or a repair, ended at its first result with an input/output error, and exit code 2."""
    mine, its = pty.openpty()
    process = subprocess.Popen([sys.executable, "-m", "rejoint", *DEPLOY], stdout=its, stderr=its)
    os.close(its)
    os.close(mine)
    assert process.wait(timeout=120) == 5


def test_a_signal_at_the_very_end_is_not_the_exit_code(tmp_path):
    code = (
        "import atexit, os, subprocess, sys\n"
        "flood = f'for _ in $(seq 200); do kill -TERM {os.getpid()} || break; sleep 0.005; done'\n"
        "nothing = {'stdin': -3, 'stdout': -3, 'stderr': -3}\n"
        "atexit.register(lambda: subprocess.Popen(['sh', '-c', flood], **nothing))\n"
        "sys.argv = ['rejoint', 'report', sys.argv[1]]\n"
        "from rejoint.__main__ import main\n"
        "main()\n"
    )
    assert python("-c", code, tmp_path, code=2).err.count("\n") == 1
