"""Policies from the shelf: who may be driven by them, who not, and that they repair a worn arm that they never met."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from rejoint.arms import CATALOGUE, load_arm
from rejoint.control.comparison.result import Protocol
from rejoint.control.controllers.catalogue import SHELF, make_controller, shelf_arms, shelf_path, shelf_policy
from rejoint.control.controllers.policy import check_controller_period
from rejoint.robots import place_of
from rejoint.session.context import ControllerMaker
from rejoint.system.errors import ContractError
from rejoint_lab.research.evaluation.family import WORN, ArmFamily, open_family, try_on
from rejoint_lab.research.shelf import RECIPES


def test_each_is_for_an_arm_of_the_catalogue_and_has_its_recipe():
    assert {"mycobot280", "so101"} <= set(shelf_arms()) == set(RECIPES) <= set(CATALOGUE)


@pytest.mark.parametrize("name", shelf_arms())
def test_it_is_for_any_unit_of_its_build_at_every_period_of_its_wires(name):
    contract = shelf_policy(load_arm(name)).contract
    assert contract.arm == name
    assert contract.twin_digest == ""  # of no single arm
    assert contract.law.authority_floor == 0.0  # at the target an action would be noise
    for address in ("tcp://arm", "serial:///dev/arm", "emulated:worn", "feetech:///dev/arm"):
        check_controller_period(SimpleNamespace(contract=contract), np.mean(place_of(address).default_period))
    assert shelf_path(name).stat().st_size < 150e3


def test_it_takes_part_wherever_it_suits():
    arm = load_arm("mycobot280")
    assert SHELF in ControllerMaker(arm, (0.020, 0.030)).factories(())
    assert SHELF in ControllerMaker(arm, None).factories(())
    assert SHELF not in ControllerMaker(arm, (0.200, 0.200)).factories(())
    assert SHELF not in ControllerMaker(dataclasses.replace(arm, mass=1.1 * arm.mass), None).factories(())
    with pytest.raises(ContractError):
        ControllerMaker(arm, (0.200, 0.200)).factories((SHELF,))


@pytest.mark.parametrize(("name", "near", "farthest"), [("mycobot280", 1e-3, 5e-3), ("so101", 1.5e-3, 5e-3)])
def test_it_repairs_worn_arms_that_it_never_met(name, near, farthest):
    arm = load_arm(name)
    family = ArmFamily(arms=6, targets=2, crossings=0, seed=7, protocol=Protocol(hold=4.0))
    as_found, repaired = (
        try_on(arm, lambda: open_family(arm, WORN, family), lambda arm, name=name: make_controller(name, arm), family)
        for name in ("default", SHELF)
    )
    as_found, repaired = (found["settled"][:, : family.targets] for found in (as_found, repaired))
    assert np.median(as_found) > 10e-3
    assert repaired.mean() < near
    assert repaired.max() < farthest
