import dataclasses
import json

import cloudpickle
import numpy as np
import pytest
from evaluation_samples import outcome

from rejoint.arms import mycobot280
from rejoint.control.comparison.result import Protocol
from rejoint.control.integrator import IntegratorController
from rejoint.research.evaluation.contestants import Contestant, check_names, classical
from rejoint.research.evaluation.evaluate import evaluate, outcome_path
from rejoint.research.evaluation.family import (
    VARIANTS,
    ArmFamily,
    family_payloads,
    family_targets,
    family_wears,
    find_variant,
    open_family,
)
from rejoint.research.evaluation.outcome import Outcome, read_outcome, write_outcome
from rejoint.research.evaluation.summary import summarise
from rejoint.research.evaluation.tables import terminal_tables
from rejoint.research.evaluation.trials import TrialSettings, try_controller
from rejoint.system.errors import InputError

ARM = mycobot280()
SETTINGS = TrialSettings(family=ArmFamily(arms=3, targets=2), protocol=Protocol())


def test_an_arm_of_a_family_does_not_depend_on_how_many_there_are():
    few, many = ArmFamily(arms=2), ArmFamily(arms=5)
    worn = find_variant("worn")
    for a, b in zip(family_wears(ARM, worn, few), family_wears(ARM, worn, many), strict=False):
        np.testing.assert_array_equal(a.position_gain, b.position_gain)
    np.testing.assert_array_equal(family_targets(ARM, few, 3), family_targets(ARM, many, 3)[:2])
    loads = family_payloads(find_variant("payload"), many)
    np.testing.assert_array_equal(family_payloads(find_variant("payload"), few), loads[:2])
    assert (loads > 0).all()
    assert (loads < 0.25).all()


def test_families_share_no_arm():
    seeds = [{ArmFamily(arms=10_000, seed=s).wear_seed(i) for i in range(10_000)} for s in range(3)]
    assert not (seeds[0] & seeds[1]) | (seeds[1] & seeds[2]) | (seeds[0] & seeds[2])


def test_variants_differ_in_what_they_say():
    robots, family = {v.name: open_family(ARM, v, ArmFamily(arms=2)) for v in VARIANTS}, ArmFamily(arms=2)
    seen = {v.name: np.array([wear.play_in_loop for wear in family_wears(ARM, v, family)]) for v in VARIANTS}
    assert seen["play-in-loop"].all()
    assert not seen["worn"].any()
    assert (robots["healthy"].plant.torque_limit > 1.0).all()
    mass = robots["payload"].plant.batch.expand("body_mass")[:, -1] - ARM.mass[-1]
    np.testing.assert_allclose(mass, family_payloads(find_variant("payload"), family))


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
def test_arms_of_a_variant_are_reached_over_its_wire(variant):
    robot = open_family(ARM, variant, ArmFamily(arms=40))
    command = np.tile(ARM.rest + 0.1, (40, 1))
    robot.step(command)
    first = robot.read().time
    low, high = variant.period
    assert (first >= low - 1e-3).all()
    assert (first <= high + 1e-3).all()
    assert np.ptp(first) > 0.5 * (high - low), "redrawn for every arm"
    arrived = (robot.plant.goal == command).all(axis=1)
    assert not arrived[first < variant.latency[0] - 1e-3].any()
    assert arrived[first > variant.latency[1] + 1e-3].all()
    assert arrived.any() == (variant.name != "long-latency")


@pytest.mark.parametrize(
    "wrong", [{"arms": 0}, {"arms": 10_001}, {"targets": 0}, {"crossings": 0}, {"seed": -1}], ids=str
)
def test_impossible_families_are_refused(wrong):
    with pytest.raises(InputError, match="family"):
        ArmFamily(**wrong)


def test_the_best_rival_is_the_soonest_and_not_a_policy():
    contestants = [
        Contestant(name=name, group=group, make=IntegratorController, identity=name, learned=learned)
        for name, group, learned in (("slow", "slow", False), ("fast", "fast", False), ("p #0", "p", True))
    ]
    stays = {"slow": 2.0, "fast": 1.5, "p #0": 1.0}
    outcomes = {("worn", n): outcome(np.full((3, 2), 0.3), np.full((3, 2), s)) for n, s in stays.items()}
    result = summarise(ARM, SETTINGS, contestants, {"worn": "worn arms"}, outcomes)
    assert result.best == {"worn": "fast"}
    assert {pair.rival for pair in result.pairs} == {"slow", "fast"}
    assert result.row("worn", "p").seeds == 1
    tables = terminal_tables(result)
    assert len(tables) == 2
    assert tables[1][2][0][1] == "p against fast"


def test_a_controller_that_the_guard_stops_everywhere_is_a_row_without_numbers_and_never_the_best():
    stopped = dataclasses.replace(
        outcome(np.full((3, 2), np.nan), np.full((3, 2), np.nan)), oscillation=np.full((3, 2), np.nan),
        crossed=np.zeros((3, 2)), crossing_error=np.full((3, 2), np.nan), crossing_time=np.full((3, 2), np.nan),
    )  # fmt: skip
    never = outcome(np.full((3, 2), 9.0), np.full((3, 2), np.inf))
    contestants = [Contestant(name=name, group=name, make=IntegratorController, identity=name) for name in "ab"]
    result = summarise(ARM, SETTINGS, contestants, {"worn": ""}, {("worn", "a"): stopped, ("worn", "b"): never})
    row = result.row("worn", "a")
    assert (row.settled, row.settled_p95, row.settled_true, row.true_p95, row.oscillation) == (None,) * 5
    assert (row.outside.value, row.success.value, row.cycle_time, row.crossing_error) == (1.0, 0.0, None, None)
    assert result.best == {"worn": "b"}
    assert [line[1] for line in terminal_tables(result)[0][2]] == ["not known", "9.00"]


def test_outcomes_survive_the_disk(tmp_path):
    before = outcome(np.array([[0.4, np.nan], [1.0, 2.0]]), np.array([[1.0, np.inf], [2.0, 3.0]]))
    write_outcome(tmp_path / "o.parquet", before, {"seed": 1})
    after = read_outcome(tmp_path / "o.parquet", {"seed": 1})
    for field in dataclasses.fields(Outcome):
        np.testing.assert_array_equal(getattr(after, field.name), getattr(before, field.name))
    assert read_outcome(tmp_path / "o.parquet", {"seed": 2}) is None
    assert read_outcome(tmp_path / "none.parquet", {"seed": 1}) is None
    (tmp_path / "o.parquet").write_bytes((tmp_path / "o.parquet").read_bytes()[:200])
    assert read_outcome(tmp_path / "o.parquet", {"seed": 1}) is None


def test_a_batch_of_different_arms_is_each_of_them_alone():
    protocol, none = Protocol(hold=1.5), lambda _: None
    settings = TrialSettings(family=ArmFamily(arms=3, targets=1, crossings=1), protocol=protocol, crossing=False)
    worn = find_variant("worn")
    whole = try_controller(ARM, worn, IntegratorController, settings, none)
    first = try_controller(
        ARM,
        worn,
        IntegratorController,
        dataclasses.replace(settings, family=ArmFamily(arms=1, targets=1, crossings=1)),
        none,
    )
    np.testing.assert_allclose(whole.settled[0], first.settled[0], rtol=1e-9)
    assert np.isfinite(whole.settled).all()
    assert np.isnan(whole.crossed).all()
    assert len(set(whole.settled.ravel())) == 3


def test_cells_tried_by_other_processes_give_the_same_numbers(tmp_path):
    """Cells travel as Ray lets them travel, and whoever leads tries none himself."""
    ones = [classical("integrator"), classical("tuned-integrator")]
    settings = TrialSettings(family=ArmFamily(arms=2, targets=1), protocol=Protocol(hold=1.5), crossing=False)
    tried = []

    def elsewhere(cells):
        for cell in reversed(cells):
            travelled = cloudpickle.loads(cloudpickle.dumps(cell))
            travelled.try_it()
            tried.append(cell.key)

    variants = [find_variant("worn")]
    here = evaluate(ARM, ones, variants, settings, tmp_path / "here", lambda *_: None)
    there = evaluate(ARM, ones, variants, settings, tmp_path / "there", lambda *_: None, elsewhere)
    assert there == here
    assert len(tried) == 2
    evaluate(ARM, ones, variants, settings, tmp_path / "there", lambda *_: None, elsewhere)
    assert len(tried) == 2


def test_the_same_command_takes_over_what_is_done(tmp_path):
    made = []

    def make(arm):
        made.append(arm)
        return IntegratorController(arm)

    one = Contestant(name="mine", group="mine", make=make, identity="1")
    settings = TrialSettings(family=ArmFamily(arms=2, targets=1, crossings=1), protocol=Protocol(hold=1.5, dwell=2.0))
    variants, seen = [find_variant("worn")], []
    first = evaluate(ARM, [one], variants, settings, tmp_path, lambda *report: seen.append(report))
    assert len(made) == 2  # holds and crossings
    again = evaluate(ARM, [one], variants, settings, tmp_path, lambda *_: None)
    assert len(made) == 2
    assert again == first
    evaluate(ARM, [dataclasses.replace(one, identity="2")], variants, settings, tmp_path, lambda *_: None)
    assert len(made) == 4
    assert outcome_path(tmp_path, variants[0], one).exists()
    stored = json.loads((tmp_path / "evaluation.json").read_text())
    assert stored["rows"][0]["controller"] == "mine"
    page = (tmp_path / "evaluation.html").read_text()
    assert "mine" in page
    assert "http" not in page.replace("http://www.w3.org", "")
    assert seen[0][0] == 0


def test_everyone_takes_part_once():
    with pytest.raises(InputError, match="integrator"):
        check_names([classical("integrator"), classical("integrator")])
    with pytest.raises(InputError, match="no controller is called"):
        classical("nobody")
