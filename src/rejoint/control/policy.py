"""A learned policy as a controller: observation, network, command law. Needs ONNX Runtime, not torch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime as ort
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors

from rejoint.arms import Arm, Array
from rejoint.control.contract import (
    DIGEST_KEY,
    INPUT,
    METADATA_KEY,
    OUTPUT,
    PROBE_TOLERANCE,
    PolicyContract,
    check_contract,
    contract_digest,
    decode_contract,
    probe_observations,
)
from rejoint.control.controller import Situation
from rejoint.control.observation import Observation, Observer
from rejoint.control.residual import Commander
from rejoint.control.robot import Mask
from rejoint.errors import ContractError, FileError
from rejoint.files import MODEL_MOST, read_bounded

_UNREADABLE = (
    ort_errors.Fail, ort_errors.InvalidArgument, ort_errors.InvalidGraph, ort_errors.InvalidProtobuf,
    ort_errors.NoModel, ort_errors.NoSuchFile, ort_errors.NotImplemented, ort_errors.RuntimeException,
)  # fmt: skip


class PolicyController:
    """Drives a batch of arms with a trained network."""

    def __init__(self, arm: Arm, session: ort.InferenceSession, contract: PolicyContract) -> None:
        self.arm, self.contract = arm, contract
        self._session = session
        self._observer = Observer(arm, 1, contract.layout)
        self._commander = Commander(arm, contract.law)

    @property
    def name(self) -> str:
        """Name in tables."""
        return "policy"

    def reset(self, situation: Situation, where: Mask) -> None:
        """Start afresh for the arms in ``where`` (B,)."""
        count = len(situation.sent)
        if count != self._observer.count:
            self._observer = Observer(self.arm, count, self.contract.layout)
            where = np.ones(count, dtype=bool)
        self._observer.reset(situation, where)
        self._commander.reset(situation, where)

    def command(self, situation: Situation) -> Array:
        """Return the wanted joint positions (B, n) [rad]."""
        observer = self._observer
        action = self.act(observer.observe(situation))
        observer.acted(action)
        return self._commander.command(situation, observer.view, action)

    def act(self, observation: Observation) -> Array:
        """Mean action (B, n) in [-1, 1] of the network for observations (B, size)."""
        return self._session.run((OUTPUT,), {INPUT: observation})[0].astype(float)


def load_policy(path: Path, arm: Arm) -> PolicyController:
    """Read a policy file and check that it fits the arm, before anything moves.

    FileError: missing, damaged, or no policy at all. ContractError: a policy for something else.
    """
    session = _open(path)
    try:
        told = session.get_modelmeta().custom_metadata_map
    except UnicodeDecodeError as error:
        raise FileError(path, "damaged (its metadata are no text)", "train the policy again") from error
    text = told.get(METADATA_KEY)
    if text is None:
        raise FileError(path, "an ONNX file without the contract of a policy", "take a file written by `rejoint train`")
    if told.get(DIGEST_KEY, contract_digest(text)) != contract_digest(
        text
    ):  # policies of before there was one have none
        raise FileError(path, "damaged (its contract is not what was written)", "train the policy again")
    contract = decode_contract(text)
    check_contract(contract, arm)
    controller = PolicyController(arm, session, contract)
    _check_network(path, controller)
    return controller


def _open(path: Path) -> ort.InferenceSession:
    options = ort.SessionOptions()
    # The network is tiny: a second thread costs more than it brings.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        data = read_bounded(path, MODEL_MOST, "train the policy again")
    except FileNotFoundError as error:
        raise FileError(path, "no such file", "train a policy first") from error
    except OSError as error:
        raise FileError(path, f"cannot be read ({error.strerror})", "check the path") from error
    try:
        return ort.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except _UNREADABLE as error:
        raise FileError(path, "not a readable ONNX file, truncated or damaged", "train the policy again") from error


def _check_network(path: Path, controller: PolicyController) -> None:
    """Check the network's interface and its recorded answers."""
    contract, session = controller.contract, controller._session
    n, size = len(contract.joint_names), contract.observation_size
    found = [(node.name, node.shape[1:]) for node in (*session.get_inputs(), *session.get_outputs())]
    if found != [(INPUT, [size]), (OUTPUT, [n])]:
        raise ContractError(
            f"{path}: the network maps {found}, its contract says {INPUT} ({size}) to {OUTPUT} ({n}); train it again"
        )
    try:
        answer = controller.act(probe_observations(size).astype(np.float32))
    except _UNREADABLE as error:
        raise FileError(path, "the network in it cannot be run, damaged", "train the policy again") from error
    recorded = np.array(contract.probe)
    if recorded.shape != answer.shape or not np.abs(recorded - answer).max() <= PROBE_TOLERANCE:
        raise FileError(path, "the network no longer gives the answers recorded in it", "train the policy again")
