"""The contract of a policy file: what it was trained for, checked before anything moves.

It travels as JSON in the metadata of the ONNX file, so that a policy is one file.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field

import msgspec
import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.observation import Layout, Slot, layout_slots
from rejoint.control.residual import CommandLaw
from rejoint.errors import ContractError
from rejoint.files import digest

FORMAT = 1
"""Version of the contract; a reader refuses others."""

METADATA_KEY, DIGEST_KEY = "rejoint.contract", "rejoint.contract.digest"

INPUT, OUTPUT = "observation", "action"
"""Names of the network's input (B, size) and output (B, n), both float32."""

UNITS = {"position": "rad", "command": "rad", "length": "m", "time": "s", "action": "1"}

PROBE_TOLERANCE = 1e-4
"""Largest difference between the recorded and the recomputed answer to the probe (chosen: ten times
what float32 arithmetic on another processor changes)."""

PERIOD_MARGIN = 1.25
"""Factor by which a control period may leave the range of the training (chosen: a little jitter)."""

_PROBE_ROWS = 8
_LIMIT_TOLERANCE = 1e-6  # [rad]


@dataclass(frozen=True, kw_only=True)
class PolicyContract:
    """Everything that must agree between a policy and the arm it is to drive."""

    arm: str
    arm_digest: str
    """digest of geometry and joint limits, see `arm_digest`"""
    joint_names: tuple[str, ...]
    lower: tuple[float, ...]
    """[rad] lower joint limits"""
    upper: tuple[float, ...]
    """[rad] upper joint limits"""
    layout: Layout
    """how observations are computed"""
    observation: tuple[Slot, ...]
    """names, sizes and formulas of the observation, in order"""
    law: CommandLaw
    """how actions become commands"""
    min_period: float
    """[s] shortest control period met in training"""
    max_period: float
    """[s] longest control period met in training"""
    probe: tuple[tuple[float, ...], ...]
    """the network's answers to `probe_observations`; a damaged network gives others"""
    twin_digest: str
    """digest of the twin it was trained on; empty where there was none"""
    preset: str
    seed: int
    software: str
    """version of the software that trained it"""
    history: int = 0
    """past observations that the network sees besides the current one"""
    units: dict[str, str] = field(default_factory=lambda: dict(UNITS))
    format: int = FORMAT

    @property
    def observation_size(self) -> int:
        """Length of the observation vector."""
        return sum(slot.size for slot in self.observation)


def probe_observations(size: int) -> Array:
    """Return fixed observations (8, size) in [-1, 1] on which a network is tried when it is loaded."""
    index = np.arange(_PROBE_ROWS * size, dtype=float).reshape(_PROBE_ROWS, size)
    return np.sin(1.0 + index**1.5)


def arm_digest(arm: Arm) -> str:
    """Digest of an arm's geometry and joint limits, rounded to 1e-9 m and rad."""
    digest = hashlib.sha256("/".join((arm.name, *arm.joint_names)).encode())
    for array in (arm.offset, arm.axis, arm.tip, arm.lower, arm.upper):
        digest.update((np.round(array, 9) + 0.0).tobytes())  # + 0.0 turns -0.0 into 0.0
    return digest.hexdigest()[:16]


def encode_contract(contract: PolicyContract) -> str:
    """Return the contract as JSON text."""
    return msgspec.json.encode(contract, enc_hook=float).decode()  # NumPy scalars become plain numbers


def contract_digest(text: str) -> str:
    """Fingerprint of a contract as it is written, by which damage is noticed; the network's answers tell its own."""
    return digest(text.encode()).decode()


def decode_contract(text: str) -> PolicyContract:
    """Read what `encode_contract` wrote; ContractError if it is something else."""
    try:
        version = msgspec.json.decode(text, type=dict[str, object]).get("format")
        if version != FORMAT:
            raise ContractError(f"the policy's contract has format {version!r}, expected {FORMAT}; train it again")
        return msgspec.json.decode(text, type=PolicyContract)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise ContractError(f"the policy's contract cannot be read ({error}); train it again") from error


def check_contract(contract: PolicyContract, arm: Arm) -> None:
    """Refuse (ContractError) a policy that was not trained for this arm and this software."""
    remedy = "train a policy for this arm"
    expected: tuple[tuple[str, object, object], ...] = (
        ("arm", contract.arm, arm.name),
        ("joint order", contract.joint_names, arm.joint_names),
        ("units", contract.units, UNITS),
        ("observation history", contract.history, 0),
        ("observation layout", contract.observation, layout_slots(contract.layout, arm.joints)),
    )
    for what, found, wanted in expected:
        if found != wanted:
            raise ContractError(f"the policy's {what} is {found}, expected {wanted}; {remedy}")
    for what, limits, wanted_limits in (("lower", contract.lower, arm.lower), ("upper", contract.upper, arm.upper)):
        if len(limits) != arm.joints or np.abs(np.array(limits) - wanted_limits).max() > _LIMIT_TOLERANCE:
            raise ContractError(
                f"the policy's {what} joint limits are {_degrees(limits)} deg, "
                f"expected {_degrees(wanted_limits)} deg; {remedy}"
            )
    if contract.arm_digest != arm_digest(arm):
        raise ContractError(f"the policy was trained for another geometry of {arm.name}; {remedy}")


def check_period(contract: PolicyContract, period: float) -> None:
    """Refuse (ContractError) a robot whose mean control period [s] is far from all that was met in training."""
    low, high = contract.min_period / PERIOD_MARGIN, contract.max_period * PERIOD_MARGIN
    if not low <= period <= high:
        raise ContractError(
            f"the robot's control period is {1e3 * period:.0f} ms, the policy was trained for "
            f"{1e3 * contract.min_period:.0f} to {1e3 * contract.max_period:.0f} ms; "
            "choose --period within that, or train for this robot"
        )


def check_controller_period(controller: object, period: float) -> None:
    """Refuse (ContractError) a policy whose training met no control ``period`` [s] like that measured; NaN: unknown."""
    contract = getattr(controller, "contract", None)
    if isinstance(contract, PolicyContract) and np.isfinite(period):
        check_period(contract, period)


def _degrees(angles: tuple[float, ...] | Array) -> list[float]:
    return [round(float(np.degrees(angle)), 1) for angle in angles]
