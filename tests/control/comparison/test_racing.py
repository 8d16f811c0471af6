"""A race ends when it is decided, is honest however often one looks, and says whom it stopped."""

import json
from dataclasses import replace
from math import comb

import numpy as np
import pytest
from test_compare import ARM, PROTOCOL, SaggingRobot, factories

import rejoint
from rejoint.control.comparison import racing
from rejoint.control.comparison.compare import Settings, compare
from rejoint.control.comparison.elimination import MISSES
from rejoint.control.comparison.failure import failure
from rejoint.control.comparison.ledger import Ledger
from rejoint.control.comparison.racing import Race, Results, beaten, fewest, preferences, stake
from rejoint.control.comparison.recommend import recommend
from rejoint.control.comparison.result import Comparison
from rejoint.control.comparison.targets import draw_targets
from rejoint.control.default import DefaultController
from rejoint.control.integrator import IntegratorController
from rejoint.control.loop import Schedule, run
from rejoint.logs.runlog import write_log
from rejoint.runs.effort import read_effort
from rejoint.runs.openloop import trials
from rejoint.runs.report.tables import comparison_table, comparison_view
from rejoint.runs.run import Run
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


def test_a_stake_is_the_mean_over_all_coins_that_favour_one_side():
    p = (np.arange(200_000) + 0.5) / 400_000 + 0.5
    for wins, losses in ((0, 0), (5, 0), (8, 1), (3, 9), (20, 20)):
        assert stake(wins, losses) == pytest.approx(((2 * p) ** wins * (2 - 2 * p) ** losses).mean(), rel=1e-6)


@pytest.mark.parametrize("tossed", [1, 2, 9])
def test_a_fair_coin_wins_nothing_in_the_mean(tossed):
    """The stakes after n tosses, weighted by their chances, are 1: what makes looking at any time honest."""
    mean = sum(comb(tossed, wins) * stake(wins, tossed - wins) for wins in range(tossed + 1)) / 2**tossed
    assert mean == pytest.approx(1.0)


def test_equal_controllers_are_hardly_ever_called_beaten_however_often_one_looks():
    """Four equal ones, looked at after each of sixty targets: any is called beaten less often than 1.25 of 4 errors.

    The promise is about the best one; of four that are all the best each has it, and is beaten in 5 % at most.
    """
    rng, races, out = np.random.default_rng(5), 300, np.zeros(4)
    names = "abcd"
    for _ in range(races):
        settled = rng.lognormal(-7.0, 1.0, (4, 60))
        for count in range(5, 61, 5):
            found = beaten({n: results(row[:count]) for n, row in zip(names, settled, strict=True)}, 3, RACE)
            if found:
                out[[names.index(one.controller) for one in found]] += 1
                break
    assert (out / races <= RACE.error).all(), out
    assert out.sum() > 0, "a race that never calls anybody beaten would pass as well"


def test_the_best_one_is_found_with_few_targets():
    rng, counts = np.random.default_rng(6), []
    for _ in range(100):
        best, other = rng.lognormal(-8.0, 0.3, 40), rng.lognormal(-6.5, 0.3, 40)
        counts.append(
            next(n for n in range(1, 41) if beaten({"a": results(other[:n]), "b": results(best[:n])}, 1, RACE))
        )
        assert beaten({"a": results(other), "b": results(best)}, 1, RACE)[0].controller == "a"
    assert np.median(counts) <= 10


@pytest.mark.parametrize("rivals", [1, 2, 3, 5])
def test_nobody_is_looked_at_before_anybody_can_be_beaten(rivals):
    count = fewest(rivals, RACE)
    clear = {"a": results(np.full(count, 1e-2)), "b": results(np.full(count, 1e-3))}
    assert [one.controller for one in beaten(clear, rivals, RACE)] == ["a"]
    assert count >= RACE.least
    if count > RACE.least:
        fewer = {name: results(one.settled[:-1]) for name, one in clear.items()}
        assert beaten(fewer, rivals, RACE) == []


def test_a_beaten_one_is_stopped_and_the_others_too_once_it_is_decided():
    found, order = race({"default": Beside, "integrator": IntegratorController}, protocol=SETTLING)
    row = found.row("default")
    count = fewest(1, RACE)
    assert row.out == f"was beaten by integrator (worse at {count} of {count} targets, better at 0)"
    assert failure(row).startswith("default was beaten by integrator (")
    assert (row.held, found.row("integrator").held) == (count, count)
    assert len(found.targets) == 1, "the second set was not needed"
    assert (found.most, found.race) == ((2, 1), RACE)
    assert {entry[1:] for entry in order} == {("crossing", 0, 0), ("hold", 0, 0)}
    advice = recommend(found)
    assert (advice.controller, advice.tied) == ("integrator", ())
    assert failure(row) in advice.why


def test_where_it_is_close_all_targets_are_driven_and_the_simpler_is_recommended():
    found, order = race(dict.fromkeys(("integrator", "policy"), IntegratorController))
    assert [row.held for row in found.rows] == [20, 20]
    assert recommend(found).controller == "integrator"
    assert recommend(found).tied == ("policy",)
    blocks = sorted({entry[2:] for entry in order if entry[1] == "hold"})
    assert blocks == [(0, 0), (0, fewest(1, RACE)), (1, 0), (1, 5)]
    for block in blocks:
        turn = [entry[0] for entry in order if entry[1] == "hold" and entry[2:] == block]
        assert sorted(turn) == ["integrator", "policy"], "the same targets for all, in turns"


def test_three_misses_in_a_row_end_it_before_any_hold():
    found, order = race(factories("default", "integrator"))
    assert [entry[1] for entry in order if entry[0] == "default"] == ["crossing"]
    assert found.row("default").out.startswith(f"missed {MISSES} targets in a row (")
    assert recommend(found).controller == "integrator"
    found, _ = race(factories("default", "integrator"), TARGETS[:, :MISSES])
    assert found.row("integrator").held >= RACE.least, "who is left has enough targets for an interval"


def test_what_was_measured_open_loop_is_not_driven_again():
    log = run(SaggingRobot(1, 3), DefaultController(ARM), TARGETS[:1], Schedule(dwell=QUICK.hold)).log(0, "targets")
    before = trials(ARM, log, QUICK)
    np.testing.assert_array_equal(before.targets, TARGETS[0])
    found, order = race(factories("default", "integrator"), measured=before.driven)
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
    assert (found.race, found.most) == (RACE, (2, 1))
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
    assert "in a race of at most 20 targets" in view.notes[0]
    assert any(note.startswith("Race: ") and "in 5 % of such races" in note for note in view.notes)
    other = rejoint.compare(SaggingRobot(1, 0), ["default"], TARGETS[1, :3], run=about, protocol=QUICK).comparison
    assert other.rows[0].source == "", "at other targets it is driven"
    full = rejoint.compare(SaggingRobot(1, 0), ["integrator"], TARGETS[0, :2], full=True, protocol=QUICK).comparison
    assert (full.race, full.most, full.rows[0].source) == (None, None, "")


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
