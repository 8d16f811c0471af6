"""A race ends when it is decided, is honest however often one looks, and says whom it stopped."""

import json
from dataclasses import replace
from math import comb

import numpy as np
import pytest
from test_compare import ARM, PROTOCOL, SaggingRobot, factories

import rejoint
from rejoint.control.catalogue import ON_REQUEST, contenders
from rejoint.control.comparison import racing
from rejoint.control.comparison.compare import Settings, compare
from rejoint.control.comparison.elimination import MISSES
from rejoint.control.comparison.failure import failure
from rejoint.control.comparison.ledger import Ledger
from rejoint.control.comparison.racing import Race, Results, fewest, next_out, preferences, stake
from rejoint.control.comparison.recommend import recommend
from rejoint.control.comparison.result import Comparison
from rejoint.control.comparison.targets import draw_targets
from rejoint.control.default import DefaultController
from rejoint.control.integrator import IntegratorController
from rejoint.control.loop import Schedule, run
from rejoint.logs.runfolder.effort import read_effort
from rejoint.logs.runlog import write_log
from rejoint.pages.report.tables import comparison_table, comparison_view
from rejoint.runs.openloop import trials
from rejoint.runs.run import Run
from rejoint.runs.stages.compare import comparison_job
from rejoint.system.errors import InputError, NoReplyError
from rejoint.system.files import read_json, write_json

RACE = Race()
TARGETS = draw_targets(ARM, sets=2, count=10, seed=1)
QUICK = replace(PROTOCOL, hold=1.5, window=0.3)
SETTLING = replace(QUICK, hold=3.0)
"""Long enough for an integrator to come to rest"""


class Beside(IntegratorController):
    """An integrator that reaches every target and comes to rest three millimetres beside it."""

    def command(self, inputs):
        return super().command(replace(inputs, target=inputs.target + np.array([0.0, 0.0, 0.003])))


def results(settled, stay=None, crossed=None):
    settled = np.array(settled, dtype=float)
    return Results(
        settled=settled, stay=np.ones_like(settled) if stay is None else np.array(stay, dtype=float),
        crossed=np.ones_like(settled) if crossed is None else np.array(crossed, dtype=float),
    )  # fmt: skip


def race(controllers, targets=TARGETS, *, measured=(), ledger=None, on_trial=None, protocol=QUICK):
    order = []

    def note(trial):
        order.append((trial.controller, trial.kind, trial.target_set, trial.first))
        if on_trial is not None:
            on_trial(trial)

    arm = SaggingRobot(1, 0)
    found = compare(
        lambda *_: arm, controllers, targets, Settings(batched=False, protocol=protocol, race=RACE),
        on_trial=note, measured=measured, source="the diagnosis", ledger=ledger,
    )  # fmt: skip
    return found, order


def test_a_target_is_judged_in_the_order_of_the_recommendation():
    ours = results(
        [0.001, 0.001, 0.002, 0.0010, 0.001, np.nan, 0.001], [1, 1, 1, 1.0, np.inf, 1, 1], [1, 0, 1, 1, 1, 1, 1]
    )
    theirs = results(
        [0.009, 0.009, 0.001, 0.0012, 0.001, 0.001, 0.001], [1, 1, 1, 2.0, np.inf, 1, 1.1], [0, 1, 1, 1, 1, 1, 1]
    )
    judged = preferences(ours, theirs, RACE)
    assert judged[:5].tolist() == [1, -1, -1, 1, 0], "reached, reached, nearer, sooner, no difference that matters"
    assert np.isnan(judged[5])
    assert judged[6] == 0
    np.testing.assert_array_equal(preferences(theirs, ours, RACE), -judged)


@pytest.mark.parametrize("lead", [0.0, RACE.lead, 0.8])
@pytest.mark.parametrize("even", [0.0, 0.15])
def test_nothing_is_won_in_the_mean_while_the_claim_holds(lead, even):
    """The stakes after n targets, weighted by their chances, are 1: what makes looking at any time honest."""
    chances = np.array([(1.0 - even - lead) / 2.0, even, (1.0 - even + lead) / 2.0])  # against the claim, even, for it
    for n in (1, 2, 7):
        counts = [(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]
        ways = [comb(n, i) * comb(n - i, j) for i, j, _ in counts]
        weights = ways * np.prod(chances ** np.array(counts), axis=1)
        assert weights.sum() == pytest.approx(1.0)
        assert weights @ [stake(*count, lead) for count in counts] == pytest.approx(1.0, rel=1e-3)


def test_a_stake_is_the_mean_over_all_bets_by_the_arcsine_law():
    p = np.sin(np.pi / 4 * (1.0 + (np.arange(200_000) + 0.5) / 200_000)) ** 2
    for wins, losses in ((0, 0), (5, 0), (8, 1), (3, 9), (20, 20)):
        assert stake(wins, 7, losses) == pytest.approx(((2 * p) ** wins * (2 - 2 * p) ** losses).mean(), rel=1e-2)
    assert stake(0, 9, 0, 0.5) == pytest.approx(stake(9, 0, 0)), "nothing that matters speaks against a lead by half"


def outs(settled, counts):
    """Race controllers called by letters, simplest first, by ``settled`` (n, N) [m]; returns who was out, and why."""
    field = "abcdef"[: len(settled)]
    left, found = dict(zip(field, settled, strict=True)), {}
    for count in counts:
        while len(left) > 1:
            out = next_out({name: results(row[:count]) for name, row in left.items()}, field, RACE)
            if out is None:
                break
            del left[out.controller]
            found[out.controller] = out.why
    return found


def test_equal_controllers_are_hardly_ever_called_beaten_however_often_one_looks():
    """Four equal ones, looked at every five of sixty targets: each is the best one, and has its promise.

    That three of them are needless is right, and ends the race.
    """
    rng, races, beaten, needless = np.random.default_rng(5), 200, dict.fromkeys("abcd", 0), 0
    for _ in range(races):
        for name, why in outs(rng.lognormal(-7.0, 1.0, (4, 60)), range(5, 61, 5)).items():
            beaten[name] += why.startswith(racing.WAS_BEATEN)
            needless += why.startswith(racing.NO_BETTER)
    assert max(beaten.values()) / races <= RACE.error, beaten
    assert needless / races > 1.0, "a race that stops nobody would pass as well"


def test_who_leads_by_what_matters_is_hardly_ever_passed_over_for_a_simpler_one():
    """The last of three leads both others by just what matters; looked at after every third of sixty targets."""
    rng, races, passed, won = np.random.default_rng(8), 200, 0, 0
    for _ in range(races):
        best = np.where(rng.random(60) < (1.0 + RACE.lead) / 2.0, 1e-3, 5e-3)
        found = outs([*(3e-3 + rng.normal(0.0, 1e-4, (2, 60))), best], range(5, 61, 3))
        passed += "c" in found
        won += len(found) == 2 and "c" not in found
    assert passed / races <= RACE.error
    assert won / races > 0.8, "a race that stops nobody would pass as well"


def test_the_best_one_is_found_with_few_targets():
    rng, counts = np.random.default_rng(6), []
    for _ in range(100):
        best, other = rng.lognormal(-8.0, 0.3, 40), rng.lognormal(-6.5, 0.3, 40)
        counts.append(
            next(n for n in range(1, 41) if next_out({"a": results(other[:n]), "b": results(best[:n])}, "ab", RACE))
        )
        assert next_out({"a": results(other), "b": results(best)}, "ab", RACE).controller == "a"
    assert np.median(counts) <= 10


def test_a_difference_that_does_not_matter_ends_the_race_and_the_simpler_one_is_left():
    rng = np.random.default_rng(7)
    simple = rng.lognormal(-7.5, 0.2, 10)
    close = {"a": results(simple), "b": results(simple - 0.2 * RACE.nearer)}
    assert next_out({n: results(one.settled[:5]) for n, one in close.items()}, "ab", RACE) is None
    assert next_out(close, "ab", RACE).why == "is hardly better than a (worse at 0 of 10 targets, better at 0)"
    assert next_out(close, "ba", RACE).controller == "a", "whichever is the simpler one"
    clear = {"a": results(simple), "b": results(simple - 0.9 * RACE.nearer, stay=np.full(10, 0.5))}
    assert next_out(clear, "ab", RACE).controller == "a", "nearer by too little, but sooner"


def test_who_loses_to_several_is_out_sooner_than_who_loses_to_one():
    bad, good = np.full(6, 1e-2), np.full(6, 1e-3)
    lone = {name: results(good if name == "d" else bad) for name in "abcd"}
    many = {name: results(bad if name == "a" else good) for name in "abcd"}
    assert next_out(lone, "abcd", RACE) is None or next_out(lone, "abcd", RACE).controller != "a"
    assert next_out(many, "abcd", RACE).controller == "a"


def test_nobody_is_looked_at_before_anybody_can_be_out():
    count = fewest(RACE)
    assert count >= RACE.least
    for size, expected in ((count, "a"), (count - 1, None)):
        clear = {"a": results(np.full(size, 1e-2)), "b": results(np.full(size, 1e-3))}
        out = next_out(clear, "ab", RACE)
        assert (out and out.controller) == expected


def test_a_beaten_one_is_stopped_and_the_others_too_once_it_is_decided():
    found, order = race({"default": Beside, "integrator": IntegratorController}, protocol=SETTLING)
    row = found.row("default")
    count = fewest(RACE)
    assert row.out == f"was beaten by integrator (worse at {count} of {count} targets, better at 0)"
    assert failure(row).startswith("default was beaten by integrator (")
    assert (row.held, found.row("integrator").held) == (count, count)
    assert len(found.targets) == 1, "the second set was not needed"
    assert (found.most, found.race) == ((2, 1), RACE)
    assert {entry[1:] for entry in order} == {("hold", 0, 0)}
    advice = recommend(found)
    assert (advice.controller, advice.tied) == ("integrator", ())
    assert failure(row) in advice.why


def test_where_nothing_that_matters_is_between_two_the_simpler_is_recommended():
    found, order = race(dict.fromkeys(("integrator", "policy"), IntegratorController))
    row = found.row("policy")
    assert row.needless
    assert row.out.startswith("is hardly better than integrator (")
    advice = recommend(found)
    assert (advice.controller, advice.tied) == ("integrator", ("policy",))
    assert failure(row) in advice.why
    blocks = sorted({entry[2:] for entry in order})
    assert blocks[:2] == [(0, 0), (0, fewest(RACE))]
    for block in blocks:
        turn = [entry[0] for entry in order if entry[2:] == block]
        assert sorted(turn) == ["integrator", "policy"], "the same targets for all, in turns"


@pytest.fixture(scope="module")
def undecided():
    """Return a race of three alike, made as if nobody had been stopped: settled errors and times are filled in."""
    found, _ = race(dict.fromkeys(("integrator", "policy", "predictive"), IntegratorController), TARGETS[:1])

    def filled(stays, wider=None):
        rows = []
        for row, *both in zip(found.rows, stays, wider or stays, strict=True):
            narrow = int(np.argmin(row.outcomes.within))
            stay = tuple(tuple(both[i != narrow]) for i in range(len(row.outcomes.within)))
            same = {"crossed": (1.0,) * 10, "settled": (1e-3,) * 10, "stay": stay}
            rows.append(replace(row, out="", outcomes=replace(row.outcomes, **same)))
        return replace(found, rows=tuple(rows))

    return filled


def test_of_those_left_undecided_the_simplest_is_recommended_that_nobody_leads_by_a_quarter(undecided):
    slow, soon = [2.0] * 10, [1.0] * 10
    advice = recommend(undecided([slow, soon, soon]))
    assert (advice.controller, advice.tied) == ("policy", ("predictive",))
    assert "integrator: likely not as good as policy (worse at 10 of 10 targets, better at 0)." in advice.why
    even = [1.0] * 2 + [2.0] * 8
    advice = recommend(undecided([slow, even, even]))
    assert (advice.controller, advice.tied) == ("integrator", ("policy", "predictive")), "two of ten are no quarter"
    three = [1.0] * 3 + [2.0] * 7
    assert recommend(undecided([slow, slow, three])).controller == "predictive", "three are"
    advice = recommend(undecided([slow, even, three]))
    assert (advice.controller, advice.tied) == ("policy", ("predictive",)), "which nobody leads by as much"
    round_ = undecided([[1, 2, 3] * 3 + [2], [2, 3, 1] * 3 + [2], [3, 1, 2] * 3 + [2]])
    assert recommend(round_).controller == "integrator", "each leads another: a tie, by intervals"


def test_where_the_narrowest_distance_leaves_a_tie_the_wider_ones_decide(undecided):
    """An arm that trembles by two millimetres comes to stay there by chance, and may yet be near much sooner."""
    early, late = [3.0, 4.0] * 5, [4.0, 3.0] * 5
    advice = recommend(undecided([early, late, early], wider=[[1.0] * 10, [0.4] * 10, [0.4] * 10]))
    assert (advice.controller, advice.tied) == ("policy", ("predictive",))
    said = "integrator: likely not as good as policy by the time to stay within 5 mm (worse at 10 of 10 targets"
    assert any(line.startswith(said) for line in advice.why)
    near = recommend(undecided([early, late, early], wider=[[0.55] * 10, [0.4] * 10, [0.4] * 10]))
    assert near.controller == "integrator", "nobody sees a difference of 0.15 s"
    first = recommend(undecided([[1.0] * 10, [2.0] * 10, [2.0] * 10], wider=[[1.0] * 10, [0.4] * 10, [0.4] * 10]))
    assert first.controller == "integrator", "the narrowest counts first"


def test_a_race_reads_from_its_holds_when_targets_are_crossed():
    raced, _ = race(factories("integrator"), TARGETS[:1], protocol=SETTLING)
    whole = compare(
        SaggingRobot, factories("integrator"), TARGETS[:1], Settings(batched=True, protocol=SETTLING)
    ).row("integrator")  # fmt: skip
    row = raced.row("integrator")
    assert row.held == fewest(RACE)
    assert row.crossing.success.value == whole.crossing.success.value == 1.0
    time = np.array(row.outcomes.crossing_time[: row.held], dtype=float)
    assert row.crossing.cycle_time.mean.value == pytest.approx(10 * time.mean()), "of all ten, by those driven to"
    assert row.crossing.cycle_time.mean.value == pytest.approx(whole.crossing.cycle_time.mean.value, rel=0.2)


def test_three_misses_in_a_row_end_it_within_a_hold():
    found, order = race(factories("default", "integrator"))
    (only,) = [entry for entry in order if entry[0] == "default"]
    assert only[1:] == ("hold", 0, 0)
    assert found.row("default").out.startswith(f"missed {MISSES} targets in a row (")
    assert found.row("default").held == MISSES
    assert recommend(found).controller == "integrator"
    found, _ = race(factories("default", "integrator"), TARGETS[:, :MISSES])
    assert found.row("integrator").held >= RACE.least, "who is left has enough targets for an interval"


def test_what_was_measured_open_loop_is_not_driven_again():
    log = run(SaggingRobot(1, 3), DefaultController(ARM), TARGETS[:1], Schedule(dwell=QUICK.hold)).log(0, "targets")
    before = trials(ARM, log, QUICK)
    np.testing.assert_array_equal(before.targets, TARGETS[0])
    found, order = race(factories("default", "integrator"), measured=(before.driven,))
    row = found.row("default")
    assert {entry[0] for entry in order} == {"integrator"}
    assert (row.source, row.held) == ("the diagnosis", 10)
    whole = compare(
        SaggingRobot, factories("default"), TARGETS[:1], Settings(batched=True, protocol=QUICK, seed=3)
    ).row("default")  # fmt: skip
    assert row.hold.settled.mean.value == pytest.approx(whole.hold.settled.mean.value, rel=0.02)
    assert row.outcomes.crossed == whole.outcomes.crossed
    assert row.crossing.cycle_time is None, "nobody waited until the targets were given up"
    assert trials(ARM, log, replace(QUICK, hold=3.0)) is None, "held shorter than that"


def test_a_real_arm_races_and_goes_on_from_its_diagnosis(tmp_path):
    """Whoever opened it. The table says who was not driven again, who was stopped, and how many targets each had."""
    log = run(SaggingRobot(1, 3), DefaultController(ARM), TARGETS[:1], Schedule(dwell=QUICK.hold)).log(0, "targets")
    about = Run.create(tmp_path / "run", SaggingRobot.address, ARM, seed=2)
    write_log(about.folder.log("targets"), log)
    found = rejoint.compare(SaggingRobot(1, 0), run=about, protocol=QUICK).comparison
    assert found.controllers == ("default", "integrator", "feedforward", "shelf"), "the paper's PIDs only on request"
    assert (found.race, found.most) == (RACE, (1, 1))
    np.testing.assert_array_equal(found.targets[0], TARGETS[0])
    assert about.comparison == found
    assert about.folder.log("hold/default/0/0").exists(), "for the figures"
    (spent,) = read_effort(about.folder).stages
    assert spent.name == "compare"
    assert spent.moving > sum(row.held for row in found.rows if not row.source) * QUICK.hold
    _, rows = comparison_table(found)
    assert rows[0][0] == "default (by diagnosis)"
    assert rows[0][-1] == "stopped: missed 3 targets in a row"
    view = comparison_view(found, "integrator")
    assert "measured by the diagnosis" in view.rows[0].cells[0].note
    assert [row.cells[4].note.splitlines()[-1] for row in view.rows] == [f"{row.held} targets" for row in found.rows]
    assert "in a race of at most 10 targets" in view.notes[0]
    assert any(note.startswith("Race: ") and "In 5 % of such races" in note for note in view.notes)
    other = rejoint.compare(SaggingRobot(1, 0), ["default"], TARGETS[1, :3], run=about, protocol=QUICK).comparison
    assert other.rows[0].source == "", "at other targets it is driven"
    full = rejoint.compare(SaggingRobot(1, 0), ["integrator"], TARGETS[0, :2], full=True, protocol=QUICK).comparison
    assert (full.race, full.most, full.rows[0].source) == (None, None, "")


def test_a_real_arm_is_driven_with_the_policy_from_the_shelf_until_it_has_its_own():
    real = contenders(real=True, shelf=True, policy=True, twin=True)
    assert real == ("default", "integrator", "feedforward", "policy", "predictive")
    assert "shelf" in contenders(real=True, shelf=True, policy=False, twin=True)
    assert {"shelf", "policy"} < set(contenders(real=False, shelf=True, policy=True, twin=True)), "side by side: all"


def test_the_paper_s_pids_are_driven_side_by_side_or_where_they_are_asked_for():
    known = {"shelf": True, "policy": True, "twin": True}
    assert set(contenders(real=False, **known)) - set(contenders(real=True, **known)) == {"shelf", *ON_REQUEST}
    compared, repaired = (
        list(comparison_job("emulated:worn", (), None, run=None, arm=ARM, seed=0, paper=paper).factories)
        for paper in (True, False)
    )
    assert repaired == [name for name in compared if name not in ON_REQUEST]
    assert len(compared) - len(repaired) == len(ON_REQUEST)


def test_an_interrupted_race_goes_on_where_it_was(tmp_path):
    controllers, targets = {"default": Beside, "integrator": IntegratorController}, TARGETS[:, :7]
    whole, order = race(controllers, targets)

    def fail(_trial, seen=[]):  # noqa: B006 - counts over the calls
        seen.append(1)
        if len(seen) > 3:
            raise NoReplyError("gone")

    with pytest.raises(NoReplyError):
        race(controllers, targets, ledger=Ledger.begin(tmp_path / "trials", "one"), on_trial=fail)
    again, rest = race(controllers, targets, ledger=Ledger.begin(tmp_path / "trials", "one"))
    assert rest == order[3:], "the same trials in the same order"
    assert again.controllers == whole.controllers
    assert [row.held for row in again.rows] == [row.held for row in whole.rows]


def test_a_raced_comparison_survives_its_file_and_older_ones_are_read(tmp_path):
    found, _ = race({"default": Beside, "integrator": IntegratorController}, TARGETS[:1, :5])
    write_json(tmp_path / "new.json", found)
    assert read_json(tmp_path / "new.json", Comparison) == found
    data = json.loads((tmp_path / "new.json").read_text())
    del data["race"], data["most"]
    for row in data["rows"]:
        del row["source"]
    (tmp_path / "old.json").write_text(json.dumps(data))
    old = read_json(tmp_path / "old.json", Comparison)
    assert (old.race, old.most, old.rows[0].source) == (None, None, "")


def test_arms_side_by_side_do_not_race():
    with pytest.raises(InputError, match="do not race"):
        Settings(batched=True, race=RACE)
    with pytest.raises(InputError, match="error between 0 and 1"):
        racing.Race(error=0.0)
