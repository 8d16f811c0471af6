"""Initial weights of a training on a twin: the actor of the build's generic policy, or random."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import numpy_helper
from torch import nn

from rejoint.arms import Arm
from rejoint.control.catalogue import shelf_policy
from rejoint.control.contract import PolicyContract
from rejoint.system.errors import ContractError
from rejoint.system.files import digest
from rejoint.training.presets import Preset

Weights = tuple[NDArray[np.float32], ...]
"""Matrix, then bias, of each layer"""


@dataclass(frozen=True, kw_only=True, eq=False)
class WarmStart:
    """Initial weights."""

    weights: Weights
    digest: str
    """of the source file"""


def shelf_start(arm: Arm, recipe: Preset) -> WarmStart | None:
    """Return the generic network for trainings of ``arm`` by this ``recipe``; None where none suits.

    Arm, observation and control periods must agree, and the law but for stiffness and slow backlash.
    """
    if recipe.warm is None:
        return None
    try:
        policy = shelf_policy(arm)
    except ContractError:
        return None
    weights = network_weights(policy.content)
    shapes = [matrix.shape for matrix in weights[::2]]
    sizes = (policy.contract.observation_size, *recipe.warm.actor_layers, arm.joints)
    if not _same_task(policy.contract, recipe) or shapes != list(zip(sizes[1:], sizes[:-1], strict=True)):
        return None
    return begin_at(policy.content)


def begin_at(content: bytes) -> WarmStart:
    """Network of a policy file's ``content``, checked by `Policy.load`."""
    return WarmStart(weights=network_weights(content), digest=digest(content).decode())


def network_weights(content: bytes) -> Weights:
    """Read the weights of a policy file's ``content``, checked by `Policy.load`."""
    graph = onnx.load_from_string(content).graph
    known = {weight.name: numpy_helper.to_array(weight) for weight in graph.initializer}
    return tuple(known[name] for node in graph.node if node.op_type == "Gemm" for name in node.input[1:])


def take_over(network: nn.Sequential, start: WarmStart) -> None:
    """Copy the weights into a perceptron."""
    with torch.no_grad():
        for parameter, values in zip(network.parameters(), start.weights, strict=True):
            parameter.copy_(torch.from_numpy(values.copy()))


def _same_task(contract: PolicyContract, recipe: Preset) -> bool:
    task, law = recipe.task, contract.law
    own = replace(task.law, stiffness=law.stiffness, decay_start=law.decay_start)
    periods = contract.min_period <= task.min_period and task.max_period <= contract.max_period
    return contract.layout == task.layout and law == own and periods
