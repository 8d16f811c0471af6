"""Policy files of a few layers, made without a training."""

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from rejoint.control.controllers.policy import DIGEST_KEY, INPUT, METADATA_KEY, OUTPUT, UNSEALED, seal


def chained(layers):
    """Chain Gemm layers (weight, bias); the first is clipped to [-1, 1] if it is the only one, else from below at 0."""
    nodes, last, tensors = [], INPUT, {}
    for number, (weight, bias) in enumerate(layers):
        tensors |= {f"w{number}": weight, f"b{number}": np.zeros(len(weight)) if bias is None else bias}
        names = [last, f"w{number}", f"b{number}"]
        last = OUTPUT if number == len(layers) - 1 and number else f"sum{number}"
        nodes.append(helper.make_node("Gemm", names, [last], transB=1))
        if number == 0:
            after = "clipped" if len(layers) > 1 else OUTPUT
            nodes.append(helper.make_node("Clip", [last, "low", "high"], [after]))
            last = after
    tensors |= {"low": np.array(-1.0 if len(layers) == 1 else 0.0), "high": np.array(1.0)}
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])
        for name, size in ((INPUT, layers[0][0].shape[1]), (OUTPUT, len(layers[-1][0])))
    ]
    kept = [numpy_helper.from_array(value.astype(np.float32), name) for name, value in tensors.items()]
    graph = helper.make_graph(nodes, "policy", ends[:1], ends[1:], kept)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    return model


def sealed(path, model, text):
    """Write a model as a policy of this contract, with the digest of both."""
    del model.metadata_props[:]
    helper.set_model_props(model, {METADATA_KEY: text, DIGEST_KEY: UNSEALED})
    path.write_bytes(seal(model.SerializeToString()))
    return path
