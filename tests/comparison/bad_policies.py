"""Policies that nobody should drive with, each in a file whose contract is in order."""

import dataclasses

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from rejoint.control.contract import INPUT, METADATA_KEY, OUTPUT, encode_contract, probe_observations
from rejoint.control.observation import layout_slots
from rejoint.plant.wear import load_wear
from rejoint.training.presets import DEFAULT
from rejoint.training.train import TrainingOptions, policy_contract, train
from rejoint.twin.parameters import nominal_parameters, prior
from rejoint.twin.replay import PredictionError
from rejoint.twin.twin import HeldOut, Twin

LATE, FAR = 1.2, 1.02
"""Values of the slots ``waited`` (1.7 s after the target was set) and ``distance`` (52 mm off) that no probe has"""


def random_weights(path, arm, seed=0):
    """Exported before it learned anything, with weights far too large."""
    weight = np.random.default_rng(seed).normal(0.0, 3.0, (arm.joints, _size(arm)))
    return _write(path, arm, weight, np.zeros(arm.joints))


def saturated(path, arm):
    """Every joint pushed to one side for ever."""
    return _write(path, arm, np.zeros((arm.joints, _size(arm))), 9.0 * (-1.0) ** np.arange(arm.joints))


def poisoned(path, arm, value, slot, above):
    """An honest zero, and ``value`` in one joint where the observation's ``slot`` is ``above``."""
    answer = np.zeros(arm.joints)
    answer[1] = value
    zero = np.zeros((arm.joints, _size(arm)))
    return _write(path, arm, zero, np.zeros(arm.joints), (_index(arm, slot), above, answer))


def for_a_softer_arm(folder, arm):
    """Trained, if not for long, on a twin with a third of the stiffness."""
    return train(arm, softer_twin(arm), out=folder, options=TrainingOptions(iterations=2, agents=16, threads=1)).policy


def softer_twin(arm):
    """A twin with a third of the stiffness that the worn arm has."""
    belief = prior(arm)
    soft = load_wear("worn", arm).position_gain / 3
    error = PredictionError(joints=np.full(arm.joints, 0.01), joint=0.01, tcp=1e-3)
    return Twin(
        arm=arm.name, joint_names=arm.joint_names,
        parameters=dataclasses.replace(nominal_parameters(arm), stiffness=soft),
        covariance=np.diag((0.1 * belief.sigma) ** 2), lower=belief.lower, upper=belief.upper,
        narrowing=np.full(len(belief.mean), 0.1), identified=np.ones(len(belief.mean), dtype=bool),
        held_out=HeldOut(seconds=30.0, no_twin=error, healthy_twin=error, twin=error), fit_seconds=1.0, notes=(),
    )  # fmt: skip


def _size(arm):
    return sum(slot.size for slot in layout_slots("residual", arm.joints))


def _index(arm, name):
    slots = layout_slots("residual", arm.joints)
    return sum(slot.size for slot in slots[: [slot.name for slot in slots].index(name)])


def _write(path, arm, weight, bias, poison=None):
    """clip(weight o + bias), or another answer where one number of the observation is above a value."""
    constants = {"w": weight, "b": bias, "low": np.array(-1.0), "high": np.array(1.0)}
    nodes = [
        helper.make_node("Gemm", [INPUT, "w", "b"], ["sum"], transB=1),
        helper.make_node("Clip", ["sum", "low", "high"], ["clipped" if poison else OUTPUT]),
    ]
    if poison:
        index, above, answer = poison
        constants |= {"index": np.array([index]), "above": np.array(above), "answer": answer[None]}
        nodes += [
            helper.make_node("Gather", [INPUT, "index"], ["number"], axis=1),
            helper.make_node("Greater", ["number", "above"], ["where"]),
            helper.make_node("Where", ["where", "answer", "clipped"], [OUTPUT]),
        ]
    tensors = [
        numpy_helper.from_array(value if value.dtype.kind == "i" else value.astype(np.float32), name)
        for name, value in constants.items()
    ]
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])
        for name, size in ((INPUT, _size(arm)), (OUTPUT, arm.joints))
    ]
    graph = helper.make_graph(nodes, "policy", ends[:1], ends[1:], tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    law = dataclasses.replace(DEFAULT.task.law, stiffness=tuple(load_wear("worn", arm).position_gain.tolist()))
    recipe = dataclasses.replace(DEFAULT, task=dataclasses.replace(DEFAULT.task, law=law))
    probe = probe_observations(_size(arm)).astype(np.float32)
    assert poison is None or not (probe[:, poison[0]] > poison[1]).any(), "the probe would find it"
    answers = np.clip(probe @ weight.T.astype(np.float32) + bias, -1.0, 1.0)
    contract = dataclasses.replace(
        policy_contract(arm, None, recipe, 0), probe=tuple(tuple(map(float, row)) for row in answers)
    )
    helper.set_model_props(model, {METADATA_KEY: encode_contract(contract)})
    path.write_bytes(model.SerializeToString())
    return path
