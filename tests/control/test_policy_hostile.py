"""Policy files that are damaged, or made to harm: one clear line each, before ONNX Runtime sees what we do not know."""

import dataclasses
import json

import numpy as np
import onnx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper
from test_policy import ARM, contract, write

from policyfiles import sealed
from rejoint.control.controllers.policy import LARGEST_FILE, LAYERS, MOST_LAYERS, encode_contract, load_policy, ort
from rejoint.system.errors import ContractError, FileError
from rejoint.training.learner import perceptron
from rejoint.training.train import export_policy

MANY = settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])


def outcome(path):
    """Return the controller, or the one line that refuses the file."""
    try:
        return load_policy(path, ARM)
    except (FileError, ContractError) as error:
        line = str(error)
        assert "\n" not in line
        assert len(line) < 600
        return line


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write(tmp_path_factory.mktemp("policy") / "whole.onnx", encode_contract(contract())).read_bytes()


def save(path, found):
    return sealed(path, found, encode_contract(contract()))


@MANY
@given(st.data())
def test_damage_of_any_kind_is_one_line(tmp_path, data, draw):
    damaged = bytearray(data)
    for _ in range(draw.draw(st.integers(1, 6))):
        place, some = draw.draw(st.integers(0, max(len(damaged) - 1, 0))), draw.draw(st.binary(max_size=12))
        match draw.draw(st.sampled_from(("write", "insert", "delete", "cut", "repeat"))):
            case "write":
                damaged[place : place + len(some)] = some
            case "insert":
                damaged[place:place] = some
            case "delete":
                del damaged[place : place + len(some)]
            case "cut":
                del damaged[max(place, 1) :]
            case "repeat":
                damaged[place:place] = damaged[place : place + 200]
    (tmp_path / "p.onnx").write_bytes(damaged)
    found = outcome(tmp_path / "p.onnx")
    assert isinstance(found, str) or damaged == data


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)


@MANY
@given(st.data())
def test_contracts_of_any_content_load_or_are_one_line(tmp_path, draw):
    content = json.loads(encode_contract(contract()))
    for _ in range(draw.draw(st.integers(1, 3))):
        where = content
        if draw.draw(st.booleans()):
            where = content["law"] if draw.draw(st.booleans()) else content["law"]["learning"]
        if not where:
            break
        where[draw.draw(st.sampled_from(sorted(where)))] = draw.draw(JSON)
        if not isinstance(content["law"], dict) or not isinstance(content["law"].get("learning"), dict):
            break
    outcome(write(tmp_path / "p.onnx", json.dumps(content)))


def test_what_is_too_large_is_not_read(tmp_path):
    with (tmp_path / "large.onnx").open("wb") as stream:
        stream.truncate(2 * LARGEST_FILE)
    assert "32.0 MB large, expected at most 16.0 MB" in outcome(tmp_path / "large.onnx")


def model(tmp_path):
    return onnx.load(write(tmp_path / "model.onnx", encode_contract(contract())))


def loops(found):
    body = helper.make_graph([], "body", [], [])
    found.graph.node.append(helper.make_node("Loop", [], ["l"], body=body))


def carries_a_graph(found):
    found.graph.node[0].attribute.append(helper.make_attribute("body", helper.make_graph([], "body", [], [])))


def carries_a_tensor(found):
    found.graph.node[0].attribute.append(helper.make_attribute("value", numpy_helper.from_array(np.zeros(3))))


def asks_for_memory(found):
    found.graph.node.append(helper.make_node("ConstantOfShape", ["w0"], ["m2"]))


def names_a_file(found):
    onnx.external_data_helper.set_external_data(found.graph.initializer[0], "/etc/passwd")
    found.graph.initializer[0].data_location = TensorProto.EXTERNAL


def of_another_library(found):
    found.graph.node[0].domain = "com.microsoft"


def knows_another_library(found):
    found.opset_import.append(helper.make_opsetid("com.microsoft", 1))


def has_functions(found):
    found.functions.append(onnx.FunctionProto(name="f"))


def has_too_many_layers(found):
    found.graph.node.extend([helper.make_node("Tanh", ["sum0"], [f"t{k}"]) for k in range(MOST_LAYERS)])


def has_no_layers(found):
    del found.graph.node[:]


@pytest.mark.parametrize(
    "harm",
    [
        loops,
        carries_a_graph,
        carries_a_tensor,
        asks_for_memory,
        names_a_file,
        of_another_library,
        knows_another_library,
        has_functions,
        has_too_many_layers,
        has_no_layers,
    ],
)
def test_a_network_of_anything_but_layers_never_reaches_the_runtime(harm, tmp_path, monkeypatch):
    found = model(tmp_path)
    harm(found)
    path = save(tmp_path / "p.onnx", found)
    monkeypatch.setattr(ort, "InferenceSession", lambda *_, **__: pytest.fail("the runtime has read it"))
    assert "not a readable ONNX file" in outcome(path)


def test_weights_that_promise_more_than_they_hold_are_refused(tmp_path):
    found = model(tmp_path)
    found.graph.initializer[0].dims[:] = [1 << 31, 1 << 31]
    assert "not a readable ONNX file" in outcome(save(tmp_path / "p.onnx", found))


def test_what_is_exported_is_made_of_these_layers_and_read_back(tmp_path):
    network = perceptron((75, 12, 6))
    written = export_policy(tmp_path / "p.onnx", network, contract())
    kinds = {node.op_type for node in onnx.load(tmp_path / "p.onnx").graph.node}
    assert kinds <= {layer.decode() for layer in LAYERS}
    assert load_policy(tmp_path / "p.onnx", ARM).contract == dataclasses.replace(written)
