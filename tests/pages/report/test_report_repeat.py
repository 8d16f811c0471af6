"""What the page says of few trials and of failures, and the lines with which everything is done again."""

import pytest

from readpage import Page
from rejoint.logs.runfolder import RunFolder, RunInfo
from rejoint.pages.report.page import read_contents, write_report
from rejoint.system.files import write_json


def made(folder, comparison, *, robot="emulated:worn", seed=7):
    write_json(folder.info, RunInfo(robot=robot, arm=comparison.arm, seed=seed, version="0", created="now"))
    write_json(folder.comparison, comparison)
    return read_contents(folder.path).commands()


@pytest.mark.parametrize("robot", ["emulated:worn", "tcp://10.0.0.2:9000"])
def test_a_comparison_that_is_to_be_made_needs_no_options(tmp_path, diagnosis, robot):
    folder = RunFolder(tmp_path)
    write_json(folder.info, RunInfo(robot=robot, arm="mycobot280", seed=0, version="0", created="now"))
    write_json(folder.diagnosis, diagnosis)
    line = read_contents(tmp_path).commands()["compare"]
    assert line == f"rejoint compare {robot} {tmp_path}"
    assert f"To do it: {line}" in Page(write_report(tmp_path)).words
