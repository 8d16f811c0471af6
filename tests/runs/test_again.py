"""An arm that is repaired again keeps twin and policy while it moves as they say, and only then."""

import logging
import shutil
from dataclasses import replace

import pytest

import rejoint
from rejoint.control.controllers.catalogue import shelf_path
from rejoint.runs.repair import keep_what_holds
from rejoint.runs.run import Run, finish

PRESET = rejoint.Policy.load(shelf_path("mycobot280")).contract.preset


@pytest.fixture(scope="module")
def repaired(tmp_path_factory):
    """A run with everything that a repair leaves, the policy from the shelf."""
    run = Run.create(tmp_path_factory.mktemp("runs") / "001", "emulated:worn", rejoint.load_arm("mycobot280"))
    rejoint.diagnose("emulated:worn", run=run, quick=True)
    run.folder.quick.unlink()
    rejoint.identify(run=run)
    shutil.copy(shelf_path("mycobot280"), run.folder.policy)
    run.folder.outputs.folder.mkdir()
    run.folder.outputs.curves.write_bytes(b"curves")
    finish(run)
    return run.path


@pytest.fixture
def last(repaired, tmp_path):
    shutil.copytree(repaired, tmp_path / "001")
    return Run.open(tmp_path / "001")


@pytest.fixture
def run(last, tmp_path):
    """The same arm, diagnosed again."""
    run = Run.create(tmp_path / "002", last.robot, last.arm)
    shutil.copy(last.folder.diagnosis, run.folder.diagnosis)
    shutil.copytree(last.path / "logs", run.path / "logs")
    return run


def test_twin_policy_and_curves_are_kept_to_the_byte_and_the_run_says_from_where(last, run):
    why = keep_what_holds(run, PRESET)
    for name in ("twin.toml", "policy.onnx", "training/curves.parquet"):
        assert (run.path / name).read_bytes() == (last.path / name).read_bytes()
    assert why.error < 2.0 * why.fitted
    assert str(last.path) in str(why)
    run.folder.outputs.curves.unlink()
    assert rejoint.report(run)
    assert "still moves as its twin of" in run.folder.report.read_text()
    assert keep_what_holds(run, PRESET) is None, "it has a twin now"
    rejoint.identify(run=run, quick=True)
    assert not run.folder.kept.exists(), "the twin is another one now"


def test_nothing_is_kept_where_the_arm_has_changed_or_the_repair_was_of_another_kind(last, run):
    twin = last.twin
    softer = replace(twin.parameters, stiffness=0.3 * twin.parameters.stiffness)
    replace(twin, parameters=softer).save(last.folder.twin)
    assert keep_what_holds(run, PRESET) is None
    twin.save(last.folder.twin)
    assert keep_what_holds(run, "paper") is None
    last.folder.finished.unlink()
    assert keep_what_holds(run, PRESET) is None
    finish(last)
    assert not run.folder.twin.exists()
    assert keep_what_holds(run, PRESET) is not None


def test_a_damaged_last_repair_is_told_and_costs_no_more(last, run, caplog):
    last.folder.twin.write_text("stiffness = [")
    with caplog.at_level(logging.WARNING, "rejoint"):
        assert keep_what_holds(run, PRESET) is None
    assert str(last.folder.twin) in caplog.text
