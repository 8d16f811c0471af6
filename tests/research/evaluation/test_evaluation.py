from dataclasses import replace

import numpy as np

from rejoint.arms import mycobot280
from rejoint.control.comparison.result import Protocol
from rejoint.control.controllers.classical import IntegratorController
from rejoint.system.files import read_json
from rejoint_lab.research.evaluation.evaluate import (
    Contestant,
    Evaluation,
    evaluate,
)
from rejoint_lab.research.evaluation.family import VARIANTS, ArmFamily, family_targets, open_family

ARM = mycobot280()


def test_an_arm_of_a_family_does_not_depend_on_how_many_there_are():
    few, many = ArmFamily(arms=2), ArmFamily(arms=5)
    np.testing.assert_array_equal(family_targets(ARM, few), family_targets(ARM, many)[:2])
    loaded = [open_family(ARM, VARIANTS["payload"], family) for family in (few, many)]
    for _ in range(5):
        some, more = (robot.step(robot.read().position) for robot in loaded)
    np.testing.assert_array_equal(some.load, more.load[:2])
    light = open_family(ARM, VARIANTS["worn"], few)
    assert (np.abs(light.read().load) < np.abs(some.load)).any(axis=1).all()


def test_families_share_no_arm():
    seeds = [set(ArmFamily(arms=10_000, seed=s).wear_seeds) for s in range(3)]
    assert not (seeds[0] & seeds[1]) | (seeds[1] & seeds[2]) | (seeds[0] & seeds[2])


def test_the_same_command_takes_over_what_is_done_and_what_lies_on_disk_is_the_result(tmp_path):
    made = []

    def make(_twins, arm):
        made.append(arm)
        return IntegratorController(arm)

    one, file = Contestant(name="mine", make=make, identity="1"), tmp_path / "evaluation.json"
    family = ArmFamily(arms=2, targets=1, crossings=1, protocol=Protocol(hold=1.5, dwell=2.0))
    variants, seen = [VARIANTS["worn"]], []
    first = evaluate(ARM, [one], variants, family, file, lambda *report: seen.append(report))
    assert len(made) == 2  # holds and crossings
    again = evaluate(ARM, [one], variants, family, file, lambda *_: None)
    assert len(made) == 2
    assert again == first == read_json(file, Evaluation)
    assert first.comparisons["worn"].controllers == ("mine",)
    assert (seen[0][0], seen[-1][0]) == (0, 1)
    held = replace(family, crossings=0)
    evaluate(ARM, [one._replace(identity="2")], variants, held, file, lambda *report: seen.append(report))
    assert len(made) == 3
    assert seen[-1] == (1, "worn: mine: hold protocol")
    assert (tmp_path / "outcomes" / "worn--mine.json").exists()
