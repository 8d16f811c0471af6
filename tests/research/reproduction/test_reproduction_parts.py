"""Single experiments, measures and figures of the reproduction, judged on what is known."""

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.pages.report.contents import Curves
from rejoint.research.reproduction import gains
from rejoint.research.reproduction.campaign import EXPERIMENTS, choose
from rejoint.research.reproduction.experiment import QUICK, Bench
from rejoint.research.reproduction.recipe import TrainingOutcome
from rejoint.research.reproduction.trainings import (
    LITERAL,
    WORN,
    finish_trainings,
)
from rejoint.system.errors import InputError, RejointError

ARM = mycobot280()


def test_the_command_line_lists_runs_and_refuses(tmp_path, cli):
    listed = cli("reproduce", "--list", "--json").last
    assert [one["name"] for one in listed] == [one.name for one in EXPERIMENTS]
    words = ("--run", tmp_path / "run", "--out", tmp_path / "page.md", "--quick", "--json")
    found = cli("reproduce", "table-1", *words).last["experiments"][0]
    assert found["findings"]["numbers"][0]["value"] == pytest.approx(0.97, abs=0.02)
    assert (tmp_path / "page.md").exists()
    assert "table-4" in cli("reproduce", "table-9", code=2).err


def test_experiments_are_chosen_by_any_of_their_names_in_the_paper_s_order():
    assert [one.name for one in choose(["fig-13", "fig-9"])] == ["fig-9", "table-4"]
    assert choose([]) == EXPERIMENTS
    with pytest.raises(InputError, match="known: algorithm-1"):
        choose(["fig-99"])


def test_overshoot_and_error_of_a_known_path():
    steps = round(gains.DWELL / gains.STEP)
    time = np.arange(steps) * gains.STEP
    ringing = 1.0 - np.exp(-8.0 * time) * np.cos(2 * np.pi * 2.0 * time)
    path = np.zeros((2 * steps, 3))
    path[:steps, 0], path[steps:, 0] = 0.2 * ringing, 0.2
    path[steps:, 1] = 0.1 * ringing
    targets = np.array([[0.203, 0.0, 0.0], [0.2, 0.103, 0.0]])
    error, overshoot = gains.judge(path, targets)
    assert error == pytest.approx(3.0, abs=0.01)
    assert overshoot == pytest.approx(100 * (ringing.max() - 1.0), abs=0.1)


def test_a_training_that_cannot_go_on_says_why_and_stops_the_others(tmp_path):
    bench = Bench(folder=tmp_path, arm=ARM, seed=0, scale=QUICK, threads=1)
    taken = bench.training(WORN[0]).outputs.folder
    taken.parent.mkdir(parents=True)
    taken.write_bytes(b"a file where a folder should be")
    with pytest.raises(RejointError, match="training: cannot be written"):
        finish_trainings(bench, (WORN[0], LITERAL))
    assert not bench.training(LITERAL).policy.exists()


def test_an_outcome_of_a_training_worked_by_hand():
    success = np.array([0.0, 0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    flat = np.zeros(7)
    outcome = TrainingOutcome(
        curves=Curves(step=flat, reward=flat, success_rate=success, error_mm=flat, wall_s=flat),
        crossings={
            "crossed": np.array([[1.0, 1.0], [1.0, 0.0]]),
            "crossing_error": np.array([[9e-3, 8e-3], [np.nan, 30e-3]]),
            "crossing_time": np.ones((2, 2)),
        },
    )
    assert outcome.trained == pytest.approx(30.0)  # of the last five
    assert outcome.success == pytest.approx(75.0)
    np.testing.assert_allclose(outcome.error_mm, [9.0, 8.0, 30.0])
