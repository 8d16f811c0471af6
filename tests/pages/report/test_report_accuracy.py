"""Where the tool is: the section of the report, and what else leaves the run."""

import dataclasses
import re

import numpy as np
import pytest
from report_samples import make_calibration, make_comparison, shown

from readpage import Page
from rejoint.arms import load_arm, tcp_position
from rejoint.arms.urdf import at_targets
from rejoint.control.accuracy import TrueError
from rejoint.control.comparison.result import DirectionVariation, PoseAccuracy, TargetErrors
from rejoint.diagnosis.calibration.file import read_calibration, write_calibration
from rejoint.diagnosis.calibration.gate import DISTURBED
from rejoint.diagnosis.calibration.measurementfile import write_measurements
from rejoint.diagnosis.calibration.procedure import reversals
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.pages.report.contents import read_contents
from rejoint.pages.report.datasheet import write_datasheet
from rejoint.pages.report.displaced import arrow_scale
from rejoint.pages.report.errors import before_after
from rejoint.pages.report.words import day_and_time
from rejoint.runs.exports import export_run
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import write_json
from rejoint.system.statistics import spread

POINTS = "tool / Measured points in the base frame, each left out"


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """A folder with a calibration alone, and the page that it makes."""
    arm, folder = load_arm("mycobot280"), RunFolder(tmp_path_factory.mktemp("calibrated"))
    calibration, measured = make_calibration(arm)
    write_calibration(folder.calibration, calibration)
    write_measurements(folder.measurements, arm, measured)
    return folder, calibration, measured, shown(folder.path)[0]


def test_every_point_stands_with_both_of_its_errors(calibrated):
    _, calibration, measured, page = calibrated
    for i, (before, after) in enumerate(calibration.left_out):
        row = f"{POINTS} / {i + 1}"
        assert float(page.places[f"{row} / off the encoders [mm]"]) == pytest.approx(1e3 * before, rel=0.06)
        assert float(page.places[f"{row} / off the calibration [mm]"]) == pytest.approx(1e3 * after, rel=0.06)
        assert float(page.places[f"{row} / z [mm]"]) == pytest.approx(1e3 * measured.point[i, 2], abs=0.051)
        assert " to " in page.places[f"{row} / off the calibration [mm] / small"]


def test_many_that_do_not_fit_are_no_mistakes_of_a_hand(calibrated, tmp_path):
    _, calibration, measured, page = calibrated
    assert DISTURBED not in page.words
    folder = RunFolder(tmp_path)
    write_calibration(folder.calibration, dataclasses.replace(calibration, suspects=(5, 6, 7)))
    write_measurements(folder.measurements, calibration.arm, measured)
    assert DISTURBED in shown(folder.path)[0].words


def test_suspects_reversal_and_source_are_told(calibrated):
    _, calibration, measured, page = calibrated
    assert "Measurement 6 does not fit to the others" in page.words
    assert "suspect" in page.places[f"{POINTS} / 6 / measurement / small"]
    values = reversals(calibration.arm, measured, calibration.frame)
    assert f"largest {1e3 * max(values):.1f}" in page.words.replace("\N{NO-BREAK SPACE}", " ")
    for fact in ("touch, typed in by hand", "20 November 2026, 07:30", "8 measurements"):
        assert fact in page.words


def test_the_figure_says_how_long_its_arrows_are(calibrated):
    _, calibration, measured, page = calibrated
    scale = arrow_scale(tcp_position(calibration.arm, measured.position), measured.point)
    assert (f"{scale} times as long as they are" if scale > 1 else "to scale") in page.words


def test_arrows_are_longer_for_small_errors_and_never_too_long():
    seen = np.random.default_rng(0).uniform(0.0, 0.2, (9, 3))
    scales = [arrow_scale(seen, seen + away) for away in (1e-4, 1e-3, 1e-2, 1e-1)]
    assert scales == sorted(scales, reverse=True)
    assert scales[0] > scales[-1] == 1


def test_measurements_of_another_calibration_are_not_set_beside_it(tmp_path):
    arm, folder = load_arm("mycobot280"), RunFolder(tmp_path)
    calibration, measured = make_calibration(arm)
    write_calibration(folder.calibration, calibration)
    write_measurements(folder.measurements, arm, measured.rows(np.arange(6)))
    assert not any(place.startswith(POINTS) for place in shown(tmp_path)[0].places)


def with_poses(arm, **hold):
    comparison = make_comparison(arm, ("default", "integrator"), true_known=False)
    poses = PoseAccuracy(
        cycles=4,
        accuracy=spread(np.full(6, 1.23e-3), np.arange(6)),
        repeatability=spread(np.full(6, 0.45e-3), np.arange(6)),
    )
    rows = [
        dataclasses.replace(row, hold=dataclasses.replace(row.hold, poses=poses, **hold)) for row in comparison.rows
    ]
    return dataclasses.replace(comparison, rows=tuple(rows), calibration="2026-11-20T07:30:00")


def test_accuracy_and_repeatability_stand_with_their_cycles(tmp_path):
    arm = load_arm("mycobot280")
    write_json(RunFolder(tmp_path).comparison, with_poses(arm))
    page = shown(tmp_path)[0]
    row = "comparison / Accuracy after ISO 9283 / integrator"
    assert page.places[f"{row} / AP, encoders [mm]"] == "1.2"
    assert page.places[f"{row} / RP, encoders [mm]"] == "0.45"
    assert page.places[f"{row} / AP, tool [mm]"] == "not known"
    assert "4 cycles for each pose, where the norm asks for 30" in page.words


def test_errors_stand_target_by_target_before_and_after(tmp_path):
    arm = load_arm("mycobot280")
    comparison = dataclasses.replace(make_comparison(arm, ("default", "integrator")), calibration="2026-11-20T07:30:00")
    count = len(comparison.targets[0])
    before = TargetErrors(
        encoders=tuple(0.010 + 1e-3 * k for k in range(count)),
        true=tuple(TrueError(how="modelled", value=0.020 + 1e-3 * k, low=0.015, high=0.03) for k in range(count)),
    )
    file = RunFolder(tmp_path).comparison
    write_json(file, dataclasses.replace(comparison, as_found=before))
    places, table = shown(tmp_path)[0].places, "comparison / Errors before and after"
    after = comparison.row("integrator").outcomes
    for k in range(count):
        row = f"{table} / target {k + 1}"
        assert float(places[f"{row} / before, encoders [mm]"]) == pytest.approx(10 + k, rel=0.06)
        assert float(places[f"{row} / before, tool [mm]"]) == pytest.approx(20 + k, rel=0.06)
        assert places[f"{row} / before, tool [mm] / small"] == "modelled, 15.0 to 30.0"
        for name, field in (("encoders", "settled"), ("tool", "settled_true")):
            told = 1e3 * after.array(field)[0, :, k].mean()
            assert float(places[f"{row} / with “integrator”, {name} [mm]"]) == pytest.approx(told, rel=0.06)
    write_json(file, comparison)
    assert not any(place.startswith(table) for place in shown(tmp_path)[0].places), "nobody drove it as it was found"
    write_json(file, dataclasses.replace(comparison, calibration=""))
    told = 1e3 * comparison.row("default").outcomes.array("settled_true")[0, :, 0].mean()
    found = shown(tmp_path)[0].places[f"{table} / target 1 / before, tool [mm]"]
    assert float(found) == pytest.approx(told, rel=0.06), "in a comparison that was not aimed, its own row tells"


def test_variation_by_direction_stands_on_the_page_and_the_data_sheet(tmp_path):
    arm = load_arm("mycobot280")
    some = spread(np.array([1.1e-3, 1.3e-3, 1.5e-3, 1.7e-3, 1.9e-3]), np.arange(5))
    found = DirectionVariation(controller="integrator", poses=5, cycles=4, encoders=some, tool=None)
    write_json(RunFolder(tmp_path).comparison, dataclasses.replace(with_poses(arm), directions=found))
    words = shown(tmp_path)[0].words.replace("\N{NO-BREAK SPACE}", " ")
    low, high = (f"{1e3 * end:.1f}" for end in (some.mean.low, some.mean.high))
    assert f"vAP of integrator: 1.5 mm by the encoders ({low} to {high})" in words
    assert "5 poses, 4 cycles from each direction, where the norm asks for 30" in words
    rows = {row[0]: row[1:] for row in Page(write_datasheet(tmp_path, tmp_path / "sheet.html")).rows}
    name = "vAP, multi-directional variation of accuracy"
    assert rows[f"{name} by the encoders"][0] == "1.50"
    assert rows[f"{name} by the encoders"][2:] == ["5", "4 cycles, 3 directions"]
    assert rows[f"{name} of the tool"][0] == "not known"


def test_what_was_done_names_the_calibration_and_what_measured(run_folder, arm):
    told = make_calibration(arm)[0]
    write_calibration(run_folder.calibration, dataclasses.replace(told, source="emulated"))
    words = shown(run_folder.path)[0].words.replace("\N{NO-BREAK SPACE}", " ")
    assert "The tool was measured from outside 8 times, with the emulator's own knowledge of its tool" in words
    assert f"it was {1e3 * told.before:.1f} mm from where the encoders see it" in words


def test_a_finding_that_the_tool_does_not_feel_costs_nothing(run_folder, diagnosis):
    first = diagnosis.findings[0]
    turned = dataclasses.replace(first, joint="joint6", tcp_mm=0.01, sentence="joint6 is soft, 0.0 mm at the tool.")
    write_json(run_folder.diagnosis, dataclasses.replace(diagnosis, findings=(first, turned)))
    page = shown(run_folder.path)[0]
    assert "Worn, but the tip of the tool does not feel it: joint6 (soft)." in page.words
    assert "joint6 is soft, 0.0 mm" not in page.words
    assert not any("Findings" in place and "joint6" in place for place in page.places)
    assert any("Findings" in place and "joint3" in place for place in page.places)


@pytest.mark.parametrize(
    ("text", "words"),
    [("2026-11-21T11:33:31+0000", "21 November 2026, 11:33"), ("2026-01-05 07:02:00", "5 January 2026, 07:02"),
     ("last spring", "last spring"), ("", "")],
)  # fmt: skip
def test_dates_are_said_as_people_say_them(text, words):
    assert day_and_time(text) == words


def test_a_modelled_error_is_called_so_everywhere(tmp_path):
    arm, folder = load_arm("mycobot280"), RunFolder(tmp_path)
    error = TrueError(how="modelled", value=1.31e-3, low=0.42e-3, high=2.63e-3)
    write_json(folder.comparison, with_poses(arm, settled_modelled=error))
    write_calibration(folder.calibration, make_calibration(arm)[0])
    page = shown(tmp_path)[0]
    column = (
        "comparison / Every controller on the same arm with the same targets / integrator / settled error, true [mm]"
    )
    assert page.places[column] == "1.3, modelled"
    assert page.places[f"{column} / small"] == "0.4 to 2.6"
    assert "modelled by the calibration, 95 %: 0.4 to 2.6" in page.words
    result = before_after(read_contents(tmp_path), "integrator")
    assert result.after.tool == error
    assert result.before.encoders is None, (
        "of a comparison that was aimed, the default controller is not the arm as found"
    )


def test_the_line_at_the_end_tells_both_errors_or_that_one_is_not_known(run_folder, comparison):
    contents = read_contents(run_folder.path)
    line = before_after(contents, "policy").sentence
    before, after = (comparison.row(name).hold for name in ("default", "policy"))
    encoders, tool = ([1e3 * hold.settled.mean.value for hold in (before, after)],
                      [1e3 * hold.settled_true.mean.value for hold in (before, after)])  # fmt: skip
    assert line == (
        f"Before: {encoders[0]:.1f} mm off (encoders), {tool[0]:.1f} mm (the tool itself). After, with 'policy': "
        f"{encoders[1]:.2f} mm (encoders), {tool[1]:.1f} mm (tool)."
    )
    blind = make_comparison(contents.arm, true_known=False)
    line = before_after(dataclasses.replace(contents, comparison=blind), "policy").sentence
    assert line.endswith("The tool itself: not known: calibrate.")


def test_the_data_sheet_holds_each_number_with_its_count_or_says_not_known(run_folder, comparison, diagnosis):
    path, _ = export_run(run_folder.path, "datasheet")
    page = Page(path)
    found = {row[0]: row[1:] for row in page.rows}
    settled = comparison.row("policy").hold.settled
    assert float(found["Encoder error, repaired"][0]) == pytest.approx(1e3 * settled.mean.value, rel=6e-3)
    assert found["Encoder error, repaired"][2] == str(settled.count)
    assert found["True error, repaired"][3] == "known"
    assert found["Tool from where the encoders see it"][2:] == ["8", "measured"]
    assert found["Reversal value at the tool, ISO 230-2"][2] == "4"
    assert found["vAP, multi-directional variation of accuracy of the tool"] == ["not known", "", "", ""]
    words = " ".join(page.text)
    assert re.search(r"Payload\s+not known", words)
    assert re.search(r"Controller recommended\s+policy", words)
    assert "nan" not in words.lower()


def test_a_unit_s_urdf_is_what_its_calibration_says(run_folder, arm):
    path, _ = export_run(run_folder.path, "urdf")
    unit, found = load_arm(path), read_calibration(run_folder.calibration, arm)
    postures = at_targets(arm)
    rigid = found.displacement.rigid(arm, postures)
    np.testing.assert_allclose(tcp_position(unit, postures), rigid.tool(arm, postures), atol=1e-9)


def test_what_cannot_be_exported_is_refused(run_folder, arm):
    with pytest.raises(InputError, match="expected urdf, lerobot, datasheet"):
        export_run(run_folder.path, "pdf")
    with pytest.raises(InputError, match="--lerobot FILE"):
        export_run(run_folder.path, "lerobot")
    found = read_calibration(run_folder.calibration, arm)
    write_calibration(run_folder.calibration, dataclasses.replace(found, used=False))
    with pytest.raises(FileError, match="nothing to export"):
        export_run(run_folder.path, "urdf")
    run_folder.calibration.unlink()
    with pytest.raises(FileError, match="rejoint calibrate ROBOT"):
        export_run(run_folder.path, "urdf")
