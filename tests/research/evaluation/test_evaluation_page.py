"""The page of an evaluation shows the numbers of its result, each in its own places, and draws the outcomes."""

import numpy as np
import pytest
from evaluation_samples import outcome
from markupsafe import Markup

from readpage import Page
from rejoint.arms import mycobot280
from rejoint.control.comparison.result import Protocol
from rejoint.system.files import read_json
from rejoint_lab.research.evaluation import summary
from rejoint_lab.research.evaluation.evaluate import Contestant, conclude
from rejoint_lab.research.evaluation.family import ArmFamily
from rejoint_lab.research.evaluation.summary import Evaluation, pool, summarise
from rejoint_lab.research.evaluation.trials import TrialSettings

ARM = mycobot280()
SETTINGS = TrialSettings(family=ArmFamily(arms=8, targets=3), protocol=Protocol())
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
    return summarise(ARM.name, SETTINGS, MEANINGS, pool(dict(NAMES), outcomes), {"p"})


@pytest.fixture
def show(outcomes, tmp_path, monkeypatch):
    """Makes the page of an evaluation; figures are kept in ``show.figures`` instead of being drawn."""
    pooled = pool(dict(NAMES), outcomes)

    def keep(figure, key, alt):
        make.figures[key] = figure
        return Markup("<svg aria-label='a figure'></svg>")

    def make(evaluation):
        make.figures = {}
        summary.write_page(tmp_path / "evaluation.html", evaluation, pooled)
        return Page(tmp_path / "evaluation.html")

    monkeypatch.setattr(summary, "inline_svg", keep)
    return make


def test_the_result_on_disk_is_the_result(outcomes, evaluation, tmp_path):
    made = conclude(ARM, SETTINGS, CONTESTANTS, MEANINGS, outcomes, tmp_path)
    assert made == evaluation == read_json(tmp_path / "evaluation.json", Evaluation)


def test_the_page_shows_every_controller_its_pairs_and_the_best_rival(show, evaluation):
    page = show(evaluation)
    text = " ".join(map(str, page.places.values()))
    for shown in ("slow", "fast", "2 training seeds", "best rival"):
        assert shown in text
    assert evaluation.best == {"worn": "fast", "payload": "fast"}
