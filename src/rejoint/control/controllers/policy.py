"""A learned policy as a controller, and the contract of its file, checked before the arm moves.

JSON in the metadata of the ONNX file, which must be a bounded chain of known layers. Fields: ``onnx.proto`` of ONNX
1.17. Needs ONNX Runtime, not torch; without its telemetry, which 0 allows.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from google.protobuf.empty_pb2 import Empty
from google.protobuf.message import DecodeError
from google.protobuf.unknown_fields import UnknownFieldSet

from rejoint.arms import Arm, Array, Mask
from rejoint.arms.inertia import bare
from rejoint.control.controllers.feedforward import Commander, CommandLaw
from rejoint.control.controllers.observation import Layout, Observation, Observer, Slot, layout_slots
from rejoint.control.robot import ControlInput
from rejoint.system.errors import ContractError, FileError, InputError, first_line
from rejoint.system.files import MEGABYTE, digest, read_bounded, reading, write_bytes
from rejoint.system.records import Readable, entity, value_type
from rejoint.system.shell import Late

METADATA_KEY, DIGEST_KEY = "rejoint.contract", "rejoint.digest"

INPUT, OUTPUT = "observation", "action"
"""(B, size) and (B, n), float32"""

PROBE_TOLERANCE = 1e-4
"""Largest difference of probe answers (chosen: ten times float32 rounding)"""

PERIOD_MARGIN = 1.25
"""on trained periods (chosen)"""

_PROBE_ROWS = 8
_SHOWN = 120  # [characters] of a value of the file that a message shows (chosen: it stays a line)


@value_type
class PolicyContract:
    """Common properties of policy and arm."""

    arm: str
    arm_digests: dict[str, str]
    """by field, see `law_digests`"""
    joint_names: tuple[str, ...]
    lower: tuple[float, ...]
    """[rad]"""
    upper: tuple[float, ...]
    """[rad]"""
    layout: Layout
    observation: tuple[Slot, ...]
    law: CommandLaw
    min_period: float
    """[s] in training"""
    max_period: float
    """[s] in training"""
    probe: tuple[tuple[float, ...], ...]
    """answers to `probe_observations`"""
    twin_digest: str
    preset: str
    seed: int
    software: str
    servo_gains: dict[str, tuple[int, ...]] | None = None
    """of the servos in training; None: any"""
    format: Literal[3] = 3
    """version; others are refused"""

    @property
    def observation_size(self) -> int:
        """Length of the observation vector."""
        return sum(slot.size for slot in self.observation)


def probe_observations(size: int) -> Array:
    """Return fixed observations (8, size) in [-1, 1]."""
    index = np.arange(_PROBE_ROWS * size, dtype=float).reshape(_PROBE_ROWS, size)
    return np.sin(1.0 + index**1.5)


def law_digests(arm: Arm) -> dict[str, str]:
    """Digests of arm fields for laws, rounded to 1e-9."""
    read = {
        "offset": arm.offset,
        "axis": arm.axis,
        "tip": arm.tip[:3, 3],
        "mass": arm.mass,
        "com": arm.com,
        "rest": arm.rest,
        "targets": np.stack([arm.targets.lower, arm.targets.upper]),
    }
    rounded = {name: np.round(array, 9) + 0.0 for name, array in read.items()}  # + 0.0 turns -0.0 into 0.0
    return {name: digest(array.astype("<f8").tobytes()) for name, array in rounded.items()}


def encode_contract(contract: PolicyContract) -> str:
    """JSON text."""
    return msgspec.json.encode(contract, enc_hook=float).decode()  # NumPy scalars become plain numbers


def decode_contract(text: str) -> PolicyContract:
    """Decode JSON text; ContractError."""
    try:
        return msgspec.json.decode(text, type=PolicyContract)
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        reason = shown(first_line(error))
        raise ContractError(f"the policy's contract cannot be read ({reason}); train it again") from error


def check_contract(contract: PolicyContract, arm: Arm) -> None:
    """Raise ContractError unless the policy suits this arm; payload and tool do not count."""
    arm = bare(arm)
    remedy = "train a policy for this arm"
    expected = {
        "arm": (contract.arm, arm.name),
        "joint order": (contract.joint_names, arm.joint_names),
        "observation layout": (_parts(contract.observation), _parts(layout_slots(contract.layout, arm.joints))),
        "joint range [deg]": (_degrees(contract.lower, contract.upper), _degrees(arm.lower, arm.upper)),
    }
    for what, (found, wanted) in expected.items():
        if found != wanted:
            raise ContractError(f"the policy's {what} is {shown(found)}, expected {shown(wanted)}; {remedy}")
    own, read = law_digests(arm), ["offset", "axis", "tip", *["rest"] * (contract.layout != "residual")]
    read = [*own] if contract.law.anchor == "goal" else read
    other = [name for name in read if contract.arm_digests.get(name) != own[name]]
    if other:
        raise ContractError(f"the policy was trained for a {arm.name} with another {', '.join(other)}; {remedy}")


def check_controller_period(controller: object, period: float) -> None:
    """Raise ContractError for a policy untrained for the mean control ``period`` [s]; NaN: unknown."""
    contract = getattr(controller, "contract", None)
    if not isinstance(contract, PolicyContract) or np.isnan(period):
        return
    low, high = contract.min_period / PERIOD_MARGIN, contract.max_period * PERIOD_MARGIN
    if not low <= period <= high:
        raise ContractError(
            f"the control period is {1e3 * period:.0f} ms, this controller is made for {1e3 * contract.min_period:.0f} "
            f"to {1e3 * contract.max_period:.0f} ms; use a faster link or another --period"
        )


def _parts(slots: tuple[Slot, ...]) -> list[tuple[str, int]]:
    return [(slot.name, slot.size) for slot in slots]


def _degrees(*limits: Sequence[float] | Array) -> list[list[float]]:
    return [np.degrees(side).round(4).tolist() for side in limits]


def shown(value: object) -> str:
    """Print a value in one short line."""
    text = " ".join(str(value).split())
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


LAYERS = (b"Gemm", b"Elu", b"Tanh", b"Clip")
"""Allowed operators"""

MOST_LAYERS = 64
"""(chosen)"""

_GRAPH, _PROPERTY, _NODE = 7, 14, 1
_ATTRIBUTE_FIELDS = dict.fromkeys((1, 2, 3, 4, 13, 20, 21))  # numbers and text: no tensors and no graphs inside
_NODE_FIELDS = {**dict.fromkeys((1, 2, 3, 6)), 4: LAYERS, 5: _ATTRIBUTE_FIELDS, 7: (b"",)}  # of no other library
_WEIGHT_FIELDS = dict.fromkeys((1, 2, 4, 8, 9, 12))  # float32 inside the file: no segments, no other file
_MODEL_FIELDS = {
    **dict.fromkeys((1, 2, 3, 4, 5, 6)),  # no training, functions and devices
    _GRAPH: {**dict.fromkeys((2, 10, 11, 12, 13)), _NODE: _NODE_FIELDS, 5: _WEIGHT_FIELDS},  # all weights dense
    8: {1: (b"",), 2: None},
    _PROPERTY: {1: None, 2: None},
}
"""Allowed fields by number: with fields inside, with these values, or with any"""

UNSEALED = "0" * 64
"""Digest of a file that has none yet"""


def read_metadata(data: bytes) -> dict[str, str]:
    """Metadata of an ONNX file; ValueError."""
    _check(data, _MODEL_FIELDS)
    parts = _fields(data)
    layers = sum(field == _NODE for number, graph in parts if number == _GRAPH for field, _ in _fields(graph))
    if not 0 < layers <= MOST_LAYERS:
        raise ValueError(f"{layers} layers, expected 1 to {MOST_LAYERS}")
    pairs = (dict(_fields(value)) for number, value in parts if number == _PROPERTY)
    return {pair.get(1, b"").decode(): pair.get(2, b"").decode() for pair in pairs}


def content_digest(data: bytes, recorded: str) -> str:
    """Digest of an ONNX file in which this one is ``recorded``."""
    return hashlib.sha256(data.replace(recorded.encode(), b"", 1)).hexdigest()


def seal(data: bytes) -> bytes:
    """Put its digest in the place of `UNSEALED`."""
    return data.replace(UNSEALED.encode(), content_digest(data, UNSEALED).encode(), 1)


def _check(data: bytes, allowed: Mapping[int, Any]) -> None:
    for number, value in _fields(data):
        inside = allowed.get(number, ())
        if isinstance(inside, dict):
            _check(value, inside)
        elif inside is not None and value not in inside:
            raise ValueError(f"a field {number} that no policy has: {shown(value)}")


def _fields(message: bytes) -> list[tuple[int, Any]]:
    """Numbers and values of a message's fields: each one that an empty message does not know."""
    try:
        return [(field.field_number, field.data) for field in UnknownFieldSet(Empty.FromString(message))]
    except DecodeError as error:
        raise ValueError(first_line(error)) from error


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
            where = np.full(count, True)
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


@entity
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
            data = read_bounded(Path(path), "check the path", LARGEST_FILE)
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
        write_bytes(Path(path), self.content)

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
        options, source, contract = ort.SessionOptions(), self.source, self.contract
        # The network is tiny: a second thread costs more than it brings.
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4
        try:
            session = ort.InferenceSession(self.content, options, ["CPUExecutionProvider"], enable_fallback=0)
        except Exception as error:  # ONNX Runtime has many of its own and names none of them
            raise FileError(source, _DAMAGED, "train the policy again") from error
        n, size = len(contract.joint_names), contract.observation_size
        found = [(node.name, node.shape[1:]) for node in (*session.get_inputs(), *session.get_outputs())]
        if found != [(INPUT, [size]), (OUTPUT, [n])]:
            raise ContractError(
                f"{source}: the network maps {shown(found)}, its contract says {INPUT} ({size}) to {OUTPUT} ({n}); "
                "train it again"
            )
        with suppress(Exception):  # shapes inside that do not go together, or ragged answers in the contract
            answer, recorded = _act(session, probe_observations(size).astype(np.float32)), np.array(contract.probe)
            if recorded.shape == answer.shape and np.abs(recorded - answer).max() <= PROBE_TOLERANCE:
                return session
        raise FileError(source, "the network does not give the answers recorded in it", "train the policy again")


def load_policy(path: Path, arm: Arm) -> PolicyController:
    """Read a policy file for ``arm``; FileError, ContractError."""
    return Policy.load(path).controller(arm)


def _act(session: Any, observation: Observation) -> Array:  # noqa: ANN401
    return session.run((OUTPUT,), {INPUT: observation})[0].astype(float)
