"""Policy files from trained networks, and networks from policy files: ONNX with the contract in its metadata."""

from __future__ import annotations

import io
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import helper, numpy_helper
from torch import Tensor, nn

from rejoint.arms import Arm
from rejoint.control.controllers.catalogue import shelf_policy
from rejoint.control.controllers.policy import (
    DIGEST_KEY,
    INPUT,
    METADATA_KEY,
    OUTPUT,
    UNSEALED,
    PolicyContract,
    encode_contract,
    ort,
    probe_observations,
    seal,
)
from rejoint.system.errors import ContractError
from rejoint.system.files import write_bytes
from rejoint.training.presets import Preset

OPSET, IR_VERSION = 18, 8
"""For ONNX Runtime 1.14 and newer"""


def export_policy(path: Path, network: nn.Sequential, contract: PolicyContract) -> PolicyContract:
    """Write ``network`` as a policy file; returns the contract with its probe.

    The exported function is the mean action clipped to [-1, 1].
    """
    model = policy_graph(network, contract.observation_size)
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    answers = session.run((OUTPUT,), {INPUT: probe_observations(contract.observation_size).astype(np.float32)})[0]
    complete = replace(contract, probe=tuple(tuple(float(value) for value in row) for row in answers))
    helper.set_model_props(model, {METADATA_KEY: encode_contract(complete), DIGEST_KEY: UNSEALED})
    write_bytes(path, seal(model.SerializeToString()))
    return complete


class _Bounded(nn.Sequential):
    """A network whose answers are clipped to [-1, 1]."""

    def __init__(self, network: nn.Sequential) -> None:
        super().__init__(*network)
        self.low, self.high = nn.Buffer(torch.tensor(-1.0)), nn.Buffer(torch.tensor(1.0))

    def forward(self, values: Tensor) -> Tensor:
        """Answers (B, n)."""
        found: Tensor = super().forward(values)  # type: ignore[no-untyped-call]
        return found.clamp(self.low, self.high)


def policy_graph(network: nn.Sequential, observation_size: int) -> onnx.ModelProto:
    """ONNX graph of a network for any number of observations, with a final clip to [-1, 1]."""
    batch = {name: {0: "batch"} for name in (INPUT, OUTPUT)}
    return to_onnx(_Bounded(network), {INPUT: observation_size}, [OUTPUT], dynamic_axes=batch)


def to_onnx(module: nn.Module, inputs: dict[str, int], outputs: list[str], **options: Any) -> onnx.ModelProto:  # noqa: ANN401
    """ONNX graph of ``module`` for ``inputs`` (1, size) of these names and sizes; ``options`` are PyTorch's."""
    file = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its successor cannot write the loop of a search
        torch.onnx.export(
            module,
            tuple(torch.zeros(1, size) for size in inputs.values()),
            cast("Any", file),
            dynamo=False,
            opset_version=OPSET,
            input_names=list(inputs),
            output_names=outputs,
            **options,
        )
    model = onnx.load_from_string(file.getvalue())
    model.ir_version, model.producer_name = IR_VERSION, "rejoint"
    return model


def shelf_start(arm: Arm, recipe: Preset) -> Tensor | None:
    """Return the generic network for trainings of ``arm`` by this ``recipe``; None where none suits.

    Arm, observation, control periods and law must agree.
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


def begin_at(content: bytes) -> Tensor:
    """All weights of a policy file's ``content``, checked by `Policy.load`, layer by layer."""
    return torch.cat([torch.from_numpy(values.copy()).ravel() for values in network_weights(content)])


def network_weights(content: bytes) -> tuple[NDArray[np.float32], ...]:
    """Matrix and bias of each layer of a policy file's ``content``, checked by `Policy.load`."""
    graph = onnx.load_from_string(content).graph
    known = {weight.name: numpy_helper.to_array(weight) for weight in graph.initializer}
    return tuple(known[name] for node in graph.node if node.op_type == "Gemm" for name in node.input[1:])


def _same_task(contract: PolicyContract, recipe: Preset) -> bool:
    task, law = recipe.task, contract.law
    own = replace(task.law, stiffness=law.stiffness, decay_start=law.decay_start)
    periods = contract.min_period <= task.min_period and task.max_period <= contract.max_period
    return contract.layout == task.layout and law == own and periods
