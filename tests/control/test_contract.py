"""What a contract holds an arm to: all that the deployed law computes with, and nothing else."""

import dataclasses
import json

import msgspec
import numpy as np
import pytest

from rejoint.arms import Box, load_arm, mycobot280
from rejoint.control.contract import (
    FORMAT,
    PolicyContract,
    arm_digest,
    check_contract,
    decode_contract,
    encode_contract,
    fields_read,
    law_digests,
)
from rejoint.control.controller import ControlInput
from rejoint.control.observation import layout_slots
from rejoint.control.policy import PolicyController
from rejoint.control.residual import CommandLaw
from rejoint.control.robot import JointState
from rejoint.system.errors import ContractError
from rejoint.training.presets import DEFAULT, PAPER

ARM = mycobot280()
COUNT, CYCLES = 24, 6

STIFFNESS = (7.0,) * 6
LAWS = {
    "ours": ("residual", dataclasses.replace(DEFAULT.task.law, stiffness=STIFFNESS)),
    "ours, patient": ("residual", dataclasses.replace(DEFAULT.task.law, stiffness=STIFFNESS, decay_start=0.05)),
    "sent": ("residual", CommandLaw()),
    "sent, free": ("residual", CommandLaw(rest_gain=0.0, envelope_margin=float(np.radians(360.0)))),
    "paper": (PAPER.task.layout, PAPER.task.law),
}

IDENTITY = {"name", "joint_names"}
"""Fields that no law computes with, and that are checked all the same: they say which arm it is, and which joint is
which."""

UNREAD = {"max_speed", "floor", "inertia", "encoder_step", "servo_acceleration", "servos"}
"""Fields that no law computes with: speed and floor are the guard's, the others the twin's and the diagnosis's."""


def contract(law, layout, **changes) -> PolicyContract:
    complete = PolicyContract(
        arm=ARM.name, arm_digests=law_digests(ARM), joint_names=ARM.joint_names, lower=tuple(ARM.lower.tolist()),
        upper=tuple(ARM.upper.tolist()), layout=layout, observation=layout_slots(layout, 6), law=law,
        min_period=0.018, max_period=0.055, probe=(), twin_digest="", preset="default", seed=0, software="0",
    )  # fmt: skip
    return dataclasses.replace(complete, **changes)


class Network:
    """Stands for ONNX Runtime's session of a network with one random layer."""

    def __init__(self, size):
        self.weight = np.random.default_rng(0).normal(0.0, 0.3, (size, 6))

    def run(self, _, inputs):
        return [np.tanh(inputs["observation"] @ self.weight)]


def _moved(array, amount, *place):
    changed = np.array(array)
    changed[place] += amount
    return changed


def _turned(tip):
    turn = np.eye(4)
    turn[:2, :2] = [[0.8, -0.6], [0.6, 0.8]]
    return tip @ turn


CHANGES = {
    "name": ["another"],
    "joint_names": [ARM.joint_names[::-1]],
    "offset": [_moved(ARM.offset, 0.005, 1, 2, 3), _moved(ARM.offset, 0.005, 2, 0, 3)],
    "axis": [_moved(ARM.axis, -2.0, 3, 2)],
    "tip": [_moved(ARM.tip, 0.01, 2, 3), _moved(ARM.tip, -0.02, 0, 3)],
    "lower": [ARM.lower + 1.0],
    "upper": [ARM.upper - 2.0],
    "max_speed": [0.5 * ARM.max_speed],
    "mass": [3.0 * ARM.mass, _moved(ARM.mass, 0.2, 5)],
    "com": [ARM.com + np.array([0.0, 0.02, 0.0])],
    "inertia": [2.0 * ARM.inertia],
    "rest": [ARM.rest + np.radians([10, 5, -20, 10, 5, 0]), np.radians([11, 121, 83, -15, -46, 19])],
    "targets": [Box(lower=ARM.targets.lower - 0.05, upper=ARM.targets.upper - 0.05)],
    "floor": [0.1],
    "encoder_step": [0.01],
    "servo_acceleration": [5.0],
    "servos": [("sts3215",) * 6],
}


def commands(arm, law, layout):
    """Commands (CYCLES, COUNT, 6) for random control inputs: postures anywhere between the joint limits."""
    agreed = contract(law, layout)
    controller = PolicyController(arm, Network(agreed.observation_size), agreed)
    rng, given = np.random.default_rng(5), []
    target = ARM.targets.sample(rng, (COUNT,))
    everyone = np.ones(COUNT, dtype=bool)
    for cycle in range(CYCLES):
        position, sent = rng.uniform(ARM.lower, ARM.upper, (2, COUNT, 6))
        near = rng.random(COUNT) < 0.3
        sent[near] = position[near] + rng.normal(0.0, 0.05, (int(near.sum()), 6))
        state = JointState(time=np.full(COUNT, 0.03 * cycle), position=position, age=np.zeros(COUNT))
        now = ControlInput(state=state, target=target, sent=sent, since_target=np.full(COUNT, 0.03 * cycle))
        if cycle == 0:
            controller.reset(now, everyone)
        given.append(controller.command(now))
    return np.array(given)


def accepts(agreed, arm):
    try:
        check_contract(agreed, arm)
    except ContractError:
        return False
    return True


@pytest.mark.parametrize("name", LAWS)
def test_every_field_of_an_arm_is_checked_if_and_only_if_the_law_reads_it(name):
    layout, law = LAWS[name]
    before, agreed = commands(ARM, law, layout), contract(law, layout)
    assert accepts(agreed, ARM)
    assert set(CHANGES) == {field.name for field in dataclasses.fields(ARM)}
    for field, values in CHANGES.items():
        others = [dataclasses.replace(ARM, **{field: value}) for value in values]
        matters = any(not np.array_equal(commands(other, law, layout), before) for other in others)
        if field in IDENTITY:
            assert not matters
            assert not any(accepts(agreed, other) for other in others)
        else:
            assert [accepts(agreed, other) for other in others] == [not matters] * len(others), field
        assert not (matters and field in UNREAD)


def test_what_each_law_reads():
    kinematics = {"offset", "axis", "tip"}
    read = {name: set(fields_read(law, layout, ARM)) - kinematics for name, (layout, law) in LAWS.items()}
    assert read["ours"] == read["ours, patient"] == {"mass", "com", "rest", "targets"}
    assert read["sent"] == {"rest", "targets"}
    assert read["sent, free"] == set()
    assert read["paper"] == {"rest"}  # by its number for collisions alone


def test_how_a_tool_is_turned_does_not_count():
    layout, law = LAWS["ours"]
    turned = dataclasses.replace(ARM, tip=_turned(ARM.tip))
    np.testing.assert_array_equal(commands(turned, law, layout), commands(ARM, law, layout))
    check_contract(contract(law, layout), turned)


def test_an_explanation_with_another_space_is_the_same_observation():
    layout, law = LAWS["ours"]
    told = tuple(dataclasses.replace(slot, formula=f"{slot.formula}  ") for slot in layout_slots(layout, 6))
    check_contract(contract(law, layout, observation=told), ARM)
    for change in ({"name": "driven"}, {"size": 7}):
        other = (dataclasses.replace(told[0], **change), *told[1:])
        with pytest.raises(ContractError, match="observation layout"):
            check_contract(contract(law, layout, observation=other), ARM)


def test_what_differs_is_named():
    layout, law = LAWS["ours"]
    heavy = dataclasses.replace(ARM, mass=3.0 * ARM.mass, rest=ARM.rest + 0.1)
    with pytest.raises(ContractError, match="a mycobot280 with another mass, rest; train a policy for this arm"):
        check_contract(contract(law, layout), heavy)


def test_rounding_on_another_machine_is_no_other_arm():
    layout, law = LAWS["ours"]
    nudged = dataclasses.replace(ARM, offset=ARM.offset * (1 + 1e-15), mass=ARM.mass * (1 + 1e-15), com=ARM.com + 1e-17)
    check_contract(contract(law, layout), nudged)


def test_an_arm_s_digest_changes_with_every_field():
    digests = {arm_digest(dataclasses.replace(ARM, **{name: value})) for name, (value, *_) in CHANGES.items()}
    assert len(digests | {arm_digest(ARM)}) == len(CHANGES) + 1


def of_format_1(arm, geometry):
    """Text of a contract of format 1 of our law, as files hold it that were written before there was another."""
    layout, law = LAWS["ours"]
    content = json.loads(encode_contract(contract(law, layout, arm=arm.name)))
    del content["arm_digests"]
    return json.dumps(content | {"format": 1, "arm_digest": geometry})


def test_policies_of_format_1_are_read_for_arms_that_are_known():
    read = decode_contract(of_format_1(ARM, "f382bddea59dce3b"))  # of rejoint 0.1.0
    assert read.format == 1 < FORMAT
    check_contract(read, ARM)
    assert not accepts(read, dataclasses.replace(ARM, mass=3.0 * ARM.mass))
    assert not accepts(read, dataclasses.replace(ARM, rest=ARM.rest + 0.1))


def test_the_law_of_format_2_is_read_by_its_old_names():
    layout, _ = LAWS["ours"]
    law = dataclasses.replace(LAWS["ours"][1], load_penalty=3.0, load_penalty_distance=0.002, decay_start=0.7)
    law = dataclasses.replace(law, decay_power=1.2, decay_step=0.03)
    new = {"load_penalty": "burden", "decay_start": "patience", "decay_power": "patience_power"}
    new |= {"load_penalty_distance": "burden_distance", "decay_step": "patience_step"}
    content = json.loads(encode_contract(contract(law, layout)))
    content["law"] = {new.get(name, name): value for name, value in content["law"].items()}
    assert {"burden", "patience"} < set(content["law"])
    assert decode_contract(json.dumps(content | {"format": 2})).law == law


@pytest.mark.parametrize(
    ("arm", "geometry"),
    [(ARM, "0" * 16), (load_arm("so101"), "f382bddea59dce3b"), (dataclasses.replace(ARM, name="mine"), "0" * 16)],
)
def test_others_of_format_1_are_to_be_trained_again(arm, geometry):
    with pytest.raises(ContractError, match=r"format 1, which does not tell for which masses .* train it again"):
        decode_contract(of_format_1(arm, geometry))


def test_a_contract_says_what_it_cannot_be():
    layout, law = LAWS["ours"]
    complete = json.loads(encode_contract(contract(law, layout)))
    for text, match in (
        ("[" * 100_000, "cannot be read"),
        ('{"format":' * 50_000 + "2" + "}" * 50_000, "cannot be read|has format"),
        ("x" * ((1 << 20) + 1), "characters, expected at most"),
        (json.dumps(complete | {"format": {"deep": ["x" * 5000]}}), "has format"),
        (json.dumps({key: value for key, value in complete.items() if key != "format"}), "has format None"),
        (json.dumps(complete | {"format": 1, "arm": ["mycobot280"], "arm_digest": {}}), "format 1"),
    ):
        with pytest.raises(ContractError, match=match) as refused:
            decode_contract(text)
        assert len(str(refused.value)) < 400
        assert "\n" not in str(refused.value)
    long = msgspec.json.decode(json.dumps(complete | {"arm": "mycobot280\n" * 1000}), type=PolicyContract)
    with pytest.raises(ContractError, match="the policy's arm is mycobot280 mycobot280") as refused:
        check_contract(long, ARM)
    assert len(str(refused.value)) < 400
    assert "\n" not in str(refused.value)
