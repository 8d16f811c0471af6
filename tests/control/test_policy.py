import dataclasses
import os
from types import SimpleNamespace

import numpy as np
import pytest

from commandline import python
from policyfiles import chained, sealed
from rejoint.arms import mycobot280
from rejoint.control.controllers.feedforward import Commander, CommandLaw
from rejoint.control.controllers.observation import Observer, layout_slots
from rejoint.control.controllers.policy import (
    check_controller_period,
    encode_contract,
    load_policy,
    probe_observations,
)
from rejoint.system.errors import ContractError, FileError
from rejoint.training.task import DEFAULT
from rejoint.training.train import policy_contract
from standin import inputs_of, state_of

ARM = mycobot280()
SIZE = 75
WEIGHT = np.random.default_rng(0).normal(0.0, 0.3, (6, SIZE)).astype(np.float32)


def network(observation):
    return np.clip(observation @ WEIGHT.T, -1.0, 1.0)


def contract(**changes):
    probe = network(probe_observations(SIZE))
    given = {"law": CommandLaw(), "probe": tuple(tuple(row) for row in probe.tolist())}
    return dataclasses.replace(policy_contract(ARM, None, DEFAULT, 0), **given | changes)


def write(path, text, weight=WEIGHT):
    return sealed(path, chained([(weight, None)]), text)


@pytest.fixture
def policy(tmp_path):
    return write(tmp_path / "policy.onnx", encode_contract(contract()))


def control_inputs(seed, count):
    rng = np.random.default_rng(seed)
    position = ARM.rest + rng.normal(0.0, 0.1, (count, 6))
    target, goal, sent = ARM.targets.sample(rng, (count,)), position + 0.05, position.copy()
    for cycle in range(5):
        state = state_of(position, 0.03 * cycle)
        now = inputs_of(state, target, goal, sent, state.time)
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
    observer, law, feed = Observer(ARM, 4), Commander(ARM, CommandLaw()), control_inputs(1, 4)
    now = next(feed)
    observer.reset(now, np.ones(4, dtype=bool))
    for got in commands[:-1]:
        action = network(observer.observe(now))
        observer.acted(action)
        expected = law.commands(now, observer.view, action)
        np.testing.assert_allclose(got, expected, atol=1e-7)
        now = feed.send(got)


def refused(path, error, match):
    with pytest.raises(error, match=match):
        load_policy(path, ARM)


def test_a_network_of_another_size_or_without_a_contract_is_refused(tmp_path):
    (tmp_path / "plain.onnx").write_bytes(chained([(WEIGHT, None)]).SerializeToString())
    refused(tmp_path / "plain.onnx", FileError, "without the contract")
    refused(write(tmp_path / "p.onnx", encode_contract(contract()), WEIGHT[:, :40]), ContractError, "observation")
    refused(write(tmp_path / "p.onnx", encode_contract(contract()), WEIGHT[:5]), ContractError, "action")


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"arm": "so101"}, "arm is so101, expected mycobot280"),
        ({"joint_names": ("joint2", "joint1", *ARM.joint_names[2:])}, "joint order"),
        ({"observation": layout_slots("equation-16", 6)}, "observation layout"),
        ({"lower": tuple((ARM.lower - 0.1).tolist())}, "joint range"),
        ({"upper": tuple(ARM.upper[:5].tolist())}, "joint range"),
        ({"arm_digests": {}}, "another offset, axis, tip"),
        ({"law": CommandLaw(load_penalty=-1.0)}, "law.load_penalty"),
    ],
)
def test_policies_for_something_else_are_refused(tmp_path, changes, match):
    refused(write(tmp_path / "p.onnx", encode_contract(contract(**changes))), ContractError, match)


def test_a_control_period_far_from_training_is_refused():
    for period in (0.018, 0.030, 0.055, 0.065):
        check_controller_period(SimpleNamespace(contract=contract()), period)
    for period in (0.010, 0.100):
        with pytest.raises(ContractError):
            check_controller_period(SimpleNamespace(contract=contract()), period)


def test_a_policy_is_run_without_a_word_to_anybody(tmp_path):
    code = (
        "from rejoint.arms import mycobot280\n"
        "from rejoint.control.controllers.catalogue import shelf_policy\n"
        "import numpy as np\n"
        "policy = shelf_policy(mycobot280())\n"
        "assert policy(np.zeros(policy.contract.observation_size)).shape == (6,)\n"
    )
    variables = {name: value for name, value in os.environ.items() if not name.startswith(("ORT_", "XDG_"))}
    python("-c", code, env={**variables, "HOME": str(tmp_path)})
    kept = [path for path in tmp_path.rglob("*") if path.is_file() and "numba" not in str(path).lower()]
    assert kept == [], "ONNX Runtime keeps a number of this machine beside what it is about to send"
