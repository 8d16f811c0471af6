"""The result of an evaluation is what lies on disk."""

import numpy as np
import pytest
from evaluation_samples import outcome

from rejoint.arms import mycobot280
from rejoint.system.files import read_json
from rejoint_lab.research.evaluation.evaluate import Evaluation, Trials, conclude, summarise
from rejoint_lab.research.evaluation.family import ArmFamily

ARM = mycobot280()
FAMILY = ArmFamily(arms=8, targets=3)
MEANINGS = {"worn": "worn arms", "payload": "worn arms with a load"}
NAMES = ("slow", "fast", "p #0", "p #1")


@pytest.fixture(scope="module")
def outcomes():
    rng, found = np.random.default_rng(8), {}
    for variant in MEANINGS:
        for name, settled, stay in zip(NAMES, (0.6, 0.5, 0.3, 0.35), (3.0, 1.5, 1.0, 1.1), strict=True):
            mm, times = settled * rng.uniform(0.5, 1.5, (8, 3)), stay * rng.uniform(0.5, 1.5, (8, 3))
            if name == "slow":
                mm[2, 1], times[2, 1] = 7.7, np.inf
                mm[5, 0] = times[5, 0] = np.nan
            found[variant, name] = outcome(mm, times, cycle=5.0 * stay)
    return found


@pytest.fixture(scope="module")
def evaluation(outcomes):
    return summarise(ARM.name, FAMILY, MEANINGS, outcomes, {"p"})


def test_the_result_on_disk_is_the_result(outcomes, evaluation, tmp_path):
    trials = {at: Trials(repr(at), lambda _, at=at: outcomes[at]) for at in outcomes}
    made = conclude(ARM, MEANINGS, trials, {"p"}, FAMILY, tmp_path / "evaluation.json", lambda *_: None)
    assert made == evaluation == read_json(tmp_path / "evaluation.json", Evaluation)
