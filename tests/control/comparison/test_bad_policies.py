"""Whatever a policy says: the guard keeps its laws, the comparison notices, a baseline is handed over."""

import bad_policies as bad
import numpy as np
import pytest

import rejoint
from comparisons import picked
from madetwin import made_calibration
from rejoint.arms import Displacement, mycobot280
from rejoint.control.comparison.compare import Settings, TrialRunner
from rejoint.control.comparison.recommend import failure, recommend
from rejoint.control.comparison.result import Protocol
from rejoint.control.controllers.catalogue import make_controller
from rejoint.control.controllers.policy import load_policy
from rejoint.control.targets import draw_targets
from rejoint.diagnosis.calibration.calibration import write_calibration
from rejoint.logs.runlog import RunLog
from rejoint.robots import open_robot
from rejoint.runs.run import Run

ARM = mycobot280()
PROTOCOL = Protocol(dwell=4.0, hold=3.0, window=0.5)
TARGETS = draw_targets(ARM, sets=1, count=2, seed=1)
NAMES = ("random", "saturated", "nan", "nan-later", "infinite", "softer")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policies")
    return {
        "random": bad.random_weights(folder / "random.onnx", ARM),
        "saturated": bad.saturated(folder / "saturated.onnx", ARM),
        "nan": bad.poisoned(folder / "nan.onnx", ARM, np.nan, "distance", bad.FAR),
        "nan-later": bad.poisoned(folder / "later.onnx", ARM, np.nan, "waited", bad.LATE),
        "infinite": bad.poisoned(folder / "infinite.onnx", ARM, np.inf, "distance", bad.FAR),
        "softer": bad.for_a_softer_arm(folder / "softer", ARM),
    }


def tried(files, *, batched):
    trials = []
    controllers = {"integrator": lambda arm: make_controller("integrator", arm)}
    controllers |= {name: (lambda arm, name=name: load_policy(files[name], arm)) for name in NAMES}
    found = TrialRunner(
        lambda count, seed: open_robot("emulated:worn", arm=ARM, seed=seed, count=count),
        controllers,
        TARGETS,
        Settings(batched=batched, repetitions=2 if batched else 1, protocol=PROTOCOL),
        on_trial=lambda *trial: trials.append(trial),
    ).compare()
    return found, trials


@pytest.fixture(scope="module", params=[True, False], ids=["batch", "one arm"])
def comparison(request, files):
    return tried(files, batched=request.param)


def test_the_comparison_notices(comparison):
    found, _ = comparison
    good = found.row("integrator")
    assert (good.success.value, good.failures, good.out) == (1.0, 0, "")
    for name in ("random", "saturated", "infinite"):
        row = found.row(name)
        assert row.success.value < 1.0, name
        assert failure(row) or row.settled.mean.value > 10 * good.settled.mean.value, name
    for name in ("nan", "nan-later"):
        row = found.row(name)
        assert row.failures > 0
        assert set(row.ended) == {"not finite"}
        assert "not a number" in failure(row)


@pytest.mark.parametrize("name", NAMES)
def test_a_baseline_is_handed_over(comparison, name):
    found, _ = comparison
    advice = recommend(picked(found, {"integrator": "integrator", name: "policy"}))
    row, good = found.row(name), found.row("integrator")
    harmless = not failure(row) and row.success.value == 1.0 and row.settled.mean.value <= good.settled.mean.value
    assert advice.controller == "integrator" or (name == "softer" and harmless)
    assert any("policy" in line for line in advice.why), "and it says why"


def test_repair_hands_over_the_baseline_and_says_why(tmp_path, files, cli):
    run = Run.create(tmp_path / "one", "emulated:worn", ARM)
    time = np.arange(0.0, 60.0, 0.05)
    command = ARM.rest + 0.2 * np.sin(0.6 * time[:, None] + np.arange(ARM.joints))
    rejoint.diagnose(RunLog.of(time, command, command - 0.02, arm=ARM), run=run)
    write_calibration(run.folder.calibration, made_calibration(ARM, Displacement.none(ARM)))
    bad.softer_twin(ARM).save(run.folder.twin)
    run.folder.policy.write_bytes(files["nan-later"].read_bytes())
    points = tmp_path / "points.csv"
    points.write_text("x,y,z\n170,0,200\n")
    options = ("--targets", points, "--repetitions", "1", "--controllers", "integrator,policy", "--json")
    said = cli("repair", "emulated:worn", "--run", run.path, *options)
    assert said.last["recommended"]["controller"] == "integrator"
    sentence = "policy: 1 run ended early, because a command or a measured position was not a number."
    assert sentence in said.out
    page = run.folder.report.read_text()
    assert f"The learned policy was tried and failed. {sentence.capitalize()}" in page.replace("\n", " ")
    assert "What failed, and why" in page
