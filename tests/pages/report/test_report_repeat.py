"""What the page says of few trials and of failures, and the lines with which everything is done again."""

import dataclasses
import shlex
from itertools import pairwise

import pytest
from report_samples import make_comparison

from readpage import Page
from rejoint.cli.options import controller_names, period_seconds
from rejoint.logs.runfolder import RunFolder, RunInfo
from rejoint.pages.report.contents import commands, read_contents
from rejoint.pages.report.page import write_report
from rejoint.system.files import write_json


def options(line):
    words = shlex.split(line)
    return words[:2], dict(pairwise(words))


def made(folder, comparison, *, robot="emulated:worn", seed=7):
    write_json(folder.info, RunInfo(robot=robot, arm=comparison.arm, seed=seed, version="0", created="now"))
    write_json(folder.comparison, comparison)
    return commands(read_contents(folder.path))


def test_the_line_says_all_that_the_comparison_was_asked_for(tmp_path, arm):
    comparison = dataclasses.replace(
        make_comparison(arm, ("policy", "default")),
        robot="tcp://10.0.0.2:9000",
        seed=3,
        targets_file="my points.csv",
        period=(0.03, 0.0425),
    )
    line = made(RunFolder(tmp_path / "my run"), comparison)["compare"]
    words, given = options(line)
    assert words == ["rejoint", "compare"]
    assert shlex.split(line)[2:4] == ["tcp://10.0.0.2:9000", str(tmp_path / "my run")]
    assert (given["--targets"], given["--repetitions"], given["--seed"]) == ("my points.csv", "3", "3")
    assert "--sets" not in given
    assert controller_names(given["--controllers"]) == comparison.controllers
    assert period_seconds(given["--period"]) == comparison.period


def test_what_needs_no_option_gets_none(tmp_path, arm):
    lines = made(RunFolder(tmp_path), make_comparison(arm, ("default",)), seed=0)
    assert lines["compare"] == (
        f"rejoint compare emulated:worn {tmp_path} --sets 2 --repetitions 3 --controllers default"
    )
    assert lines["repair"] == "rejoint repair emulated:worn --seed 0"


@pytest.mark.parametrize("robot", ["emulated:worn", "tcp://10.0.0.2:9000"])
def test_a_comparison_that_is_to_be_made_needs_no_options(tmp_path, diagnosis, robot):
    folder = RunFolder(tmp_path)
    write_json(folder.info, RunInfo(robot=robot, arm="mycobot280", seed=0, version="0", created="now"))
    write_json(folder.diagnosis, diagnosis)
    line = commands(read_contents(tmp_path))["compare"]
    assert line == f"rejoint compare {robot} {tmp_path}"
    assert f"To do it: {line}" in Page(write_report(tmp_path)).words
