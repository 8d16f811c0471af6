"""The contract of a policy file: what it was trained for, checked before anything moves.

It travels as JSON in the metadata of the ONNX file, so that a policy is one file. Of the arm it holds whatever the
deployed law computes with, and nothing else: two arms that differ in what only the guard reads (speed limits, floor) or
only the twin (inertias, the servos' acceleration) are driven by the same policy in the same way.
"""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import msgspec
import numpy as np

from rejoint.arms import Arm, Array, Box
from rejoint.arms.loaded import bare
from rejoint.control.format1 import arm_of_format_1
from rejoint.control.observation import Layout, Slot, layout_slots
from rejoint.control.residual import CommandLaw
from rejoint.system.errors import ContractError, first_line

FORMAT = 3
"""Version of the contract. A reader refuses others, but for format 2, whose law has other names, and policies of
format 1 for arms of the catalogue of then."""

_RENAMED = {
    "burden": "load_penalty", "burden_distance": "load_penalty_distance", "patience": "decay_start",
    "patience_power": "decay_power", "patience_step": "decay_step",
}  # fmt: skip
"""Constants of the law by their names before format 3"""

METADATA_KEY, DIGEST_KEY = "rejoint.contract", "rejoint.digest"
"""Of the contract, and of the digest over contract and network (`rejoint.control.onnxfile.content_digest`), by which a
flipped bit is noticed that the network's answers do not show; files of format 1 have none"""

INPUT, OUTPUT = "observation", "action"
"""Names of the network's input (B, size) and output (B, n), both float32."""

UNITS = {"position": "rad", "command": "rad", "length": "m", "time": "s", "action": "1"}

PROBE_TOLERANCE = 1e-4
"""Largest difference between the recorded and the recomputed answer to the probe (chosen: ten times
what float32 arithmetic on another processor changes)."""

PERIOD_MARGIN = 1.25
"""Factor by which a control period may leave the range of the training (chosen: a little jitter)."""

LARGEST_TEXT = 1 << 20
"""[characters] of a contract (chosen: a hundred times what an arm of six joints needs)"""

LARGEST_CONSTANT = 1e6
"""of a law, in SI units (chosen: far above any that makes sense, far below what overflows)"""

_PROBE_ROWS = 8
_SHOWN = 120  # [characters] of a value of the file that a message shows (chosen: it stays a line)
_LIMIT_TOLERANCE = 1e-6  # [rad]


@dataclass(frozen=True, kw_only=True)
class PolicyContract:
    """Everything that must agree between a policy and the arm it is to drive."""

    arm: str
    arm_digests: dict[str, str]
    """by field of the arm, see `law_digests`"""
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
    servo_gains: dict[str, tuple[int, ...]] | None = None
    """of the servos' own loops, for which it was trained (`rejoint.control.servogains`); None: not known, not asked"""
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


def law_digests(arm: Arm) -> dict[str, str]:
    """Digest every field of an arm that a law may compute with, rounded to 1e-9 m, rad and kg; limits are kept whole.

    Of the tool's pose only the place of the TCP: how it is turned moves no point.
    """
    read: dict[str, Array] = {
        "offset": arm.offset, "axis": arm.axis, "tip": arm.tip[:3, 3], "mass": arm.mass, "com": arm.com,
        "rest": arm.rest, "targets": np.stack([arm.targets.lower, arm.targets.upper]),
    }  # fmt: skip
    return {name: hashlib.sha256(_rounded(array)).hexdigest()[:16] for name, array in read.items()}


def fields_read(law: CommandLaw, layout: Layout, arm: Arm) -> tuple[str, ...]:
    """Name the fields of an arm, of those that `law_digests` knows, that decide what this law commands.

    Besides the kinematics: masses where it raises its goals against gravity; the rest posture where it solves for
    goals, is pulled to it, confines commands to postures around it, or tells the network which pairs of links touch;
    the target region where it solves for goals there, to see which joints move the tool, or to confine commands.
    """
    goals = law.anchor == "goal"
    confines = law.envelope_margin < float((arm.upper - arm.lower).max())
    names = {"offset": True, "axis": True, "tip": True, "mass": goals, "com": goals,
             "rest": goals or confines or law.rest_gain != 0.0 or layout != "residual",
             "targets": goals or confines}  # fmt: skip
    return tuple(name for name, read in names.items() if read)


def arm_digest(arm: Arm) -> str:
    """Digest of everything that is known of an arm, for what must not go on with another one, as a training."""
    digest = hashlib.sha256()
    for entry in fields(arm):
        value = getattr(arm, entry.name)
        if isinstance(value, Box):
            value = np.stack([value.lower, value.upper])
        named = isinstance(value, str | tuple)
        digest.update(f"{entry.name}={value}".encode() if named else _rounded(np.asarray(value, dtype=float)))
    return digest.hexdigest()[:16]


def _rounded(array: Array) -> bytes:
    rounded = np.round(array, 9) + 0.0  # + 0.0 turns -0.0 into 0.0
    return np.ascontiguousarray(rounded, dtype="<f8").tobytes()


def encode_contract(contract: PolicyContract) -> str:
    """Return the contract as JSON text."""
    return msgspec.json.encode(contract, enc_hook=float).decode()  # NumPy scalars become plain numbers


def decode_contract(text: str) -> PolicyContract:
    """Read what `encode_contract` wrote, now or in formats 1 and 2; ContractError if it is something else."""
    if len(text) > LARGEST_TEXT:
        raise ContractError(f"the policy's contract has {len(text)} characters, expected at most {LARGEST_TEXT}")
    try:
        content = msgspec.json.decode(text, type=dict[str, Any])
        version = content.get("format")
        if version == 1:
            content |= {"arm_digests": arm_of_format_1(content.get("arm"), content.get("arm_digest"))}
        elif version not in (2, FORMAT):
            raise ContractError(
                f"the policy's contract has format {shown(repr(version))}, expected {FORMAT}; train it again"
            )
        if version != FORMAT and isinstance(content.get("law"), dict):
            content["law"] = {_RENAMED.get(name, name): value for name, value in content["law"].items()}
        return msgspec.convert(content, type=PolicyContract)
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        reason = shown(first_line(error))
        raise ContractError(f"the policy's contract cannot be read ({reason}); train it again") from error


def check_contract(contract: PolicyContract, arm: Arm) -> None:
    """Refuse (ContractError) a policy that was not trained for this arm and this software.

    How an observation is explained does not count: names and sizes of its parts do. Nor does a load or a tool that
    the owner told: the law computes with it, and the network sees what comes of that.
    """
    arm = bare(arm)
    remedy = "train a policy for this arm"
    expected: tuple[tuple[str, object, object], ...] = (
        ("arm", contract.arm, arm.name),
        ("joint order", contract.joint_names, arm.joint_names),
        ("units", contract.units, UNITS),
        ("observation history", contract.history, 0),
        ("observation layout", _parts(contract.observation), _parts(layout_slots(contract.layout, arm.joints))),
    )
    for what, found, wanted in expected:
        if found != wanted:
            raise ContractError(f"the policy's {what} is {shown(found)}, expected {shown(wanted)}; {remedy}")
    for what, limits, wanted_limits in (("lower", contract.lower, arm.lower), ("upper", contract.upper, arm.upper)):
        if len(limits) != arm.joints or not np.abs(np.array(limits) - wanted_limits).max() <= _LIMIT_TOLERANCE:
            raise ContractError(
                f"the policy's {what} joint limits are {_degrees(limits)} deg, "
                f"expected {_degrees(wanted_limits)} deg; {remedy}"
            )
    strange = [name for name, value in _constants(contract.law) if not 0.0 <= value <= LARGEST_CONSTANT]
    if strange:
        raise ContractError(
            f"the constants {shown(', '.join(strange))} of the policy's law are not between 0 and "
            f"{LARGEST_CONSTANT:g}; train it again"
        )
    own, read = law_digests(arm), fields_read(contract.law, contract.layout, arm)
    other = [name for name in read if contract.arm_digests.get(name) != own[name]]
    if other:
        raise ContractError(f"the policy was trained for a {arm.name} with another {', '.join(other)}; {remedy}")


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
    """Refuse (ContractError) a policy whose training met no control ``period`` [s] like this; NaN: unknown."""
    contract = getattr(controller, "contract", None)
    if isinstance(contract, PolicyContract) and np.isfinite(period):
        check_period(contract, period)


def _constants(law: CommandLaw) -> list[tuple[str, float]]:
    """Name and value of every number in a law."""
    plain = {**asdict(law), **asdict(law.learning)}
    numbers = [(name, value) for name, value in plain.items() if isinstance(value, int | float)]
    return numbers + [("stiffness", value) for value in law.stiffness]


def _parts(slots: tuple[Slot, ...]) -> list[tuple[str, int]]:
    return [(slot.name, slot.size) for slot in slots]


def _degrees(angles: tuple[float, ...] | Array) -> str:
    return shown([round(float(np.degrees(angle)), 1) for angle in angles[:20]])


def shown(value: object) -> str:
    """Print a value that a file decided in one line of bounded length."""
    text = " ".join(str(value).split())
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."
