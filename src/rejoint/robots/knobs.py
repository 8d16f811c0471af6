"""Kinds of servos: registers, gains as options of an address (``?p=48&i=4``), and their change in small steps."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import field
from math import copysign
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.servogains import HEAVIEST, HOTTEST, OverloadedError, Rung, ServoGains
from rejoint.robots.family import Wire, read_wire
from rejoint.robots.registers import Register
from rejoint.system.errors import InputError, RobotError
from rejoint.system.files import digest
from rejoint.system.records import value_type
from rejoint.system.stopping import ending

LIMIT = "limit"
"""Name of the gain that limits a servo's output or its I part"""

Gains = Mapping[str, int]
Values = dict[str, tuple[int, ...]]
"""One per joint, by name"""


@value_type
class Knob:
    """An adjustable gain."""

    names: tuple[str, ...]
    """registers that it sets"""
    low: int
    high: int
    stride: int
    """largest change at once: limits the arm's jump; negative: a smaller value is the stiffer one"""
    beside: tuple[tuple[str, int], ...] = ()
    """other registers that a value above zero needs"""


class Model(NamedTuple):
    """A model of servos."""

    name: str
    full: float
    """value of the register ``load`` at the largest torque"""
    supply: bool = False
    """the load is the current of the supply, of which the torque goes as the root"""

    def share(self, load: int) -> float:
        """Share of the largest torque, -1 to 1."""
        part = min(abs(load) / self.full, 1.0)
        return copysign(part**0.5 if self.supply else part, load)


@value_type
class ServoKind:
    """Servos of one maker, from a ``servo.toml``."""

    registers: dict[str, Register]
    memory: tuple[str, ...]
    """registers of gains"""
    knobs: dict[str, Knob]
    ladder: tuple[Rung, ...]
    """search order of gains"""
    models: dict[int, Model]
    """by number"""
    faults: dict[int, str]
    """names of error bits"""

    @property
    def strides(self) -> dict[str, int]:
        """`Knob.stride` by register; one beside changes at once."""
        found = {name: knob.stride for knob in self.knobs.values() for name in knob.names}
        return {name: most for knob in self.knobs.values() for name, most in knob.beside} | found

    def read_gains(self, given: Mapping[str, str]) -> Gains:
        """Read gains from address options; ValueError."""
        found = {}
        for name, text in given.items():
            knob = self.knobs[name]
            if not (text.isascii() and text.isdecimal() and knob.low <= int(text) <= knob.high):
                raise ValueError(f"expected {name}=N with N from {knob.low} to {knob.high}, got {text!r}")
            found[name] = int(text)
        return found

    def for_all(self, gains: Gains, joints: int) -> Values:
        """Equal gains for all ``joints``, with what they need beside."""
        found: dict[str, int] = {}
        for name, value in gains.items():
            knob = self.knobs[name]
            found |= dict(knob.beside if value else ()) | dict.fromkeys(knob.names, value)
        return {name: (value,) * joints for name, value in found.items()}


PAUSE = 0.05
"""[s] between steps (chosen: longer than a servo rings)"""
LOOKS = 6
"""Further looks at a servo that labours (chosen: 0.3 s)"""


def steps(before: ServoGains, wanted: ServoGains, strides: Mapping[str, int]) -> Iterator[tuple[str, list[int]]]:
    """Yield names and values to write, one per joint, in small steps; `LIMIT` rises first and falls last."""
    ways = [(name, before[name], wanted[name]) for name in before if name in wanted and name != LIMIT]
    if LIMIT in wanted:
        most = tuple(map(max, before[LIMIT], wanted[LIMIT]))
        ways = [(LIMIT, before[LIMIT], most), *ways, (LIMIT, most, wanted[LIMIT])]
    for name, here, there in ways:
        now, stride = list(here), abs(strides[name])
        while now != list(there):
            now = [min(max(end, value - stride), value + stride) for value, end in zip(now, there, strict=True)]
            yield name, now


class TunedServos(ABC):
    """Servos of n joints with gains; the ``wanted`` ones hold on every connection."""

    def __init__(self, kind: ServoKind, names: Sequence[str], wanted: ServoGains) -> None:
        """``names`` (n,) of the servos, in messages."""
        self.kind, self.names, self._wanted = kind, names, wanted
        self.gains: Values = {}
        """in force"""

    @abstractmethod
    def read_gains(self) -> Values:
        """Gains in force."""

    @abstractmethod
    def write_gain(self, name: str, values: Sequence[int]) -> None:
        """Set one gain of all servos."""

    @abstractmethod
    def strain(self, joint: int) -> tuple[float, float]:
        """Share of the largest torque, and temperature [deg C]."""

    @abstractmethod
    def relieve(self, joint: int) -> None:
        """Let a joint's servos hold where they stand."""

    @abstractmethod
    def wait(self, duration: float) -> None:
        """Wait [s]."""

    def servo_gains(self) -> ServoGains | None:
        """Return the servo gains by name; None: unknown."""
        return dict(self.gains) or None

    def rungs(self) -> tuple[Rung, ...]:
        """Return the search order of gains."""
        return tuple(rung for rung in self.kind.ladder if rung.names[0] in self.gains)

    def tune(self, gains: ServoGains) -> None:
        """Set gains in small steps, also on later connections; RobotError where a servo does not bear them."""
        self.walk(gains)
        self._wanted = dict(gains)

    def prepare_gains(self) -> None:
        """Read the gains, and set the wanted ones."""
        self.gains = self.read_gains()
        self.walk(self._wanted, hottest=HOTTEST)

    def walk(self, wanted: ServoGains, *, hottest: float = np.inf) -> None:
        """Set gains in small steps, on this connection."""
        before, joints = self.gains, len(self.names)
        strange = [name for name in wanted if name not in before or len(wanted[name]) != joints]
        if strange:
            known = f"{', '.join(before)} of {joints} joints"
            raise RobotError(f"expected gains {known}, got {', '.join(strange)}")
        there, strides = self.read_gains(), self.kind.strides
        for name, values in steps(there, wanted, strides):  # a walk that a lost connection cut short goes on
            self._take(name, values)
            try:
                if not ending():
                    self._require_strength(name, values, there[name], hottest)
            except OverloadedError:
                for back in steps(self.read_gains(), before, strides):
                    self._take(*back)
                raise
        self.gains = self.read_gains()

    def _take(self, name: str, values: Sequence[int]) -> None:
        self.write_gain(name, values)
        self.wait(PAUSE)

    def _require_strength(self, name: str, values: Sequence[int], there: Sequence[int], hottest: float) -> None:
        for joint, (old, value) in enumerate(zip(there, values, strict=True)):
            if (value - old) * self.kind.strides[name] <= 0:
                continue  # else one that labours could not be relieved
            load, heat = self._strain(joint)
            if load > HEAVIEST:  # by a goal that friction keeps it from
                self.relieve(joint)
                load, heat = self._strain(joint)
            if load > HEAVIEST or heat > hottest:
                raise OverloadedError(
                    f"{self.names[joint]} does not bear {name}={value}: load {100 * load:.0f} %, {heat:.0f} deg C; the "
                    "gains are as before",
                    joint,
                )

    def _strain(self, joint: int) -> tuple[float, float]:
        load, heat = self.strain(joint)
        for _ in range(LOOKS if load > HEAVIEST else 0):  # while it moves there it may labour
            self.wait(PAUSE)
            load = min(load, self.strain(joint)[0])
        return load, heat


def _degrees(text: str) -> tuple[float, ...]:
    try:
        found = tuple(map(float, text.split(",")))
    except ValueError:
        found = ()
    if not found or not all(-180.0 <= angle <= 180.0 for angle in found):
        raise ValueError(f"expected zero=DEG,DEG,... from -180 to 180, one per joint, got {text!r}")
    return found


@value_type
class ServoAddress:
    """A bus of servos, and what is known of its arm."""

    kind: ClassVar[ServoKind]
    driven: ClassVar[Gains] = {}
    """gains while the arm is driven, unless the owner says others"""
    options: ClassVar[dict[str, Callable[[str], Any]]] = {
        "calibration": lambda text: Path(text).expanduser().absolute(),
        "zero": _degrees,
    }
    """how further fields are read"""

    wire: Wire
    calibration: Path | None = None
    """LeRobot's; None: none"""
    zero: tuple[float, ...] = ()
    """[deg] of each joint in mid-range; empty: unsaid"""
    ids: tuple[tuple[int, ...], ...] = ()
    """servos of each joint; empty: in the calibration, or counted from the arm's first"""
    gains: Gains = field(default_factory=dict)
    """empty: unchanged"""

    @property
    def spot(self) -> str:
        """Equal for all its addresses."""
        return self.wire.spot

    @property
    def zeros(self) -> str:
        """Fingerprint of what says where zero is; empty if nothing."""
        file = self.calibration
        data = file.read_bytes() if file is not None and file.exists() else b""
        return digest(data + repr(self.zero).encode()) if data or self.zero else ""

    def middle(self, arm: Arm) -> Array:
        """Angles (n,) [rad] in mid-range, where LeRobot has its zeros; InputError."""
        if self.zero and len(self.zero) != arm.joints:
            raise InputError(f"zero= of the address needs {arm.joints} angles, one per joint, got {len(self.zero)}")
        return np.radians(self.zero or (0.0,) * arm.joints)

    @classmethod
    def read(cls, text: str) -> Self:
        """Read ``SCHEME:///dev/DEVICE`` or ``SCHEME://HOST:PORT``, with options; ValueError."""
        wire, given = read_wire(text, *cls.options, *cls.kind.knobs)
        more = {name: read(given.pop(name)) for name, read in cls.options.items() if name in given}
        return cls(wire=wire, gains=cls.kind.read_gains(given), **more)
