"""The result of an evaluation is what lies on disk."""

import numpy as np
import pytest
from evaluation_samples import outcome

from rejoint.arms import mycobot280
from rejoint.system.files import read_json
from rejoint_lab.research.evaluation.evaluate import Contestant, Trials, conclude
from rejoint_lab.research.evaluation.family import ArmFamily
from rejoint_lab.research.evaluation.summary import Evaluation, pool, summarise

ARM = mycobot280()
FAMILY = ArmFamily(arms=8, targets=3)
MEANINGS = {"worn": "worn arms", "payload": "worn arms with a load"}
NAMES = (("slow", "slow"), ("fast", "fast"), ("p #0", "p"), ("p #1", "p"))
CONTESTANTS = [
    Contestant(name=name, group=group, make=None, identity=name, learned=group == "p") for name, group in NAMES
]


@pytest.fixture(scope="module")
def outcomes():
    rng, found = np.random.default_rng(8), {}
    for variant in MEANINGS:
        for (name, _), settled, stay in zip(NAMES, (0.6, 0.5, 0.3, 0.35), (3.0, 1.5, 1.0, 1.1), strict=True):
            mm, times = settled * rng.uniform(0.5, 1.5, (8, 3)), stay * rng.uniform(0.5, 1.5, (8, 3))
            if name == "slow":
                mm[2, 1], times[2, 1] = 7.7, np.inf
                mm[5, 0] = times[5, 0] = np.nan
            found[variant, name] = outcome(mm, times, cycle=5.0 * stay)
    return found


@pytest.fixture(scope="module")
def evaluation(outcomes):
    return summarise(ARM.name, FAMILY, MEANINGS, pool(dict(NAMES), outcomes), {"p"})


def test_the_result_on_disk_is_the_result(outcomes, evaluation, tmp_path):
    trials = [
        Trials(where=where, contestant=one, drive=lambda _, at=(where, one.name): outcomes[at], identity="")
        for where in MEANINGS
        for one in CONTESTANTS
    ]
    made = conclude(ARM, MEANINGS, trials, FAMILY, tmp_path / "evaluation.json", lambda *_: None)
    assert made == evaluation == read_json(tmp_path / "evaluation.json", Evaluation)
