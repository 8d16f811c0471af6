"""What a contract holds an arm to: all that the deployed law computes with, and nothing else."""

import dataclasses

import numpy as np
import pytest

from rejoint.arms import Box, mycobot280
from rejoint.control.controllers.feedforward import CommandLaw
from rejoint.control.controllers.policy import (
    PolicyController,
    check_contract,
)
from rejoint.system.errors import ContractError
from rejoint.training.task import DEFAULT
from rejoint.training.train import policy_contract
from rejoint_lab.research.reproduction.campaign import PAPER
from standin import inputs_of, state_of

ARM = mycobot280()
COUNT, CYCLES = 24, 6

STIFFNESS = (7.0,) * 6
LAWS = {
    "ours": ("residual", dataclasses.replace(DEFAULT.task.law, stiffness=STIFFNESS)),
    "ours, patient": ("residual", dataclasses.replace(DEFAULT.task.law, stiffness=STIFFNESS, decay_start=0.05)),
    "measured": ("residual", CommandLaw()),
    "paper": (PAPER.task.layout, PAPER.task.law),
}

IDENTITY = {"name", "joint_names"}
"""Fields that no law computes with, and that are checked all the same: they say which arm it is, and which joint is
which."""

UNREAD = {"max_speed", "floor", "inertia", "encoder_step", "servo_acceleration", "servos", "keep_out"}
"""Fields that no law computes with: those of the guard, the twin and the diagnosis."""


def contract(law, layout, **changes):
    recipe = dataclasses.replace(DEFAULT, task=dataclasses.replace(DEFAULT.task, law=law, layout=layout))
    return dataclasses.replace(policy_contract(ARM, None, recipe, 0), **changes)


class Network:
    """Stands for ONNX Runtime's session of a network with one random layer."""

    def __init__(self, size):
        self.weight = np.random.default_rng(0).normal(0.0, 0.3, (size, 6))

    def run(self, _, inputs):
        return [np.tanh(inputs["observation"] @ self.weight)]


def _moved(array, amount, *place):
    changed = np.array(array)
    changed[place] += amount
    return changed


def _turned(tip):
    turn = np.eye(4)
    turn[:2, :2] = [[0.8, -0.6], [0.6, 0.8]]
    return tip @ turn


CHANGES = {
    "name": ["another"],
    "joint_names": [ARM.joint_names[::-1]],
    "offset": [_moved(ARM.offset, 0.005, 1, 2, 3), _moved(ARM.offset, 0.005, 2, 0, 3)],
    "axis": [_moved(ARM.axis, -2.0, 3, 2)],
    "tip": [_moved(ARM.tip, 0.01, 2, 3), _moved(ARM.tip, -0.02, 0, 3)],
    "lower": [ARM.lower + 1.0],
    "upper": [ARM.upper - 2.0],
    "max_speed": [0.5 * ARM.max_speed],
    "mass": [3.0 * ARM.mass, _moved(ARM.mass, 0.2, 5)],
    "com": [ARM.com + np.array([0.0, 0.02, 0.0])],
    "inertia": [2.0 * ARM.inertia],
    "rest": [ARM.rest + np.radians([10, 5, -20, 10, 5, 0]), np.radians([11, 121, 83, -15, -46, 19])],
    "targets": [Box(lower=ARM.targets.lower - 0.05, upper=ARM.targets.upper - 0.05)],
    "floor": [0.1],
    "encoder_step": [0.01],
    "servo_acceleration": [5.0],
    "servos": [("sts3215",) * 6],
    "keep_out": [(Box(lower=np.full(3, 0.1), upper=np.full(3, 0.2)),)],
}


def commands(arm, law, layout):
    """Commands (CYCLES, COUNT, 6) for random control inputs: postures anywhere between the joint limits."""
    agreed = contract(law, layout)
    controller = PolicyController(arm, Network(agreed.observation_size), agreed)
    rng, given = np.random.default_rng(5), []
    target = ARM.targets.sample(rng, (COUNT,))
    goal = rng.uniform(ARM.lower, ARM.upper, (COUNT, 6))
    everyone = np.ones(COUNT, dtype=bool)
    for cycle in range(CYCLES):
        position, sent = rng.uniform(ARM.lower, ARM.upper, (2, COUNT, 6))
        near = rng.random(COUNT) < 0.3
        sent[near] = position[near] + rng.normal(0.0, 0.05, (int(near.sum()), 6))
        state = state_of(position, 0.03 * cycle)
        now = inputs_of(state, target, goal, sent, 0.03 * cycle)
        if cycle == 0:
            controller.reset(now, everyone)
        given.append(controller.command(now))
    return np.array(given)


def accepts(agreed, arm):
    try:
        check_contract(agreed, arm)
    except ContractError:
        return False
    return True


@pytest.mark.parametrize("name", LAWS)
def test_every_field_of_an_arm_is_checked_if_and_only_if_the_law_reads_it(name):
    layout, law = LAWS[name]
    before, agreed = commands(ARM, law, layout), contract(law, layout)
    assert accepts(agreed, ARM)
    assert set(CHANGES) == {field.name for field in dataclasses.fields(ARM)}
    for field, values in CHANGES.items():
        others = [dataclasses.replace(ARM, **{field: value}) for value in values]
        matters = any(not np.array_equal(commands(other, law, layout), before) for other in others)
        if field in IDENTITY:
            assert not matters
            assert not any(accepts(agreed, other) for other in others)
        else:
            assert [accepts(agreed, other) for other in others] == [not matters] * len(others), field
        assert not (matters and field in UNREAD)


def test_how_a_tool_is_turned_does_not_count():
    layout, law = LAWS["ours"]
    turned = dataclasses.replace(ARM, tip=_turned(ARM.tip))
    np.testing.assert_array_equal(commands(turned, law, layout), commands(ARM, law, layout))
    check_contract(contract(law, layout), turned)


def test_rounding_on_another_machine_is_no_other_arm():
    layout, law = LAWS["ours"]
    nudged = dataclasses.replace(ARM, offset=ARM.offset * (1 + 1e-15), mass=ARM.mass * (1 + 1e-15), com=ARM.com + 1e-17)
    check_contract(contract(law, layout), nudged)
