"""What the page says of few trials and of failures, and the lines with which everything is done again."""

import dataclasses
import json
import shlex
from itertools import pairwise

import numpy as np
import pytest
import report_samples
from report_samples import make_calibration, make_comparison

from readpage import Page
from rejoint.cli.options import controller_names, period_seconds
from rejoint.control.comparison.recommend import NO_INTERVAL, recommend
from rejoint.control.comparison.result import Comparison, Ended
from rejoint.diagnosis.calibration.file import write_calibration
from rejoint.logs.runfolder.folder import RunFolder, RunInfo
from rejoint.pages.report.contents import read_contents
from rejoint.pages.report.numerals import interval
from rejoint.pages.report.page import write_report
from rejoint.pages.report.sections.details import commands
from rejoint.pages.report.tables import comparison_table, comparison_view
from rejoint.system.files import read_json, write_json
from rejoint.system.statistics import Estimate


def options(line):
    words = shlex.split(line)
    return words[:2], dict(pairwise(words))


def made(folder, comparison, *, robot="emulated:worn", seed=7):
    write_json(folder.info, RunInfo(robot=robot, arm=comparison.arm, seed=seed, version="0", created="now"))
    write_json(folder.comparison, comparison)
    return commands(read_contents(folder.path))


def test_the_line_says_all_that_the_comparison_was_asked_for(tmp_path, arm):
    comparison = dataclasses.replace(
        make_comparison(arm, ("policy", "default")), robot="tcp://10.0.0.2:9000", seed=3, targets_file="my points.csv",
        period=(0.03, 0.0425),
    )  # fmt: skip
    line = made(RunFolder(tmp_path / "my run"), comparison)["compare"].line
    words, given = options(line)
    assert words == ["rejoint", "compare"]
    assert shlex.split(line)[2:4] == ["tcp://10.0.0.2:9000", str(tmp_path / "my run")]
    assert (given["--targets"], given["--repetitions"], given["--seed"]) == ("my points.csv", "3", "3")
    assert "--sets" not in given
    assert controller_names(given["--controllers"]) == comparison.controllers
    assert period_seconds(given["--period"]) == comparison.period


def test_what_needs_no_option_gets_none(tmp_path, arm):
    lines = made(RunFolder(tmp_path), make_comparison(arm, ("default",)), seed=0)
    assert lines["compare"].line == (
        f"rejoint compare emulated:worn {tmp_path} --sets 2 --repetitions 3 --controllers default"
    )
    # an emulated arm would be calibrated otherwise, and this one was not
    assert lines["repair"].line == (
        "rejoint repair emulated:worn --sets 2 --repetitions 3 --controllers default --calibrate none --seed 0"
    )


@pytest.mark.parametrize("robot", ["emulated:worn", "tcp://10.0.0.2:9000"])
def test_a_comparison_that_is_to_be_made_needs_no_options(tmp_path, diagnosis, robot):
    folder = RunFolder(tmp_path)
    write_json(folder.info, RunInfo(robot=robot, arm="mycobot280", seed=0, version="0", created="now"))
    write_json(folder.diagnosis, diagnosis)
    line = commands(read_contents(tmp_path))["compare"].line
    assert line == f"rejoint compare {robot} {tmp_path}"
    assert f"To do it: {line}" in Page(write_report(tmp_path)).words


def test_a_file_of_an_earlier_version_is_read(tmp_path, arm):
    """Without what was asked for and why runs ended, and with an interval of one trial that has no width."""
    comparison = make_comparison(arm, ("default", "pid-literal"))
    write_json(tmp_path / "new.json", comparison)
    data = json.loads((tmp_path / "new.json").read_text())
    del data["targets_file"], data["period"]
    for row in data["rows"]:
        del row["ended"], row["out"]
        mean = row["hold"]["settled"]["mean"]
        mean["low"] = mean["high"] = mean["value"]
    (tmp_path / "comparison.json").write_text(json.dumps(data))
    old = read_json(tmp_path / "comparison.json", Comparison)
    assert (old.targets_file, old.period, old.rows[0].ended, old.rows[0].out) == ("", None, (), "")
    cells = comparison_view(old, "default").rows[0].cells
    assert cells[4].text == f"{1e3 * old.rows[0].hold.settled.mean.value:.1f}"
    assert cells[4].note == ""
    assert NO_INTERVAL in recommend(old).why[0]
    page = Page(write_report(tmp_path))
    assert "pid-literal: 1 of 12 runs ended early, because the guard stopped them." in page.words
    assert "--sets 2 --repetitions 3 --controllers default,pid-literal" in page.words


def test_one_trial_has_no_interval(tmp_path, arm, monkeypatch):
    monkeypatch.setattr(report_samples, "SETS", 1)
    monkeypatch.setattr(report_samples, "REPETITIONS", 1)
    comparison = dataclasses.replace(make_comparison(arm, ("default", "policy")), repetitions=1)
    row = comparison.row("policy")
    assert (row.crossing.cycle_time.mean.low, row.crossing.cycle_time.mean.high) == (None, None)
    assert row.crossing.cycle_time.std is None
    assert row.hold.settled.mean.low < row.hold.settled.mean.high, "ten targets do have one"
    table = comparison_view(comparison, "policy")
    assert [line for line in table.rows[1].cells[3].note.splitlines() if "paper" not in line] == []
    assert "none for the time of 10 targets: 1 trial of it says too little about another one" in table.notes[0]
    write_json(tmp_path / "comparison.json", comparison)
    words = Page(write_report(tmp_path)).words
    assert f"sent on at the first crossing ({NO_INTERVAL})." in words


def test_one_target_tells_nothing_that_an_owner_would_not_see(arm, monkeypatch):
    for name in ("SETS", "REPETITIONS", "TARGETS"):
        monkeypatch.setattr(report_samples, name, 1)
    found = dataclasses.replace(make_comparison(arm, ("integrator", "feedforward", "policy")), repetitions=1)
    settled = {row.controller: row.hold.settled for row in found.rows}
    assert all(one.mean.low is None and one.std is None for one in settled.values())
    assert settled["integrator"].mean.value - settled["policy"].mean.value < 2e-3
    advice = recommend(found)
    assert advice.controller == "integrator", "less than 2 mm apart: the simplest"
    assert NO_INTERVAL in advice.why[0]
    assert advice.why[1].startswith("A tie of integrator, ")
    assert "too few trials to tell them apart" in advice.why[1]
    far = dataclasses.replace(make_comparison(arm, ("default", "policy")), repetitions=1)
    assert recommend(far).controller == "policy"
    headers, rows = comparison_table(far)
    assert "±" not in rows[0][headers.index("error at the crossing [mm]")]
    assert (
        comparison_view(far, "policy")
        .notes[0]
        .endswith("none where they would be: 1 trial of it says too little about another one.")
    )


def test_an_interval_without_width_is_none():
    assert interval(1.0, 1.0) == interval(None, 2.0) == interval(np.nan, 2.0) == ""
    assert interval(0.0012, 0.0034, 2, "mm", factor=1e3) == "1.2 to 3.4\N{NO-BREAK SPACE}mm"


def test_failures_are_told_in_one_sentence_each(tmp_path, arm, diagnosis):
    comparison = make_comparison(arm, ("default", "integrator", "policy"))
    default, integrator, policy = comparison.rows
    nothing = dataclasses.replace(default.hold, settled=None, settled_true=None, stays=(), oscillation=None)
    default = dataclasses.replace(default, out="missed 3 targets in a row (set 1, repetition 1, up to target 3)",
                                  hold=nothing)  # fmt: skip
    ended = tuple(Ended(protocol="hold", target_set=0, repetition=r, target=2, why="not finite") for r in range(3))
    policy = dataclasses.replace(policy, failures=3, ended=ended,
                                 crossing=dataclasses.replace(policy.crossing, success=Estimate(value=0.1, low=0.0,
                                                                                                high=0.3)))  # fmt: skip
    crossed = tuple(0.0 for _ in policy.outcomes.crossed)
    policy = dataclasses.replace(policy, outcomes=dataclasses.replace(policy.outcomes, crossed=crossed))
    write_json(tmp_path / "diagnosis.json", diagnosis)
    write_json(tmp_path / "comparison.json", dataclasses.replace(comparison, rows=(default, integrator, policy)))
    page = Page(write_report(tmp_path))
    assert "What failed, and why" in page.words
    assert (
        "default missed 3 targets in a row (set 1, repetition 1, up to target 3): what was left of its trials was not "
        "driven, and counts neither for nor against it."
    ) in page.words
    reason = "3 of 12 runs ended early, because a command or a measured position was not a number."
    assert f"policy: {reason}" in page.words
    assert f"The learned policy was tried and failed. Policy: {reason}" in page.words
    assert "its own controller left" in page.words, "what it was before is known from the diagnosis"
    assert "“default” was stopped on the way." in page.words
    cells = next(row for row in page.rows if row and row[0].startswith("default"))
    assert cells[-1].startswith("stopped: missed 3 targets in a row")
    assert "None" not in page.words


@pytest.mark.parametrize(
    ("robot", "source", "option"),
    [
        ("emulated:worn", "touch", ""), ("emulated:worn?seed=3", "touch", ""),
        ("tcp://10.0.0.1:9000", "touch", " --calibrate touch"),
        ("tcp://10.0.0.1:9000", "tracker", " --calibrate tracker=FILE"),
    ],
)  # fmt: skip
def test_what_measured_the_tool_is_named_where_the_robot_does_not_tell(tmp_path, arm, robot, source, option):
    folder = RunFolder(tmp_path)
    own = dataclasses.replace(make_calibration(arm)[0], source=source)
    write_calibration(folder.calibration, own)
    comparison = dataclasses.replace(make_comparison(arm, ("default",)), robot=robot, calibration=own.date)
    lines = made(folder, comparison, seed=0, robot=robot)
    assert lines["repair"].line.endswith(f"--controllers default{option} --seed 0")
    assert (
        lines["calibrate"].line
        == f"rejoint calibrate {shlex.quote(robot)} {tmp_path}{'' if option == '' else ' --touch'}"
    )
    assert "--calibration" not in lines["compare"].line
    plain = made(folder, dataclasses.replace(comparison, calibration=""), seed=0, robot=robot)
    assert " --calibration none" in plain["compare"].line
