"""Settings: refused where they cannot be meant, kept by a run, and the same words at the command line."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rejoint
from hearing import Hears
from rejoint.arms import Box, mycobot280
from rejoint.arms.inertia import LoadedArm, Payload, loaded
from rejoint.cli.options import meaning
from rejoint.runs.run import Run, mark_quick
from rejoint.session.settings import keep, settled
from runs.test_connect import a_twin

ARM = mycobot280()
WALL = Box(lower=np.array([0.15, -0.15, 0.0]), upper=np.array([0.3, -0.08, 0.3]))
GIVEN = rejoint.Settings(payload=0.1, tool=[0.0, 0.0, 0.05], keep_out=[WALL], period=(0.02, 0.03), within=0.003)


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Run.create(tmp_path / "run", "emulated:worn", ARM, 0)


@pytest.mark.parametrize(
    "wrong",
    [{"within": 2.0}, {"within": float("nan")}, {"period": (20, 30)}, {"period": 0.02}, {"seed": -1}, {"seed": 0.5},
     {"keep_out": [((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))]}],
)  # fmt: skip
def test_settings_that_cannot_be_meant_are_refused_at_once(wrong: dict[str, Any]) -> None:
    with pytest.raises(rejoint.InputError):
        rejoint.Settings(**wrong)


def test_what_is_no_settings_is_refused_before_anything_moves() -> None:
    for call in (rejoint.connect, rejoint.deploy, rejoint.diagnose, rejoint.repair):
        with pytest.raises(rejoint.InputError, match=r"rejoint\.Settings"):
            call("emulated:worn", settings={"payload": 0.1})


def test_a_run_keeps_the_settings_of_its_diagnosis_and_others_go_before_them(run: Run) -> None:
    keep(run, GIVEN)
    found, said = settled(None, run, "emulated:worn")
    assert said
    assert isinstance(found.payload, Payload)
    assert (found.payload.mass, found.payload.com) == (0.1, (0.0, 0.0, 0.0))
    assert (found.period, found.within) == (GIVEN.period, GIVEN.within)
    np.testing.assert_array_equal(found.tool, GIVEN.tool)
    np.testing.assert_array_equal(found.keep_out[0].upper, WALL.upper)
    other = rejoint.Settings(payload=0.0, tool=np.zeros(3), keep_out=[WALL], period=(0.03, 0.04), within=0.001)
    assert settled(other, run, "emulated:worn") == (other, "")
    own = settled(None, run, rejoint.open_robot("emulated:worn"))[0]
    assert own.payload is own.tool is None, "an open robot has its own"
    assert own.period == GIVEN.period
    assert settled(GIVEN, None, "emulated:worn") == (GIVEN, "")


def test_kept_settings_drive_the_arm_and_are_named(run: Run) -> None:
    a_twin().save(run.path / "twin.toml")
    keep(run, rejoint.Settings(payload=0.05, keep_out=[WALL]))
    mark_quick(run, quick=True)
    said = list[str]()
    with rejoint.connect("emulated:worn", run=run.path, observer=Hears(message=said.append)) as arm:
        assert isinstance(arm.arm, LoadedArm)
        np.testing.assert_array_equal(arm.arm.mass, loaded(ARM, 0.05).mass)
        assert len(arm.arm.keep_out) == len(ARM.keep_out) + 1
        assert any("payload 0.05 kg" in line for line in said)
        assert any("quick" in line for line in said)
    with rejoint.connect("emulated:worn", run=run.path, settings=rejoint.Settings(payload=0.0)) as arm:
        np.testing.assert_array_equal(arm.arm.mass, ARM.mass)


def test_every_field_says_what_it_means_without_units_and_python() -> None:
    for field in fields(rejoint.Settings):
        said = meaning(field.name)
        assert said
        assert "Python" not in said
        assert not said.startswith("[")
    assert "nothing" in meaning("dry_run")
    assert "carries" in meaning("payload")


def test_a_dry_comparison_moves_nothing() -> None:
    robot, said = rejoint.open_robot("emulated:worn"), list[str]()
    before = robot.read()
    target = [[[0.18, 0.03, 0.21]]]
    found = rejoint.compare(
        robot, ["default"], target, plan=rejoint.TrialPlan(repetitions=1), settings=rejoint.Settings(dry_run=True),
        observer=Hears(message=said.append),
    )  # fmt: skip
    assert found.comparison.rows
    after = robot.read()
    np.testing.assert_array_equal(after.time, before.time)
    np.testing.assert_array_equal(after.position, before.position)
    assert any("nothing moved" in line for line in said)
