"""Single experiments, measures and figures of the reproduction, judged on what is known."""

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.system.errors import RejointError
from rejoint_lab.research.reproduction import measures
from rejoint_lab.research.reproduction.campaign import (
    WORN,
    Bench,
    finish_trainings,
)

ARM = mycobot280()


def test_the_command_line_runs(tmp_path, cli):
    found = cli("research", "reproduce", "table-1", "--run", tmp_path / "run", "--quick", "--json").last
    _, ours, _ = found["found"]["table-1"]["numbers"][0]
    assert float(ours.removesuffix(" mm")) == pytest.approx(0.97, abs=0.02)
    assert (tmp_path / "run" / "reproduction.md").exists()


def test_overshoot_and_error_of_a_known_path():
    steps = round(measures.FIG_10_DWELL / measures.STEP)
    time = np.arange(steps) * measures.STEP
    ringing = 1.0 - np.exp(-8.0 * time) * np.cos(2 * np.pi * 2.0 * time)
    path = np.zeros((2 * steps, 3))
    path[:steps, 0], path[steps:, 0] = 0.2 * ringing, 0.2
    path[steps:, 1] = 0.1 * ringing
    targets = np.array([[0.203, 0.0, 0.0], [0.2, 0.103, 0.0]])
    error, overshoot = measures.judge(path, targets)
    assert error == pytest.approx(3.0, abs=0.01)
    assert overshoot == pytest.approx(100 * (ringing.max() - 1.0), abs=0.1)


def test_a_training_that_cannot_go_on_says_why_and_stops_the_others(tmp_path):
    bench = Bench(folder=tmp_path, arm=ARM, seed=0).quickly()
    taken = bench.training(WORN[0]).training
    taken.parent.mkdir(parents=True)
    taken.write_bytes(b"a file where a folder should be")
    with pytest.raises(RejointError, match=r"training.*cannot be written"):
        finish_trainings(bench, (WORN[0], "literal"))
    assert not bench.training("literal").policy.exists()
