"""The page of an evaluation shows the numbers of its result, each in its own places, and draws the outcomes."""

import dataclasses

import numpy as np
import pytest
from evaluation_samples import outcome
from markupsafe import Markup

from readpage import Page
from rejoint.arms import mycobot280
from rejoint.control.classical import IntegratorController
from rejoint.control.comparison.result import Protocol
from rejoint.research.evaluation import page
from rejoint.research.evaluation.contestants import Contestant
from rejoint.research.evaluation.evaluate import conclude
from rejoint.research.evaluation.family import ArmFamily
from rejoint.research.evaluation.summary import Evaluation, pool, summarise
from rejoint.research.evaluation.trials import TrialSettings
from rejoint.system.files import read_json
from rejoint.system.statistics import Estimate

ARM = mycobot280()
SETTINGS = TrialSettings(family=ArmFamily(arms=8, targets=3), protocol=Protocol())
MEANINGS = {"worn": "worn arms", "payload": "worn arms with a load"}
NAMES = (("slow", "slow"), ("fast", "fast"), ("p #0", "p"), ("p #1", "p"))
CONTESTANTS = [
    Contestant(name=name, group=group, make=IntegratorController, identity=name, learned=group == "p")
    for name, group in NAMES
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
    return summarise(ARM, SETTINGS, CONTESTANTS, MEANINGS, outcomes)


@pytest.fixture
def show(outcomes, tmp_path, monkeypatch):
    """Makes the page of an evaluation; figures are kept in ``show.figures`` instead of being drawn."""
    pooled = pool(CONTESTANTS, MEANINGS, outcomes)

    def keep(figure, key, alt):
        make.figures[key] = figure
        return Markup("<svg aria-label='a figure'></svg>")

    def make(evaluation):
        make.figures = {}
        page.write_page(tmp_path / "evaluation.html", evaluation, pooled)
        return Page(tmp_path / "evaluation.html")

    monkeypatch.setattr(page, "inline_svg", keep)
    return make


def test_the_result_on_disk_is_the_result(outcomes, evaluation, tmp_path):
    made = conclude(ARM, SETTINGS, CONTESTANTS, MEANINGS, outcomes, tmp_path)
    assert made == evaluation == read_json(tmp_path / "evaluation.json", Evaluation)


@pytest.mark.parametrize(
    ("ratio", "settled", "words"),
    [
        (Estimate(0.5, 0.4, 0.6), Estimate(-1e-3, -2e-3, -0.5e-3), ("mm sooner than fast (median ratio 0.50)",
                                                                   "settles nearer (-1.00 mm)")),
        (Estimate(2.0, 1.1, 3.0), Estimate(1e-3, 0.5e-3, 2e-3), ("mm later than fast (median ratio 2.00)",
                                                                "settles farther off (+1.00 mm)")),
        (Estimate(0.9, 0.8, 1.0), Estimate(1e-3, 0.0, 2e-3), ("neither clearly sooner nor later",
                                                              "neither nearer nor farther off")),
        (Estimate(0.5, None, None), Estimate(1e-3, None, None), ("neither clearly sooner nor later",
                                                                 "neither nearer nor farther off")),
        (Estimate(100.0, 50.0, 100.0), Estimate(1e-3, 0.5e-3, 2e-3), ("(mostly it never stays there)", "farther")),
    ],
)  # fmt: skip
def test_the_verdict_goes_by_the_whole_interval(show, evaluation, ratio, settled, words):
    pairs = tuple(
        dataclasses.replace(pair, stay_ratio=(*pair.stay_ratio[:-1], ratio), settled=settled)
        for pair in evaluation.pairs
    )
    verdict = show(dataclasses.replace(evaluation, pairs=pairs)).places["verdict / p 1"]
    assert verdict.startswith("Worn arms: p is within 2 mm")
    for part in words:
        assert part in verdict
