"""Policy files from trained networks: ONNX with the contract in its metadata."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from rejoint.control.contract import (
    DIGEST_KEY,
    INPUT,
    METADATA_KEY,
    OUTPUT,
    PolicyContract,
    content_digest,
    encode_contract,
    probe_observations,
)
from rejoint.control.runtime import ort
from rejoint.system.files import write_whole

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
    digest = content_digest(model.SerializeToString(), text)
    helper.set_model_props(model, {METADATA_KEY: text, DIGEST_KEY: digest})
    data = model.SerializeToString()
    write_whole(path, lambda temporary: temporary.write_bytes(data))
    return complete


def policy_graph(network: nn.Sequential, observation_size: int, joints: int) -> onnx.ModelProto:
    """Build the ONNX graph of linear, ELU and tanh layers, with a final clip to [-1, 1]."""
    nodes, weights, last = [], [], INPUT
    for index, layer in enumerate(network):
        output = f"layer{index}"
        if isinstance(layer, nn.Linear):
            names = [f"{output}.weight", f"{output}.bias"]
            values = (layer.weight.detach().numpy(), layer.bias.detach().numpy())
            weights += [numpy_helper.from_array(v.copy(), name) for v, name in zip(values, names, strict=True)]
            nodes.append(helper.make_node("Gemm", [last, *names], [output], transB=1))
        elif isinstance(layer, nn.ELU):
            nodes.append(helper.make_node("Elu", [last], [output], alpha=float(layer.alpha)))
        elif isinstance(layer, nn.Tanh):
            nodes.append(helper.make_node("Tanh", [last], [output]))
        else:
            raise TypeError(f"cannot export a layer of type {type(layer).__name__}, expected Linear, ELU or Tanh")
        last = output
    weights += [
        numpy_helper.from_array(np.array(value, dtype=np.float32), name) for name, value in (("low", -1), ("high", 1))
    ]
    nodes.append(helper.make_node("Clip", [last, "low", "high"], [OUTPUT]))
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, ["batch", observation_size])],
        [helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, ["batch", joints])],
        weights,
    )
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION, producer_name="rejoint"
    )
    onnx.checker.check_model(model)
    return model


def _run(model: onnx.ModelProto, observations: NDArray[np.float32]) -> NDArray[np.float32]:
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run((OUTPUT,), {INPUT: observations})[0]
