"""What the page says of few trials and of failures, and the lines with which everything is done again."""

import numpy as np
import pytest

import rejoint
from readpage import Page
from rejoint.arms import Box, mycobot280
from rejoint.arms.inertia import Payload
from rejoint.logs.history import SUMMARY
from rejoint.logs.runfolder import KeptSettings
from rejoint.pages.report.page import read_contents, write_report
from rejoint.runs.history import summary_of, what_to_do
from rejoint.runs.run import Run
from rejoint.system.files import write_json


def test_the_lines_say_what_the_run_keeps_as_it_is_typed(tmp_path):
    folder, box = (
        Run.create(tmp_path, "emulated:worn", mycobot280(), 7).folder,
        Box(lower=np.array([-0.1, 0.15, 0.0]), upper=np.array([0.3, 0.2, 0.1])),
    )
    load = Payload(mass=0.05, com=(0.0, 0.0, 0.03))
    write_json(folder.settings, KeptSettings(payload=load, keep_out=(box,), period=(0.02, 0.03)))
    write_json(folder.quick, {})
    said = "--payload 0.05@0,0,30 --keep-out -100,150,0,300,200,100 --period 20-30"
    assert read_contents(tmp_path).commands()["repair"] == f"rejoint repair emulated:worn {said} --seed 7 --quick"


@pytest.mark.parametrize("robot", ["emulated:worn", "tcp://10.0.0.2:9000"])
def test_a_comparison_that_is_to_be_made_needs_no_options(tmp_path, diagnosis, robot):
    folder = Run.create(tmp_path, robot, mycobot280()).folder
    write_json(folder.diagnosis, diagnosis)
    line = read_contents(tmp_path).commands()["compare"]
    assert line == f"rejoint compare {robot} {tmp_path}"
    assert f"To do it: {line}" in Page(write_report(tmp_path)).words


@pytest.mark.parametrize(
    ("named", "line"),
    [
        ({}, "rejoint check emulated:worn --history {} --repeat 5"),
        ({"name": "a1", "fleet": "F.toml"}, "rejoint fleet check F.toml --only a1"),
        ({"robot": "logs:x", "name": "a1"}, ""),
    ],
)
def test_the_check_after_a_repair_is_of_the_same_arm(tmp_path, diagnosis, named, line):
    (tmp_path / "checks").mkdir()
    folder = Run.plan(tmp_path / "run", arm=mycobot280(), **{"robot": "emulated:worn"} | named).begin().folder
    write_json(folder.diagnosis, diagnosis)
    write_json(folder.finished, {})
    rejoint.report(folder.path)
    row = summary_of(folder.path / SUMMARY)
    assert row.arm == named.get("name", "mycobot280-emulated-worn")
    assert what_to_do(row).endswith(line.format(tmp_path))
