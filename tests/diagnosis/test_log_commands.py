"""The commands that need logs alone: what they write, what they print, and that nonsense leaves nothing behind."""

import dataclasses
import html

import pytest
from plant_logs import ARM, HEALTHY, record_motions, with_joint

import rejoint
from madetwin import made_twin
from rejoint.arms import load_arm, write_arm_toml
from rejoint.arms.inertia import loaded
from rejoint.diagnosis.diagnosis import Diagnosis
from rejoint.logs.runfolder import LOGS, RunFolder, RunInfo
from rejoint.runs.run import Run
from rejoint.session.inputs import arm_of_twin, keep, run_of_logs
from rejoint.system.errors import InputError
from rejoint.system.files import read_json
from rejoint.twin.identify import REFITTED
from rejoint.twin.twin import NO_TWIN, Judgement

PUBLISHED = "stiffness = 998.22\ndamping = 3.331\ncoulomb = 0.052\narmature = 0.028\n"


@pytest.fixture(scope="module")
def motions():
    soft = with_joint(2, position_gain=0.12 * HEALTHY.position_gain[2])
    return record_motions([soft], 5, 15.0)[0]


@pytest.fixture(scope="module")
def logs(motions, tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    for log in motions:
        dataclasses.replace(log, gain=0.0 * log.position + 32.0).save(folder / f"{log.label}.parquet")
    return folder


def test_logs_alone_become_diagnosis_twin_report_and_replay(cli, logs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = cli("diagnose", "--logs", logs, "--arm", "SO101", "--run", "one", "--json")
    assert "elbow_flex is soft" in done.out
    folder = RunFolder(tmp_path / "one")
    diagnosis = read_json(folder.diagnosis, Diagnosis)
    assert done.last["diagnosis"]["verdict"] == diagnosis.verdict
    assert diagnosis.robot == f"{LOGS}{logs}" == read_json(folder.info, RunInfo).robot

    (tmp_path / "maker.toml").write_text(PUBLISHED)
    words = ("identify", "--logs", logs, "--run", "one", "--published", "the maker=maker.toml")
    done = cli(*words, "--json")
    judgement = read_json(folder.judgement, Judgement)
    assert list(judgement.mean) == [NO_TWIN, "fitted twin", "healthy twin", "the maker"]
    assert judgement.mean["fitted twin"].free.tcp < 0.3 * judgement.mean["the maker"].free.tcp
    assert "Trust “fitted twin”" in done.out
    page = folder.report.read_text()
    assert "Trust “fitted twin”" in page
    notes = done.last["notes"]
    assert REFITTED in notes
    for note in notes:
        assert " ".join(note.split()) in " ".join(done.out.split())
        assert note[1:] in html.unescape(page)
    assert f"rejoint diagnose --logs {logs} --arm so101 --run" in page

    done = cli("replay", folder.twin, "--logs", logs, "--out", "again", "--json")  # of the arm of the twin
    again = read_json(tmp_path / "again" / "replay.json", Judgement)
    assert done.last["page"] == "again/replay.html"
    assert again.mean["twin"].all.tcp < again.mean["no twin"].all.tcp
    assert len(again.motions) == 5
    assert again.motions[0].motion in (tmp_path / "again" / "replay.html").read_text()


def test_logs_of_an_arm_of_ones_own_name_its_file_once(motions, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arm, name = tmp_path / "mine.toml", "mine"
    write_arm_toml(arm, dataclasses.replace(ARM, name=name))
    for log in motions[:2]:
        dataclasses.replace(log, arm=name).save(tmp_path / "recorded" / f"{log.label}.parquet")
    run = Run.create("one", f"{LOGS}recorded", load_arm(arm))
    arm.unlink()
    assert run_of_logs("one", "recorded", None)[1].name == name
    keep(run, rejoint.Settings(payload=0.1))
    for given in (None, run.arm, loaded(run.arm, 0.1)):
        carries = arm_of_twin("one/twin.toml", given)
        assert (carries.name, carries.mass.sum()) == (name, pytest.approx(ARM.mass.sum() + 0.1))
    with pytest.raises(InputError, match="the logs are of an arm 'mine', which is described elsewhere; give its file"):
        rejoint.diagnose("recorded")
    with pytest.raises(InputError, match="the twin is of an arm 'mine', which is described elsewhere; give its file"):
        arm_of_twin(made_twin(dataclasses.replace(ARM, name=name), None))
