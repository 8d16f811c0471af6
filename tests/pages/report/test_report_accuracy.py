"""Where the tool is: the section of the report, and what else leaves the run."""

import dataclasses
import re

import numpy as np
import pytest
from report_samples import begin, keep_calibration, shown

from readpage import Page
from rejoint.arms import load_arm, tcp_position
from rejoint.arms.workspace import posture_grid
from rejoint.diagnosis.calibration.calibration import read_calibration, write_calibration
from rejoint.logs.runfolder import RunFolder
from rejoint.runs.exports import export_run
from rejoint.system.errors import FileError, InputError

POINTS = "tool / Measured points in the base frame, each left out"


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A folder with a calibration alone, and the page that it makes."""
    arm, folder = load_arm("mycobot280"), RunFolder(tmp_path_factory.mktemp("calibrated"))
    begin(folder.path, arm)
    return folder, *keep_calibration(folder, arm), shown(folder.path)[0]


def test_every_point_stands_with_both_of_its_errors(calibrated):
    _, calibration, measured, page = calibrated
    for i, (before, after) in enumerate(calibration.left_out):
        row = f"{POINTS} / {i + 1}"
        assert float(page.places[f"{row} / off the encoders [mm]"]) == pytest.approx(1e3 * before, rel=0.06)
        assert float(page.places[f"{row} / off the calibration [mm]"]) == pytest.approx(1e3 * after, rel=0.06)
        assert float(page.places[f"{row} / z [mm]"]) == pytest.approx(1e3 * measured.point[i, 2], abs=0.051)
        assert " to " in page.places[f"{row} / off the calibration [mm] / small"]


def test_measurements_of_another_calibration_are_not_set_beside_it(tmp_path):
    arm, folder = load_arm("mycobot280"), RunFolder(tmp_path)
    begin(folder.path, arm)
    keep_calibration(folder, arm, points=6)
    assert not any(place.startswith(POINTS) for place in shown(tmp_path)[0].places)


def test_the_data_sheet_holds_each_number_with_its_count_or_says_not_known(run_folder, comparison):
    path, _ = export_run(run_folder.path, "datasheet")
    page = Page(path)
    found = {row[0]: row[1:] for row in page.rows}
    settled = comparison.row("policy").settled
    assert float(found["Encoder error, repaired"][0]) == pytest.approx(1e3 * settled.mean.value, rel=6e-3)
    assert found["Encoder error, repaired"][2] == str(settled.count)
    assert found["True error, repaired"][3] == "known"
    assert found["Tool from where the encoders see it"][2:] == ["8", "measured"]
    assert found["Reversal value at the tool, ISO 230-2"][2] == "4"
    words = " ".join(page.text)
    assert re.search(r"Payload\s+not known", words)
    assert re.search(r"Controller recommended\s+policy", words)
    assert "nan" not in words.lower()


def test_a_unit_s_urdf_is_what_its_calibration_says(run_folder, arm):
    path, _ = export_run(run_folder.path, "urdf")
    unit, found = load_arm(path), read_calibration(run_folder.calibration, arm)
    postures = posture_grid(arm, 3).q
    rigid = found.displacement.rigid(arm, postures)
    np.testing.assert_allclose(tcp_position(unit, postures), rigid.tool(arm, postures), atol=1e-9)


def test_what_cannot_be_exported_is_refused(run_folder, arm):
    for kind, controller in (("pdf", None), ("lerobot", None), ("urdf", "policy")):
        with pytest.raises(InputError):
            export_run(run_folder.path, kind, controller=controller)
    found = read_calibration(run_folder.calibration, arm)
    write_calibration(run_folder.calibration, dataclasses.replace(found, used=False))
    with pytest.raises(FileError, match="nothing to export"):
        export_run(run_folder.path, "urdf")
    run_folder.calibration.unlink()
    with pytest.raises(FileError, match="rejoint calibrate ROBOT"):
        export_run(run_folder.path, "urdf")
