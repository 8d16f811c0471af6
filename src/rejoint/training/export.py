"""Policy files from trained networks, and networks from policy files: ONNX with the contract in its metadata."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from rejoint.arms import Arm
from rejoint.control.controllers.catalogue import shelf_policy
from rejoint.control.controllers.contract import (
    DIGEST_KEY,
    INPUT,
    METADATA_KEY,
    OUTPUT,
    PolicyContract,
    content_digest,
    encode_contract,
    probe_observations,
)
from rejoint.control.controllers.runtime import ort
from rejoint.system.errors import ContractError
from rejoint.system.files import write_whole
from rejoint.training.presets import Preset

_OPERATORS: dict[type[nn.Module], str] = {nn.Linear: "Gemm", nn.ELU: "Elu", nn.Tanh: "Tanh"}
_OPSET = 17
_IR_VERSION = 8  # what ONNX Runtime 1.14 and newer read


def export_policy(path: Path, network: nn.Sequential, contract: PolicyContract) -> PolicyContract:
    """Write ``network`` as a policy file; returns the contract with its probe.

    The exported function is the mean action clipped to [-1, 1].
    """
    model = policy_graph(network, contract.observation_size, len(contract.joint_names))
    answers = _run(model, probe_observations(contract.observation_size).astype(np.float32))
    complete = replace(contract, probe=tuple(tuple(float(value) for value in row) for row in answers))
    text = encode_contract(complete)
    helper.set_model_props(model, {METADATA_KEY: text, DIGEST_KEY: content_digest(model.SerializeToString(), text)})
    data = model.SerializeToString()
    write_whole(path, lambda temporary: temporary.write_bytes(data))
    return complete


def policy_graph(network: nn.Sequential, observation_size: int, joints: int) -> onnx.ModelProto:
    """Build the ONNX graph of linear, ELU and tanh layers, with a final clip to [-1, 1]."""
    nodes, weights, last = [], dict[str, NDArray[np.float32]](), INPUT
    for index, layer in enumerate(network):
        if type(layer) not in _OPERATORS:
            raise TypeError(f"cannot export a layer of type {type(layer).__name__}, expected Linear, ELU or Tanh")
        output = f"layer{index}"
        own = {f"{output}.{name}": values.detach().numpy().copy() for name, values in layer.named_parameters()}
        options = {"transB": 1} if own else {"alpha": float(layer.alpha)} if isinstance(layer, nn.ELU) else {}
        nodes.append(helper.make_node(_OPERATORS[type(layer)], [last, *own], [output], **options))
        weights, last = weights | own, output
    weights |= {"low": np.array(-1, dtype=np.float32), "high": np.array(1, dtype=np.float32)}
    nodes.append(helper.make_node("Clip", [last, "low", "high"], [OUTPUT]))
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, ["batch", observation_size])],
        [helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, ["batch", joints])],
        [numpy_helper.from_array(values, name) for name, values in weights.items()],
    )
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION, producer_name="rejoint"
    )
    onnx.checker.check_model(model)
    return model


def _run(model: onnx.ModelProto, observations: NDArray[np.float32]) -> NDArray[np.float32]:
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run((OUTPUT,), {INPUT: observations})[0]


def shelf_start(arm: Arm, recipe: Preset) -> Tensor | None:
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
