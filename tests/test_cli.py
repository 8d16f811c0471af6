"""The command line: exit codes, one clear line per error, JSON on the last line, and a chain that resumes."""

import json
import os
import pty
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rejoint
from commandline import python
from rejoint.arms import mycobot280
from rejoint.logs.runfolder import RunInfo
from rejoint.logs.runlog import RunLog
from rejoint.runs.run import Run, newest_or_new
from rejoint.system.errors import FileError
from rejoint.system.files import write_json
from rejoint.training.train import TrainingOptions, train
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run with everything up to a policy that has hardly been trained."""
    path = tmp_path_factory.mktemp("runs") / "one"
    run = Run.create(path, "emulated:worn", mycobot280())
    rejoint.diagnose("emulated:worn", run=run)
    twin = rejoint.identify(run=run)
    train(run.arm, twin, out=path, options=TrainingOptions(iterations=2, agents=16))
    return run.folder


def test_repair_goes_on_where_it_stopped(finished, cli):
    before = {path: path.stat().st_mtime_ns for path in (finished.diagnosis, finished.twin, finished.policy)}
    options = ("--run", str(finished.path), "--sets", "1", "--repetitions", "1", "--controllers", "default,integrator")
    done = cli("repair", *options, "--json")
    assert before == {path: path.stat().st_mtime_ns for path in before}
    assert done.err.count("already done") == 3
    last = done.last
    assert last["recommended"]["controller"] == "integrator"
    page = Path(last["report"]).read_text()
    assert page.startswith("<!DOCTYPE html>")
    assert done.out.splitlines()[-2] == last["report"]
    before = rejoint.Run.open(finished.path).diagnosis.open_loop.error_mm.value
    assert last["errors"]["before"]["encoders"] == pytest.approx(1e-3 * before)
    assert "rejoint goto" not in done.out.rpartition("\n{")[0], "what comes next is no result"
    assert all(line in page for line in last["next"].values())
    words = next(line for line in done.err.splitlines() if "rejoint goto" in line).partition("#")[0].split()[1:]
    assert cli(*words, "--dry-run", "--json").last["reached"]


def test_a_twin_finds_the_weak_motor_and_predicts_motion_that_it_has_not_seen(finished):
    found, wear = Run.open(finished.path).twin, load_wear("worn", mycobot280())
    assert found.held_out.twin.tcp < 0.25 * found.held_out.no_twin.tcp
    most = found.parameters.torque_limit / found.parameters.stiffness
    assert most[3] == pytest.approx(wear.torque_limit[3] / wear.position_gain[3], rel=0.5)


def test_a_twin_is_replayed_on_the_logs_it_came_from(finished, tmp_path, cli):
    words = ("replay", str(finished.twin), "--logs", str(finished.path / "logs"), "--out", str(tmp_path), "--json")
    mean = cli(*words).last["mean"]
    assert mean["twin"]["all"]["tcp"] < mean["no twin"]["all"]["tcp"]
    assert (tmp_path / "replay.html").read_text().startswith("<!DOCTYPE html>")


def test_deploy_logs_what_it_did(finished, tmp_path, cli):
    points = tmp_path / "points.csv"
    points.write_text("x,y,z\n170,0,200\n180,30,210\n")
    words = ("deploy", "emulated:worn", str(finished.path), "--controller", "integrator", "--targets", str(points))
    errors = cli(*words, "--dwell", "6", "--json").last["error_mm"]
    assert len(errors) == 2
    assert max(errors) < 5.0
    log = RunLog.load(next(path for name, path in finished.logs().items() if name.startswith("deploy")))
    assert log.time[-1] - log.time[0] == pytest.approx(13.2, abs=1.2)


def test_follow_goes_along_a_path_and_logs_each_time(finished, tmp_path, cli):
    points = tmp_path / "line.csv"
    points.write_text("time,x,y,z\n0,170,0,200\n1,180,15,205\n2,180,30,210\n")
    words = ("follow", "emulated:worn", str(finished.path), str(points), "--repeat", "2", "--json")
    assert [one["encoder"]["rms"] < 5e-3 for one in cli(*words).last["passes"]] == [True, True]
    logs = {name: path for name, path in finished.logs().items() if name.startswith("follow-0")}
    assert len(logs) == 2
    log = RunLog.load(next(iter(logs.values())))
    assert np.allclose(log.target[0], [0.17, 0.0, 0.2])
    assert np.allclose(log.target[-1], [0.18, 0.03, 0.21], atol=2e-3)
    words = ("follow", "emulated:worn", str(finished.path), str(points), "--controller", "default")
    assert "Not followed" in cli(*words, code=5).out


def test_what_a_stopped_deployment_recorded_is_kept(finished, cli, monkeypatch):
    step, steps = EmulatedRobot.step, []

    def hot(self, *arguments):
        steps.append(arguments)
        state = step(self, *arguments)
        return replace(state, temperature=np.full((1, 6), 90.0)) if len(steps) == 20 else state

    monkeypatch.setattr(EmulatedRobot, "step", hot)
    words = ("deploy", "emulated:worn", str(finished.path), "--controller", "integrator")
    path = Path(re.search(r"What was recorded until then: (.+)", cli(*words, code=3).err)[1])
    log = RunLog.load(path)
    path.unlink()
    assert log.label == "deploy/begin/stopped"
    assert 15 < len(log.time) <= 21


def test_a_bug_is_one_line_and_a_file(tmp_path, cli, monkeypatch):
    def fail(*_, **__):
        raise ZeroDivisionError("made for this test")

    monkeypatch.setattr("rejoint.deploy", fail)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    words = ("deploy", "emulated:worn", str(tmp_path), "--json")
    _, out, line = cli(*words, code=1)
    assert (json.loads(out)["exit_code"], json.loads(out)["error"]) == (1, "InternalError")
    found = re.fullmatch(
        r"error: a bug in rejoint itself: ZeroDivisionError: made for this test; where it is: (.+)\n", line
    )
    assert "raise ZeroDivisionError" in Path(found[1]).read_text()


def test_a_start_that_fails_leaves_nothing_and_takes_nothing(tmp_path, cli):
    words = ("diagnose", "tcp://127.0.0.1:1", "--run", str(tmp_path / "runs" / "one"))
    cli(*words, code=2)
    far = tmp_path / "far.csv"
    far.write_text("x,y,z\n900,0,200\n")
    repair = ("repair", "emulated:worn", "--run", words[-1], "--targets", str(far))
    cli(*repair, code=2)
    assert not (tmp_path / "runs" / "one").exists()
    folder = Run.create(tmp_path / "runs" / "one", "tcp://127.0.0.1:1", mycobot280()).folder
    write_json(folder.diagnosis, {"kept": True})
    cli(*words, code=2)
    assert {path.name for path in folder.path.iterdir()} >= {"run.json", "diagnosis.json"}


def test_what_is_to_be_ignored_stays_ignored(tmp_path):
    words = [sys.executable, "-m", "rejoint", "repair", "--run", str(tmp_path / "run")]
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
    first = Run.plan(None, robot, arm).path
    assert first == Path("runs/mycobot280-emulated-worn-seed-3-seed0/001")
    info = RunInfo(robot="emulated:worn?seed=3", arm="mycobot280", seed=0, version="1", created="now")
    write_json(first / "run.json", info)
    assert newest_or_new(robot, arm, first.parent) == first
    (first / "report.html").write_text("of what there is")
    assert newest_or_new(robot, arm, first.parent) == first
    (first / "finished.json").write_text("{}")
    assert newest_or_new(robot, arm, first.parent) == first.with_name("002")
    with pytest.raises(FileError, match="it holds runs, name one of: 001"):
        Run.open(first.parent)
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
