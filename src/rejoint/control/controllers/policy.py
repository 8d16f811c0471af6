"""A learned policy as a controller. Needs ONNX Runtime, not torch; without its telemetry, which 0 allows."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.arms import Arm, Array, Mask
from rejoint.control.controllers.contract import (
    DIGEST_KEY,
    INPUT,
    METADATA_KEY,
    OUTPUT,
    PROBE_TOLERANCE,
    PolicyContract,
    check_contract,
    content_digest,
    decode_contract,
    probe_observations,
    read_metadata,
    shown,
)
from rejoint.control.controllers.observation import Observation, Observer
from rejoint.control.controllers.residual import Commander
from rejoint.control.robot import ControlInput
from rejoint.system.errors import ContractError, FileError, InputError
from rejoint.system.files import MEGABYTE, read_bounded, reading, write_whole
from rejoint.system.results import Readable
from rejoint.system.shell import Late

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # read when it is imported
ort = Late("onnxruntime")

LARGEST_FILE = 16 * MEGABYTE
"""[bytes] (chosen: two hundred times what ours have)"""

_DAMAGED = "not a readable ONNX file, truncated or damaged"


class PolicyController(Commander):
    """Drives B arms with a trained network."""

    name = "policy"

    def __init__(self, arm: Arm, session: Any, contract: PolicyContract) -> None:  # noqa: ANN401 - an untyped library
        super().__init__(arm, contract.law)
        self.arm, self.contract, self._session = arm, contract, session
        self._observer = Observer(arm, 1, contract.layout)

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Restart where ``where`` (B,)."""
        count = len(inputs.sent)
        if count != self._observer.count:
            self._observer = Observer(self.arm, count, self.contract.layout)
            where = np.ones(count, dtype=bool)
        self._observer.reset(inputs, where)
        super().reset(inputs, where)

    def take_over(self, inputs: ControlInput, where: Mask) -> None:
        """Continue from another controller's command, where ``where`` (B,)."""
        self._observer.drop_actions(where)
        super().take_over(inputs, where)

    def command(self, inputs: ControlInput) -> Array:
        """See `Controller`."""
        observer = self._observer
        action = self.act(observer.observe(inputs))
        observer.acted(action)
        return self.commands(inputs, observer.view, action)

    def act(self, observation: Observation) -> Array:
        """Mean action (B, n) in [-1, 1] for observations (B, size)."""
        return _act(self._session, observation)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Policy(Readable):
    """A trained policy: an ONNX file and its contract.

    Examples
    --------
    >>> policy = rejoint.Policy.load("runs/mine/policy.onnx")
    >>> action = policy(observation)
    >>> rejoint.deploy("tcp://192.168.1.20:9000", policy, targets)
    """

    content: bytes = field(repr=False)
    """of the ONNX file"""
    contract: PolicyContract
    source: str = "policy"
    """origin, for messages"""

    @classmethod
    def load(cls, path: Path | str) -> Policy:
        """Read a policy file; FileError."""
        with reading(Path(path), _DAMAGED, "train the policy again"):
            data = read_bounded(Path(path), LARGEST_FILE, "check the path")
            metadata = read_metadata(data)
        text = metadata.get(METADATA_KEY)
        if text is None:
            known = "take a file written by `rejoint train`"
            raise FileError(path, "an ONNX file without the contract of a policy", known)
        contract = decode_contract(text)
        recorded = metadata.get(DIGEST_KEY, "")
        if recorded != content_digest(data, recorded):
            raise FileError(path, "its content no longer gives the digest recorded in it", "train the policy again")
        return cls(content=data, contract=contract, source=str(path))

    def save(self, path: Path | str) -> None:
        """Write the policy file, whole or not at all; FileError."""
        write_whole(Path(path), lambda temporary: temporary.write_bytes(self.content))

    def controller(self, arm: Arm) -> PolicyController:
        """Return the controller of ``arm``; ContractError for another arm, FileError for a damaged network."""
        check_contract(self.contract, arm)
        return PolicyController(arm, self._session, self.contract)

    def __call__(self, observation: Observation) -> Array:
        """Mean action (B, n) or (n,) in [-1, 1] for observations (B, size) or (size,).

        ``contract.observation`` lists the slots, ``contract.law`` turns actions into commands.
        """
        rows = np.atleast_2d(np.asarray(observation, dtype=np.float32))
        size = self.contract.observation_size
        if rows.ndim != 2 or rows.shape[1] != size:
            raise InputError(f"policy: an observation has shape {np.shape(observation)}, expected ({size},) a row")
        return _act(self._session, rows).reshape(*np.shape(observation)[:-1], -1)

    @cached_property
    def _session(self) -> Any:  # noqa: ANN401
        """Network that gives the contract's probe answers."""
        session = _open(self.source, self.content)
        _check_network(self.source, self.contract, session)
        return session


def load_policy(path: Path, arm: Arm) -> PolicyController:
    """Read a policy file for ``arm``; FileError, ContractError."""
    return Policy.load(path).controller(arm)


def _act(session: Any, observation: Observation) -> Array:  # noqa: ANN401
    return session.run((OUTPUT,), {INPUT: observation})[0].astype(float)


def _open(source: str, data: bytes) -> Any:  # noqa: ANN401
    options = ort.SessionOptions()
    # The network is tiny: a second thread costs more than it brings.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        return ort.InferenceSession(data, options, providers=["CPUExecutionProvider"], enable_fallback=0)
    except Exception as error:  # ONNX Runtime has many of its own and names none of them
        raise FileError(source, _DAMAGED, "train the policy again") from error


def _check_network(source: str, contract: PolicyContract, session: Any) -> None:  # noqa: ANN401
    n, size = len(contract.joint_names), contract.observation_size
    found = [(node.name, node.shape[1:]) for node in (*session.get_inputs(), *session.get_outputs())]
    if found != [(INPUT, [size]), (OUTPUT, [n])]:
        raise ContractError(
            f"{source}: the network maps {shown(found)}, its contract says {INPUT} ({size}) to {OUTPUT} ({n}); "
            "train it again"
        )
    rows = probe_observations(size).astype(np.float32)
    try:
        answer, recorded = _act(session, rows), np.array(contract.probe)
    except Exception as error:  # shapes inside that do not go together, or ragged answers in the contract
        raise FileError(source, "its network or the answers recorded in it make no sense", "train it again") from error
    if recorded.shape != answer.shape or not np.abs(recorded - answer).max() <= PROBE_TOLERANCE:
        raise FileError(source, "the network no longer gives the answers recorded in it", "train the policy again")
