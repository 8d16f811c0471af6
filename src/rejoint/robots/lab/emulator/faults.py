"""Faults of an emulated arm: ``drop=0.05,stall=1.5/4,freeze=3@5,die@20``.

Times in seconds after the first byte of a client, joints from 1. Every fault has its own random stream.
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array
from rejoint.system.errors import InputError

if TYPE_CHECKING:
    from rejoint.robots.lab.plant.plant import Plant

Mask = NDArray[np.bool_]

HOT_JOINT = 2
"""Joint that gets hot by default: the shoulder (chosen)"""


@dataclass(frozen=True, kw_only=True)
class Stall:
    """Spans with a stalled link."""

    duration: float
    """[s]"""
    every: float
    """[s] between beginnings; the first comes after it"""


@dataclass(frozen=True, kw_only=True)
class Onset:
    """A fault that begins, and may end, for some servos or the link."""

    joints: tuple[int, ...] = ()
    """from 0; empty: the link"""
    after: float
    """[s]"""
    duration: float = math.inf
    """[s]"""

    def holds(self, elapsed: float) -> bool:
        """Whether it holds ``elapsed`` [s] after the first byte."""
        return self.after <= elapsed < self.after + self.duration


@dataclass(frozen=True, kw_only=True)
class Faults:
    """All faults; `FORMS` explains them."""

    drop: float = 0.0
    garbage: float = 0.0
    stale: float = 0.0
    split: float = 0.0
    half: float = 0.0
    double: float = 0.0
    echo: float = 0.0
    slow: float = 0.0
    """[s]"""
    stall: Stall | None = None
    gone: tuple[Onset, ...] = ()
    silent: float | None = None
    """[s]"""
    die: float | None = None
    """[s]"""
    freeze: tuple[Onset, ...] = ()
    blind: tuple[Onset, ...] = ()
    jump: tuple[Onset, ...] = ()
    limit: tuple[Onset, ...] = ()
    overheat: tuple[Onset, ...] = ()
    current: tuple[Onset, ...] = ()
    overload: tuple[Onset, ...] = ()
    voltage: tuple[Onset, ...] = ()
    mute: tuple[Onset, ...] = ()
    sag: float = 0.0
    """[ohm]"""


SERVO_BUS = ("mute", "sag")
"""Faults of arms on their servo bus only"""
NONE = Faults()


FORMS: dict[str, str] = {
    "drop": "=P",
    "garbage": "=P",
    "stale": "=P",
    "split": "=P",
    "half": "=P",
    "double": "=P",
    "echo": "=P",
    "slow": "=S",
    "stall": "=D/E",
    "gone": "=T/D",
    "silent": "@T",
    "die": "@T",
    "freeze": "=J@T",
    "blind": "=J@T",
    "jump": "=J@T",
    "limit": "=J@T",
    "overheat": "[=J]@T",
    "current": "=J@T",
    "overload": "=J@T",
    "voltage": "[=J]@T",
    "mute": "=J@T/D",
    "sag": "=R",
}
"""How faults are written behind their names, which are fields of `Faults`; optional parts in brackets. `rejoint emulate
--help` explains them"""

_REPEATABLE = {field.name for field in fields(Faults) if field.default == ()}


def parse_faults(text: str, joints: int) -> Faults:
    """Read comma-separated faults; InputError."""
    found: dict[str, list[object]] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        name = re.split("[=@]", item)[0]
        if name not in FORMS:
            raise InputError(f"'{item}' is no known fault; known are {', '.join(FORMS)}, see rejoint emulate --help")
        try:
            value = _read(name, item.removeprefix(name), joints)
        except ValueError:
            wanted = f"{name}{FORMS[name]}, see rejoint emulate --help, with a joint J from 1 to {joints}"
            raise InputError(f"expected the fault {wanted}; got '{item}'") from None
        found.setdefault(name, []).append(value)
        if name not in _REPEATABLE and len(found[name]) > 1:
            raise InputError(f"the fault {name} may be given once, got '{text}'")
    values = {name: tuple(values) if name in _REPEATABLE else values[0] for name, values in found.items()}
    return Faults(**values)  # type: ignore[arg-type]  # `FORMS` reads each field as what it is


def _read(name: str, text: str, joints: int) -> object:
    optional = FORMS[name].replace("[", "(?:").replace("]", ")?")
    match = re.fullmatch(re.sub("[A-Z]", lambda letter: f"(?P<{letter[0]}>[^=@/]+)", optional), text)
    if match is None:
        raise ValueError
    joint = match.groupdict().get("J")
    numbers = {letter: float(word) for letter, word in match.groupdict().items() if letter != "J"}
    if not all(0.0 <= number < math.inf for number in numbers.values()) or numbers.get("P", 0.0) > 1.0:
        raise ValueError
    if "E" in numbers:
        if numbers["D"] >= numbers["E"]:
            raise ValueError
        return Stall(duration=numbers["D"], every=numbers["E"])
    if name not in _REPEATABLE:
        return numbers.popitem()[1]
    chosen: tuple[int, ...]
    if joint is not None:
        chosen = (range(joints).index(int(joint) - 1),)
    else:
        chosen = {"overheat": (min(HOT_JOINT, joints) - 1,), "voltage": tuple(range(joints))}.get(name, ())
    return Onset(joints=chosen, after=numbers["T"], duration=numbers.get("D", math.inf))


SPLIT_PAUSE = 0.05
"""[s] between the pieces of an answer (chosen)"""
MOST_GARBAGE = 12
"""[bytes] (chosen)"""

_CHANCES = ("drop", "garbage", "stale", "split", "half", "double", "echo")


class LinkGoneError(Exception):
    """The connection is gone."""


class DeathError(Exception):
    """The emulator must end silently."""


class WireFaults:
    """Applies faults to a link; times in [s] after the first byte."""

    def __init__(self, faults: Faults, seed: int = 0) -> None:
        self._faults = faults
        self._streams = {name: np.random.default_rng([seed, place]) for place, name in enumerate(_CHANCES)}
        # id -> the last request of this id and what was answered
        self._earlier: dict[int, tuple[bytes, bytes]] = {}

    @property
    def delay(self) -> float:
        """[s] extra time of every answer."""
        return self._faults.slow

    def check(self, elapsed: float) -> None:
        """DeathError after the end, LinkGoneError without a link."""
        if self._faults.die is not None and elapsed >= self._faults.die:
            raise DeathError
        if any(gone.holds(elapsed) for gone in self._faults.gone):
            raise LinkGoneError

    def still_until(self, elapsed: float) -> float:
        """End of a stall, else ``elapsed``."""
        if self._faults.silent is not None and elapsed >= self._faults.silent:
            return math.inf
        stall = self._faults.stall
        if stall is None or elapsed < stall.every:
            return elapsed
        begin = stall.every * math.floor(elapsed / stall.every)
        return max(elapsed, begin + stall.duration)

    def pieces(self, request: bytes, answer: bytes) -> list[bytes]:
        """Pieces sent instead of ``answer``, with a `SPLIT_PAUSE` between; empty: lost."""
        hit = {name: self._draw(name) for name in _CHANCES}
        answer = self._perhaps_old(request, answer, old=hit["stale"])
        if hit["drop"]:
            return []
        if hit["half"]:
            answer = answer[: self._cut("half", answer)]
        if hit["garbage"]:
            answer = self._with_garbage(answer)
        if hit["echo"]:
            answer = request + answer
        if hit["double"]:
            answer = answer * 2
        if not hit["split"]:
            return [answer]
        cut = self._cut("split", answer)
        return [piece for piece in (answer[:cut], answer[cut:]) if piece]

    def _draw(self, name: str) -> bool:
        share: float = getattr(self._faults, name)
        return share > 0.0 and bool(self._streams[name].random() < share)

    def _perhaps_old(self, request: bytes, answer: bytes, *, old: bool) -> bytes:
        if not self._faults.stale:
            return answer
        command = request[3]
        asked, answered = self._earlier.get(command, (b"", b""))
        if old and asked == request:
            return answered
        self._earlier[command] = request, answer
        return answer

    def _with_garbage(self, answer: bytes) -> bytes:
        stream = self._streams["garbage"]
        noise = stream.bytes(int(stream.integers(1, MOST_GARBAGE, endpoint=True)))
        place = 0 if stream.random() < 0.5 else self._cut("garbage", answer)
        return answer[:place] + noise + answer[place:]

    def _cut(self, name: str, answer: bytes) -> int:
        return int(self._streams[name].integers(1, max(len(answer), 2)))


VOLTAGE_BIT, OVER_TEMPERATURE_BIT, OVER_CURRENT_BIT, OVERLOAD_BIT = 1 << 0, 1 << 2, 1 << 3, 1 << 5
"""Bits of the servo status (pymycobot 4.0.7, robot_info)"""
SUPPLY_VOLTAGE = 12.0
"""[V] (vendor's product parameters)"""


class Ailments:
    """Faults of n joints, added to measurements."""

    def __init__(self, joints: int) -> None:
        self.misreading = np.zeros(joints)
        """(n,) [rad] encoder errors"""
        self.warmth = np.zeros(joints)
        """(n,) [K] extra heat"""
        self.current = np.zeros(joints)
        """(n,) [A] least current"""
        self.voltage = np.full(joints, SUPPLY_VOLTAGE)
        """(n,) [V] supply"""
        self.alarms = np.zeros(joints, dtype=np.uint8)
        """(n,) status bits, besides over-temperature"""


class EmulatedArm(ABC):
    """An emulated arm of n joints; ``plant`` holds one arm."""

    def __init__(self, plant: Plant, arm: Arm) -> None:
        self.plant, self.arm, self.ailments = plant, arm, Ailments(arm.joints)

    @property
    def angles(self) -> Array:
        """(n,) [rad] by the encoders."""
        return self.plant.encoder()[0] + self.ailments.misreading

    @property
    def temperature(self) -> Array:
        """(n,) [deg C]."""
        return self.plant.temperature[0] + self.ailments.warmth

    @property
    def true_tcp(self) -> Array:
        """(3,) [m] true tool."""
        return self.plant.true_tcp()[0]

    @property
    def true_links(self) -> Array:
        """(n,) [rad] true links, behind play and flex."""
        return self.plant.link_position()[0]

    @abstractmethod
    def advance(self, duration: float) -> None:
        """Advance by [s]."""


READINGS = frozenset({0x20, 0x23, 0x3B, 0x3D, 0xD5})
"""Questions that read encoders"""

JUMP = np.radians(60.0)
"""[rad] of an impossible jump (chosen: a servo takes 0.4 s)"""
BEYOND_LIMIT = np.radians(3.0)
"""[rad] beyond a joint limit, still credible (chosen)"""
RUN_AWAY = np.radians(90.0)
"""[rad/s] of such a reading (chosen: below the joints' speed)"""
HEATING = 10.0
"""[K/s] (chosen: faster than real)"""
HOT = 85.0
"""[deg C] final (chosen: 15 K above the protection threshold)"""
CURRENT_SCALE = 3.25
"""[A] full scale: 500 steps of 6.5 mA (Feetech STS memory table)"""
LOW_VOLTAGE = 7.0
"""[V] of a broken supply (chosen)"""


class ArmFaults:
    """Begins the arm's faults in time."""

    def __init__(self, faults: Faults, arm: EmulatedArm) -> None:
        self._emulated = arm
        servos = arm.arm.joints
        onsets = [(onset.after, kind, onset.joints) for kind in BEGINNINGS for onset in getattr(faults, kind)]
        self._waiting = sorted(onsets)
        self._heating = np.zeros(servos, dtype=bool)
        # (n,) direction in which a reading runs; 0 for those that stand
        self._running = np.zeros(servos)
        # (n,) [rad] jumps that were not read yet
        self._jumped = np.zeros(servos)
        self._then = 0.0

    def advance(self, elapsed: float) -> None:
        """Advance faults to ``elapsed`` [s] after the first byte."""
        passed, self._then = elapsed - self._then, elapsed
        while self._waiting and self._waiting[0][0] <= elapsed:
            after, kind, joints = self._waiting.pop(0)
            BEGINNINGS[kind](self, np.isin(np.arange(self._emulated.arm.joints), joints))
            if after == 0.0:
                passed = np.inf
        if self._heating.any():
            self._go_on_heating(passed)
        if self._running.any():
            self._go_on_running(passed)

    def was_asked(self, command: int) -> None:
        """End a jump after one reading."""
        if command in READINGS and self._jumped.any():
            self._emulated.ailments.misreading -= self._jumped
            self._jumped[:] = 0.0

    def _inwards(self) -> Array:
        """(n,) 1 nearer to the lower limit, else -1."""
        arm = self._emulated.arm
        return np.where(self._emulated.angles < 0.5 * (arm.lower + arm.upper), 1.0, -1.0)

    def _jump(self, joints: Mask) -> None:
        jump = JUMP * self._inwards() * joints
        self._jumped += jump
        self._emulated.ailments.misreading += jump

    def _run_beyond(self, joints: Mask) -> None:
        self._running[joints] = -self._inwards()[joints]

    def _go_on_running(self, passed: float) -> None:
        arm, angles = self._emulated.arm, self._emulated.angles
        end = np.where(self._running > 0, arm.upper + BEYOND_LIMIT, arm.lower - BEYOND_LIMIT)
        left = np.where(self._running == 0, 0.0, np.maximum(self._running * (end - angles), 0.0))
        self._emulated.ailments.misreading += self._running * np.minimum(left, RUN_AWAY * passed)
        self._running[left <= RUN_AWAY * passed] = 0.0

    def _heat(self, joints: Mask) -> None:
        self._heating |= joints

    def _go_on_heating(self, passed: float) -> None:
        missing = np.maximum(HOT - self._emulated.temperature, 0.0)
        self._emulated.ailments.warmth += np.where(self._heating, np.minimum(missing, HEATING * passed), 0.0)

    def _alarm(self, joints: Mask, bit: int) -> None:
        ailments = self._emulated.ailments
        ailments.alarms[joints] |= bit
        if bit == OVER_CURRENT_BIT:
            ailments.current[joints] = CURRENT_SCALE
        if bit == VOLTAGE_BIT:
            ailments.voltage[joints] = LOW_VOLTAGE


BEGINNINGS: dict[str, Callable[[ArmFaults, Mask], object]] = {
    "freeze": lambda self, joints: self._emulated.plant.freeze(joints[None]),
    "blind": lambda self, joints: self._emulated.plant.blind(joints[None]),
    "jump": ArmFaults._jump,
    "limit": ArmFaults._run_beyond,
    "overheat": ArmFaults._heat,
    "current": lambda self, joints: self._alarm(joints, OVER_CURRENT_BIT),
    "overload": lambda self, joints: self._alarm(joints, OVERLOAD_BIT),
    "voltage": lambda self, joints: self._alarm(joints, VOLTAGE_BIT),
}
"""Actions of the arm's faults on servos (n,)"""
