import dataclasses
import os
import subprocess
import sys

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from rejoint.arms import mycobot280
from rejoint.control.contract import (
    DIGEST_KEY,
    INPUT,
    METADATA_KEY,
    OUTPUT,
    PolicyContract,
    check_period,
    content_digest,
    encode_contract,
    law_digests,
    probe_observations,
)
from rejoint.control.controller import ControlInput
from rejoint.control.observation import Observer, layout_slots
from rejoint.control.policy import load_policy
from rejoint.control.residual import CommandLaw
from rejoint.control.robot import JointState
from rejoint.system.errors import ContractError, FileError

ARM = mycobot280()
SIZE = 75
WEIGHT = np.random.default_rng(0).normal(0.0, 0.3, (6, SIZE)).astype(np.float32)


def network(observation):
    return np.clip(observation @ WEIGHT.T, -1.0, 1.0)


def contract(**changes) -> PolicyContract:
    probe = network(probe_observations(SIZE))
    complete = PolicyContract(
        arm=ARM.name,
        arm_digests=law_digests(ARM),
        joint_names=ARM.joint_names,
        lower=tuple(ARM.lower.tolist()),
        upper=tuple(ARM.upper.tolist()),
        layout="residual",
        observation=layout_slots("residual", 6),
        law=CommandLaw(),
        min_period=0.018,
        max_period=0.055,
        probe=tuple(tuple(row) for row in probe.tolist()),
        twin_digest="",
        preset="default",
        seed=0,
        software="0",
    )
    return dataclasses.replace(complete, **changes)


def write(path, text, weight=WEIGHT, size=SIZE):
    nodes = [
        helper.make_node("Gemm", [INPUT, "w"], ["m"], transB=1),
        helper.make_node("Clip", ["m", "low", "high"], [OUTPUT]),
    ]
    constants = {"w": weight, "low": np.array(-1, np.float32), "high": np.array(1, np.float32)}
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, ["batch", size])],
        [helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, ["batch", weight.shape[0]])],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    if text is not None:
        digest = content_digest(model.SerializeToString(), text)
        helper.set_model_props(model, {METADATA_KEY: text, DIGEST_KEY: digest})
    path.write_bytes(model.SerializeToString())
    return path


@pytest.fixture
def policy(tmp_path):
    return write(tmp_path / "policy.onnx", encode_contract(contract()))


def control_inputs(seed, count):
    rng = np.random.default_rng(seed)
    position = ARM.rest + rng.normal(0.0, 0.1, (count, 6))
    target, goal, sent = ARM.targets.sample(rng, (count,)), position + 0.05, position.copy()
    for cycle in range(5):
        state = JointState(time=np.full(count, 0.03 * cycle), position=position, age=np.zeros(count))
        now = ControlInput(state=state, target=target, goal=goal, sent=sent, since_target=state.time)
        command = yield now
        position, sent = position + 0.3 * (command - position), command


def drive(controller, seed, count):
    feed = control_inputs(seed, count)
    now, commands = next(feed), []
    controller.reset(now, np.ones(count, dtype=bool))
    while True:
        commands.append(controller.command(now))
        try:
            now = feed.send(commands[-1])
        except StopIteration:
            return np.array(commands)


def test_commands_are_observation_network_and_law(policy):
    commands = drive(load_policy(policy, ARM), 1, 4)
    observer, law, feed = Observer(ARM, 4), CommandLaw(), control_inputs(1, 4)
    now = next(feed)
    observer.reset(now, np.ones(4, dtype=bool))
    for got in commands[:-1]:
        action = network(observer.observe(now))
        observer.acted(action)
        expected = law.command(ARM, observer.view, now.state.position, now.sent, action)
        np.testing.assert_allclose(got, expected, atol=1e-7)
        now = feed.send(got)


def refused(path, error, match, arm=ARM):
    with pytest.raises(error, match=match):
        load_policy(path, arm)


def test_files_that_are_no_policy(tmp_path, policy):
    refused(tmp_path / "none.onnx", FileError, "no such file")
    refused(tmp_path, FileError, "cannot be read")
    (tmp_path / "text.onnx").write_text("joint1,joint2\n0,1\n")
    refused(tmp_path / "text.onnx", FileError, "not a readable ONNX file")
    (tmp_path / "empty.onnx").write_bytes(b"")
    refused(tmp_path / "empty.onnx", FileError, "ONNX")
    refused(write(tmp_path / "plain.onnx", None), FileError, "without the contract")


def test_a_network_of_another_size_is_refused(tmp_path):
    refused(write(tmp_path / "p.onnx", encode_contract(contract()), WEIGHT[:, :40], 40), ContractError, "observation")
    refused(write(tmp_path / "p.onnx", encode_contract(contract()), WEIGHT[:5]), ContractError, "action")


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"arm": "so101"}, "arm is so101, expected mycobot280"),
        ({"joint_names": ("joint2", "joint1", *ARM.joint_names[2:])}, "joint order"),
        ({"units": {"position": "deg"}}, "units"),
        ({"history": 3}, "history"),
        ({"observation": layout_slots("equation-16", 6)}, "observation layout"),
        ({"lower": tuple((ARM.lower - 0.1).tolist())}, "lower joint limits"),
        ({"upper": tuple(ARM.upper[:5].tolist())}, "upper joint limits"),
        ({"arm_digests": {}}, "another offset, axis, tip"),
        ({"law": CommandLaw(load_penalty=-1.0, decay_start=1e300)}, "constants load_penalty, decay_start"),
    ],
)
def test_policies_for_something_else_are_refused(tmp_path, changes, match):
    refused(write(tmp_path / "p.onnx", encode_contract(contract(**changes))), ContractError, match)


def test_an_arm_with_a_longer_tool_is_another_arm(policy):
    tip = ARM.tip.copy()
    tip[2, 3] += 0.05
    refused(policy, ContractError, "a mycobot280 with another tip", dataclasses.replace(ARM, tip=tip))


def test_a_control_period_far_from_training_is_refused():
    for period in (0.018, 0.030, 0.055, 0.065):
        check_period(contract(), period)
    for period in (0.010, 0.100, float("nan")):
        with pytest.raises(ContractError, match="18 to 55 ms"):
            check_period(contract(), period)


def test_driving_needs_neither_torch_nor_a_simulator():
    code = "import sys, rejoint.control.policy as p; assert not {'torch', 'skrl', 'mujoco', 'onnx'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_policy_is_run_without_a_word_to_anybody(tmp_path):
    code = (
        "from rejoint.arms import mycobot280\n"
        "from rejoint.control.catalogue import shelf_policy\n"
        "import numpy as np\n"
        "policy = shelf_policy(mycobot280())\n"
        "assert policy(np.zeros(policy.contract.observation_size)).shape == (6,)\n"
    )
    variables = {name: value for name, value in os.environ.items() if not name.startswith(("ORT_", "XDG_"))}
    subprocess.run([sys.executable, "-c", code], env={**variables, "HOME": str(tmp_path)}, check=True)
    kept = [path for path in tmp_path.rglob("*") if path.is_file() and "numba" not in str(path).lower()]
    assert kept == [], "ONNX Runtime keeps a number of this machine beside what it is about to send"
