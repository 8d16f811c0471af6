"""The page of an evaluation shows the numbers of its result, each in its own places, and draws the outcomes."""

import dataclasses

import numpy as np
import pytest
from evaluation_samples import outcome
from markupsafe import Markup

from readpage import Page, changed, put, rounds
from rejoint.arms import mycobot280
from rejoint.control.comparison.result import Protocol
from rejoint.control.integrator import IntegratorController
from rejoint.research.evaluation import page
from rejoint.research.evaluation.contestants import Contestant
from rejoint.research.evaluation.evaluate import conclude
from rejoint.research.evaluation.family import ArmFamily
from rejoint.research.evaluation.result import Evaluation
from rejoint.research.evaluation.summary import summarise
from rejoint.research.evaluation.tables import HEADERS, pair_headers, terminal_tables
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
    pooled = {(v, g): [outcomes[v, n] for n, group in NAMES if group == g] for v in MEANINGS for _, g in NAMES}

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


def table_of(variant, controller):
    """Places of one controller's cells, in the order of `HEADERS`."""
    return [f"{variant} / 8 {MEANINGS[variant]} / {controller} / {header}" for header in HEADERS]


def has(text, *ends):
    """Small print is the two ends of an interval."""
    return all(rounds(word, end) for word, end in zip(text.split(" to "), ends, strict=True))


def test_every_row_is_on_the_page_with_its_intervals(show, evaluation):
    places = show(evaluation).places
    assert len(evaluation.rows) == 6
    for row in evaluation.rows:
        settled, p95, outside, true, shake, stays, ten = table_of(row.variant, row.controller)
        assert rounds(places[settled], 1e3 * row.settled.value)
        assert has(places[f"{settled} / small"], 1e3 * row.settled.low, 1e3 * row.settled.high)
        assert rounds(places[p95], 1e3 * row.settled_p95)
        assert rounds(places[outside], 100 * row.outside.value)
        assert has(places[f"{outside} / small"], 100 * row.outside.low, 100 * row.outside.high)
        assert rounds(places[true], 1e3 * row.settled_true.value)
        assert rounds(places[f"{true} / small"].removeprefix("95 %: "), 1e3 * row.true_p95)
        assert rounds(places[shake], row.oscillation)
        for text, one in zip(places[stays].split(" / "), row.within, strict=True):
            assert rounds(text, one.median)
        for text, one in zip(places[f"{stays} / small"].removesuffix(" %").split(" / "), row.within, strict=True):
            assert rounds(text, 100 * one.share.value)
        assert rounds(places[ten], row.cycle_time.value)
        assert rounds(places[f"{ten} / small"].removesuffix(" % reached"), 100 * row.success.value)


def test_the_terminal_prints_the_cells_of_the_page(show, evaluation):
    places, tables = show(evaluation).places, terminal_tables(evaluation)
    assert len(tables) == 3
    for variant, (_, headers, rows) in zip(MEANINGS, tables, strict=False):
        assert headers == ["controller", *HEADERS]
        for controller, *cells in rows:
            assert cells == [places[place] for place in table_of(variant, controller)]
    assert [row[:2] for row in tables[2][2]] == [["worn", "p against fast"], ["payload", "p against fast"]]


PAIRS = "Paired differences: the same arm, the same target; 95 % intervals resample arms"


def test_pairs_are_on_the_page_with_their_intervals(show, evaluation):
    places = show(evaluation).places
    headers = pair_headers(evaluation)
    assert headers[2:5] == tuple(f"time to stay within {mm} mm, ratio" for mm in (10, 5, 2))
    for pair in evaluation.pairs:
        cell = f"{pair.variant} / {PAIRS} / {pair.controller} against {pair.rival} / "
        values = (pair.settled, pair.settled_true, *pair.stay_ratio, pair.cycle_time)
        for header, value, factor in zip(headers, values, (1e3, 1e3, 1.0, 1.0, 1.0, 1.0), strict=True):
            assert rounds(places[cell + header], factor * value.value)
            if value.low == value.high:
                continue
            assert has(places[f"{cell}{header} / small"], factor * value.low, factor * value.high)


@pytest.mark.parametrize(
    ("path", "new", "column", "words"),
    [
        ("settled.value", 0.777e-3, (0, ""), "0.777"),
        ("settled.low", 0.111e-3, (0, " / small"), "0.11"),
        ("settled_p95", 8.88e-3, (1, ""), "8.88"),
        ("outside.value", 0.33, (2, ""), "33"),
        ("outside.high", 0.77, (2, " / small"), " to 77"),
        ("settled_true.value", 6.6e-3, (3, ""), "6.6"),
        ("true_p95", 9.9e-3, (3, " / small"), "95 %: 9.9"),
        ("oscillation", 0.44e-3, (4, ""), "0.44"),
        ("within.1.median", 7.7, (5, ""), " / 7.7 / "),
        ("within.1.share.value", 0.77, (5, " / small"), " / 77 / "),
        ("cycle_time.value", 77.7, (6, ""), "77.7"),
        ("success.value", 0.888, (6, " / small"), "88.8 % reached"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_number_of_a_row_stands_in_its_own_cell_and_nowhere_else(show, evaluation, path, new, column, words):
    for number, (variant, controller) in ((0, ("worn", "slow")), (5, ("payload", "p"))):
        found = changed(show(evaluation), show(put(evaluation, f"rows.{number}.{path}", new)))
        (place,) = found
        assert place == table_of(variant, controller)[column[0]] + column[1]
        assert words in found[place]


def test_a_difference_of_a_pair_stands_in_its_cell_and_in_the_verdict_where_the_rival_is_the_best(show, evaluation):
    before = show(evaluation)
    for number, pair in enumerate(evaluation.pairs):
        found = changed(before, show(put(evaluation, f"pairs.{number}.settled", Estimate(-3.3e-3, -4.4e-3, -2.2e-3))))
        cell = f"{pair.variant} / {PAIRS} / p against {pair.rival} / settled, encoders [mm]"
        verdict = {f"verdict / p {1 + (pair.variant == 'payload')}"} if pair.rival == "fast" else set()
        assert found.keys() == {cell, f"{cell} / small", *verdict}
        assert (found[cell], found[f"{cell} / small"]) == ("-3.3", "-4.4 to -2.2")
        assert all("settles nearer (-3.30 mm)" in found[place] for place in verdict)


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


def test_without_a_policy_the_verdict_says_so(show, evaluation):
    assert show(dataclasses.replace(evaluation, pairs=())).places["verdict / p 1"] == "No learned policy took part."


def test_failures_are_counted_and_told_one_by_one(show, evaluation):
    found = show(evaluation)
    assert len(evaluation.failures) == 4
    summary = "failures / Holds that ended farther than 5 mm from their target, or that the guard stopped"
    assert found.places[f"{summary} / payload / holds"] == found.places[f"{summary} / worn / holds"] == "2"
    cells = [row for row in found.rows if len(row) == 5 and row[0] == "worn"]
    assert [row[1:4] for row in cells] == [
        ["slow", "10002, 1 | (0, 0, 0) mm", "7.7, 14.7"], ["slow", "10005, 0 | (0, 0, 0) mm", "-"]
    ]  # fmt: skip
    assert "No hold failed." in show(dataclasses.replace(evaluation, failures=())).words


def test_the_figures_draw_the_share_of_holds_that_are_better(show, evaluation, outcomes):
    show(evaluation)
    assert set(show.figures) == {f"{variant}-{what}" for variant in MEANINGS for what in ("settled", "stay")}
    for variant in MEANINGS:
        values = {
            "settled": lambda one: np.where(np.isnan(one.settled), np.inf, 1e3 * one.settled),
            "stay": lambda one: np.where(np.isnan(one.stay[..., -1]), np.inf, one.stay[..., -1]),
        }
        for what, of in values.items():
            lines = {line.get_label(): line for line in show.figures[f"{variant}-{what}"].axes[0].lines}
            assert set(lines) == {"slow", "fast", "p"}
            for group, line in lines.items():
                pooled = np.concatenate([of(outcomes[variant, n]).ravel() for n, g in NAMES if g == group])
                np.testing.assert_array_equal(line.get_xdata(), np.sort(pooled))
                better = [100 * np.mean(pooled <= x) for x in line.get_xdata()[np.isfinite(line.get_xdata())]]
                np.testing.assert_allclose(line.get_ydata()[: len(better)], better)
