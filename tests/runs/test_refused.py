"""Numbers that no arm can be driven by are refused before the robot is opened: at these addresses nothing answers."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import rejoint
from madetwin import made_calibration
from rejoint.arms import Displacement, mycobot280, so101
from rejoint.diagnosis.calibration.calibration import write_calibration
from rejoint.runs.run import Run
from rejoint.session.context import zeros_of
from runs.test_connect import a_twin

ARM = mycobot280()
NOBODY = "tcp://127.0.0.1:1"
TARGETS = [[0.17, 0.0, 0.2]]
POSES = [rejoint.Pose(place_m=(0.17, 0.0, 0.2), direction=(0.0, 0.0, -1.0))]


@pytest.fixture
def run(tmp_path):
    path = Run.create(tmp_path, NOBODY, ARM).path
    a_twin().save(path / "twin.toml")
    return path


def test_an_arm_that_is_not_the_one_of_the_run(run):
    stages = rejoint.connect, rejoint.diagnose, rejoint.repair
    calls = *(partial(stage, NOBODY) for stage in stages), rejoint.identify, rejoint.train
    for call in calls:
        for other in ("so101", replace(ARM, floor=0.01)):
            with pytest.raises(rejoint.InputError, match="give another --run"):
                call(run=Run.open(run), arm=other)


@pytest.mark.parametrize("wrong", [{"dwell": np.inf}, {"dwell": 0.0}, {"within": 5.0}, {"within": np.nan}], ids=str)
def test_a_deployment_without_end_or_measure(run, wrong):
    with pytest.raises(rejoint.InputError, match="positive"):
        rejoint.deploy(NOBODY, TARGETS, run=run, settings=rejoint.Settings(controller="integrator", **wrong))


def test_a_calibration_that_shifts_a_tool_farther_than_any_wear(run):
    far = replace(Displacement.none(ARM), offset=np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0]))
    write_calibration(run / "calibration.toml", made_calibration(ARM, far))
    drives = (
        lambda: rejoint.deploy(NOBODY, TARGETS, run=run, settings=rejoint.Settings(controller="integrator")),
        lambda: rejoint.follow(NOBODY, "circle-8s", run=run),
        lambda: rejoint.serve(NOBODY, run, listen="127.0.0.1:0"),
        lambda: rejoint.connect(NOBODY, run=run),
    )
    for drive in drives:
        with pytest.raises(rejoint.InputError, match=r"shifts a target by .* calibrate again"):
            drive()


def test_a_calibration_holds_for_the_zeros_that_it_was_measured_with(tmp_path):
    file, arm = tmp_path / "arm.json", so101()
    file.write_text("{}")
    address = f"feetech://127.0.0.1:9?calibration={file}"
    run = Run.create(tmp_path / "run", address, arm)
    far = replace(Displacement.none(arm), offset=np.array([0.5, 0.0, 0.0, 0.0, 0.0]))
    write_calibration(run.folder.calibration, made_calibration(arm, far, zeros=zeros_of(address)))
    with pytest.raises(rejoint.InputError, match="shifts a target"):
        rejoint.connect(address, run=run)
    for other in (f"{address}&zero=0,0,0,0,5", address):
        with pytest.raises((rejoint.FileError, rejoint.RobotError)):  # opened, uncorrected
            rejoint.connect(other, run=run)
        file.write_text("{ }")  # calibrated again, under the same name


@pytest.mark.parametrize(
    "wrong",
    [
        {"preset": "defualt"},
        {"controllers": ["integrator", "polciy"]},
        {"controllers": ["mine.onnx"]},
        {"controllers": ["servo-gains+policy"]},
        {"controllers": ["policy"], "targets": POSES},
    ],
    ids=str,
)
def test_a_repair_whose_comparison_or_training_cannot_be(tmp_path, wrong):
    """It would be found out after minutes of motion and a training."""
    with pytest.raises((rejoint.InputError, rejoint.FileError)):
        rejoint.repair(NOBODY, run=tmp_path / "run", quick=True, plan=rejoint.RepairPlan(**wrong))
    assert not (tmp_path / "run").exists()


def test_a_training_that_cannot_be_is_no_quick_try(tmp_path):
    run = Run.create(tmp_path / "run", NOBODY, mycobot280())
    with pytest.raises(rejoint.InputError, match="no preset is called 'nope'"):
        rejoint.train(run=run, preset="nope", quick=True, settings=rejoint.TrainSettings(generic=True))
    assert not run.folder.quick.exists()


@pytest.mark.parametrize("stage", [rejoint.identify, rejoint.diagnose, partial(rejoint.replay, a_twin())])
def test_no_logs_are_nothing_to_work_on(stage):
    with pytest.raises(rejoint.InputError, match="no run logs"):
        stage([])


def test_an_arm_without_the_wire_that_is_served(tmp_path):
    run = Run.create(tmp_path, "feetech://127.0.0.1:1", so101()).path
    with pytest.raises(rejoint.InputError, match="not of so101; for joint goals line by line take --stdio"):
        rejoint.serve("feetech://127.0.0.1:1", run)
