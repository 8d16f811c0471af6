"""The commands that need logs alone: what they write, what they print, and that nonsense leaves nothing behind."""

import dataclasses
import html
import json
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from plant_logs import ARM, HEALTHY, record_motions, with_joint

import rejoint
from commandline import run_cli
from rejoint.arms import load_arm, write_arm_toml
from rejoint.diagnosis.diagnosis import Diagnosis
from rejoint.logs.runfolder.folder import LOGS, RunFolder, RunInfo
from rejoint.logs.runlog import write_log
from rejoint.runs.given import arm_of_twin, run_of_logs
from rejoint.runs.run import Run
from rejoint.system.errors import InputError
from rejoint.system.files import read_json
from rejoint.twin.fromlogs import REFITTED
from rejoint.twin.judgement import NO_TWIN, Judgement

PUBLISHED = "stiffness = 998.22\ndamping = 3.331\ncoulomb = 0.052\narmature = 0.028\n"


@pytest.fixture(scope="module")
def motions():
    soft = with_joint(2, position_gain=0.12 * HEALTHY.position_gain[2])
    return record_motions([soft], 5, 15.0)[0]


@pytest.fixture(scope="module")
def logs(motions, tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    for log in motions:
        write_log(folder / f"{log.label}.parquet", log)
    return folder


@pytest.fixture
def run(capsys, monkeypatch, tmp_path):
    """Run the command line in an empty folder: exit code, standard output, standard error."""
    monkeypatch.chdir(tmp_path)

    return partial(run_cli, capsys=capsys, monkeypatch=monkeypatch)


def test_logs_alone_become_diagnosis_twin_report_and_replay(run, logs, tmp_path):
    code, out, err = run("diagnose", "--logs", logs, "--arm", "SO101", "--run", "one", "--json")
    assert code == 0, err
    assert "elbow_flex is soft" in err
    told = json.loads(out.splitlines()[-1])
    folder = RunFolder(tmp_path / "one")
    diagnosis = read_json(folder.diagnosis, Diagnosis)
    assert told["diagnosis"]["verdict"] == diagnosis.verdict
    assert diagnosis.robot == f"{LOGS}{logs}" == read_json(folder.info, RunInfo).robot

    (tmp_path / "maker.toml").write_text(PUBLISHED)
    words = ("identify", "--logs", logs, "--run", "one", "--published", "the maker=maker.toml")
    code, out, err = run(*words, "--json")
    assert code == 0, err
    judgement = read_json(folder.judgement, Judgement)
    assert list(judgement.mean) == [NO_TWIN, "fitted twin", "healthy twin", "the maker"]
    assert judgement.mean["fitted twin"].free.tcp < 0.3 * judgement.mean["the maker"].free.tcp
    assert "Trust “fitted twin”" in out
    page = folder.report.read_text(encoding="utf-8")
    assert "Trust “fitted twin”" in page
    notes = json.loads(out.splitlines()[-1])["notes"]
    assert REFITTED in notes
    for note in notes:
        assert " ".join(note.split()) in " ".join(err.split())
        assert note[1:] in html.unescape(page)
    assert f"rejoint diagnose --logs {logs} --arm so101 --run" in page
    figures = {path.name for path in folder.figures.iterdir()}
    assert {"motions-free.png", "prediction-free.png", "worst-tool.png", "worst-joints.png"} <= figures
    assert "twin-correlations.png" in figures

    code, out, err = run("replay", folder.twin, "--logs", logs, "--out", "again", "--json")  # of the arm of the twin
    assert code == 0, err
    again = read_json(tmp_path / "again" / "replay.json", Judgement)
    assert json.loads(out.splitlines()[-1])["page"] == "again/replay.html"
    assert len(again.motions) == 5
    assert (tmp_path / "again" / "replay.html").read_text(encoding="utf-8").count("<svg") == 4


@pytest.fixture(scope="module")
def nonsense(motions, tmp_path_factory):
    """Folders of logs that cannot be used."""
    log, places = motions[0], {}
    for name in ("empty", "truncated", "short", "names", "order", "twice", "table", "dead"):
        places[name] = tmp_path_factory.mktemp(name)
    write_log(places["truncated"] / "a.parquet", log)
    whole = (places["truncated"] / "a.parquet").read_bytes()
    (places["truncated"] / "a.parquet").write_bytes(whole[: len(whole) // 2])
    write_log(places["short"] / "a.parquet", log.rows(slice(80)))
    write_log(places["names"] / "a.parquet", dataclasses.replace(log, joint_names=tuple("abcde")))
    write_log(places["order"] / "a.parquet", dataclasses.replace(log, joint_names=log.joint_names[::-1]))
    for file in ("a", "b"):
        write_log(places["twice"] / f"{file}.parquet", log)
    still = dataclasses.replace(log, position=np.repeat(log.position[:1], len(log), axis=0))
    write_log(places["dead"] / "a.parquet", still)
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table({"time": [0.0, 1.0]}), places["table"] / "a.parquet")
    return places


@pytest.mark.parametrize(
    ("command", "place", "says"),
    [
        ("diagnose", "empty", "no folder with run logs"),
        ("diagnose", "truncated", "a.parquet: not a readable run log"),
        ("diagnose", "short", "s of free motion, expected at least 10 s"),
        ("diagnose", "names", "has joints a, b, c, d, e, expected shoulder_pan"),
        ("diagnose", "order", "has joints wrist_roll"),
        ("diagnose", "dead", "of dead readings"),
        ("diagnose", "table", "a Parquet table with the columns time; turn it into one with `rejoint import`"),
        ("identify", "empty", "no folder with run logs"),
        ("identify", "truncated", "a.parquet: not a readable run log"),
        ("identify", "short", "s of free motion in stretches of 2 s"),
        ("identify", "order", "has joints wrist_roll"),
        ("identify", "twice", "the same label"),
    ],
)
def test_nonsense_is_one_line_and_leaves_nothing_behind(run, nonsense, tmp_path, command, place, says):
    code, out, err = run(command, "--logs", nonsense[place], "--arm", "so101")
    assert (code, out) == (2, "")
    assert says in err
    assert [line for line in err.splitlines() if line.startswith("error: ")] == [err.splitlines()[-1]]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("diagnose", "--logs", "{logs}"), "is of arm so101, expected mycobot280; name its arm with --arm"),
        (("identify", "--logs", "{logs}"), "is of arm so101, expected mycobot280"),
        (("diagnose", "emulated:worn", "--logs", "{logs}"), "either a robot or --logs"),
        (("diagnose", "--logs", "{logs}", "--period", "20"), "no --period"),
        (("identify", "one", "--published", "x.toml"), "go with --logs"),
        (("identify", "--logs", "{logs}", "--arm", "so101", "--published", "none.toml"), "none.toml: no such file"),
    ],
)
def test_what_does_not_go_together_is_said(run, logs, tmp_path, words, says):
    code, _, err = run(*(str(logs) if word == "{logs}" else word for word in words))
    assert code == 2
    assert says in err.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_a_run_of_other_logs_is_not_taken_over(run, logs, tmp_path):
    code, out, err = run("diagnose", "--logs", logs, "--arm", "so101", "--run", "one")
    assert code == 0, err
    assert f"Next: rejoint identify --logs {logs} --run one" in " ".join((out + err).split())
    code, _, err = run("diagnose", "--logs", tmp_path, "--arm", "so101", "--run", "one")
    assert code == 2
    assert "is a run of logs:" in err
    code, _, err = run("identify", "one")
    assert code == 2
    assert "rejoint identify --logs" in err


def test_logs_of_an_arm_of_ones_own_name_its_file_once(motions, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arm, name = tmp_path / "mine.toml", "mine"
    write_arm_toml(arm, dataclasses.replace(ARM, name=name))
    for log in motions[:2]:
        write_log(tmp_path / "recorded" / f"{log.label}.parquet", dataclasses.replace(log, arm=name))
    Run.create("one", f"{LOGS}recorded", load_arm(arm))
    arm.unlink()
    assert run_of_logs("one", "recorded", None)[1].name == name
    assert arm_of_twin("one/twin.toml").name == name
    with pytest.raises(InputError, match="the logs are of an arm 'mine', which is described elsewhere; give its file"):
        rejoint.diagnose("recorded")
    with pytest.raises(InputError, match="the twin is of an arm 'mine', which is described elsewhere; give its file"):
        arm_of_twin(SimpleNamespace(arm=name, parameters=None))
