"""Policies that nobody should drive with, each in a file whose contract is in order."""

import dataclasses

import numpy as np

from madetwin import made_twin
from policyfiles import chained, sealed
from rejoint.control.controllers.observation import layout_slots
from rejoint.control.controllers.policy import (
    encode_contract,
    probe_observations,
)
from rejoint.training.task import DEFAULT
from rejoint.training.train import TrainingOptions, policy_contract, train
from rejoint.twin.parameters import nominal_parameters
from rejoint_lab.plant.wear import load_wear

LATE, FAR = 1.2, 1.02
"""Values of the slots ``waited`` (1.7 s after the target was set) and ``distance`` (52 mm off) that no probe has"""


def random_weights(path, arm):
    """Exported before it learned anything, with weights far too large."""
    weight = np.random.default_rng(0).normal(0.0, 3.0, (arm.joints, _size(arm)))
    return _write(path, arm, [(weight, np.zeros(arm.joints))])


def saturated(path, arm):
    """Every joint pushed to one side for ever."""
    return _write(path, arm, [(np.zeros((arm.joints, _size(arm))), 9.0 * (-1.0) ** np.arange(arm.joints))])


def poisoned(path, arm, value, slot, above):
    """An honest zero, and ``value``, NaN or infinite, where the observation's ``slot`` is ``above``.

    Made of the layers that a policy may have: what is above is cut out, and multiplied until no number holds it.
    """
    pick = np.eye(_size(arm))[[_index(arm, slot)]]
    last = np.tile([1.0, -1.0] if np.isnan(value) else [1.0, 0.5], (arm.joints, 1))
    layers = [(pick, np.array([-above])), (np.full((2, 1), 1e38), None), (np.diag([1e38, 1e38]), None), (last, None)]
    probe = probe_observations(_size(arm)).astype(np.float32)
    assert not (probe @ pick[0] > above).any(), "the probe would find it"
    return _write(path, arm, layers)


def for_a_softer_arm(folder, arm):
    """Trained from random weights, if not for long, on a twin with a third of the stiffness."""
    options = TrainingOptions(preset="scratch", iterations=2, agents=16)
    return train(arm, softer_twin(arm), out=folder, options=options).policy


def softer_twin(arm):
    """A twin with a third of the stiffness that the worn arm has."""
    soft = load_wear("worn", arm).position_gain / 3
    return made_twin(arm, dataclasses.replace(nominal_parameters(arm), stiffness=soft))


def _size(arm):
    return sum(slot.size for slot in layout_slots("residual", arm.joints))


def _index(arm, name):
    slots = layout_slots("residual", arm.joints)
    return sum(slot.size for slot in slots[: [slot.name for slot in slots].index(name)])


def _write(path, arm, layers):
    law = dataclasses.replace(DEFAULT.task.law, stiffness=tuple(load_wear("worn", arm).position_gain.tolist()))
    recipe = dataclasses.replace(DEFAULT, task=dataclasses.replace(DEFAULT.task, law=law))
    probe = probe_observations(_size(arm)).astype(np.float32)
    answers = np.zeros((len(probe), arm.joints))
    if len(layers) == 1:
        answers = np.clip(probe @ layers[0][0].T.astype(np.float32) + layers[0][1], -1.0, 1.0)
    contract = dataclasses.replace(
        policy_contract(arm, None, recipe, 0), probe=tuple(tuple(map(float, row)) for row in answers)
    )
    return sealed(path, chained(layers), encode_contract(contract))
