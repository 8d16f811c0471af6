"""Faults of an emulated arm: ``drop=0.05,stall=1.5/4,freeze=3@5,die@20``.

Times in seconds after a client's first byte. Every fault has its own random stream.
"""

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array
from rejoint.robots.wireserver import DeathError, LinkGoneError
from rejoint.system.errors import InputError
from rejoint.system.files import read_shipped
from rejoint_lab.plant.plant import Plant
from rejoint_lab.plant.wear import Wear, load_wear

HOT_JOINT = 2
"""Joint that gets hot by default: the shoulder (chosen)"""


class Fault(NamedTuple):
    """One fault; a form lacks what it does not need."""

    size: float = 0.0
    """chance, [s] or [ohm]"""
    joints: tuple[int, ...] = ()
    """from 0; empty: the link"""
    after: float = 0.0
    """[s]"""
    duration: float = math.inf
    """[s]"""
    every: float = math.inf
    """[s] between beginnings; the first comes after it"""

    def holds(self, elapsed: float) -> bool:
        """Whether it holds ``elapsed`` [s] after the first byte."""
        return self.after <= elapsed < self.after + self.duration


Faults = Mapping[str, tuple[Fault, ...]]
"""By name, see `FORMS`"""
NONE: Faults = {}

FORMS = read_shipped(__file__, "faults.toml", dict[str, str])
"""How faults are written"""
SERVO_BUS = ("mute", "same", "power", "sag")
"""Faults of arms on their servo bus only"""
_LETTERS = {"P": "size", "S": "size", "R": "size", "T": "after", "D": "duration", "E": "every"}


def parse_faults(text: str, joints: int) -> Faults:
    """Read comma-separated faults; InputError."""
    found: dict[str, tuple[Fault, ...]] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        name = re.split("[=@]", item)[0]
        if name not in FORMS:
            raise InputError(f"'{item}' is no known fault; known are {', '.join(FORMS)}, see rejoint emulate --help")
        try:
            fault = _read(name, item.removeprefix(name), joints)
        except ValueError:
            wanted = f"{name}{FORMS[name]}, see rejoint emulate --help, with a joint J from 1 to {joints}"
            raise InputError(f"expected the fault {wanted}; got '{item}'") from None
        if name in found and name != "gone" and "J" not in FORMS[name]:
            raise InputError(f"the fault {name} may be given once, got '{text}'")
        found[name] = (*found.get(name, ()), fault)
    return found


def _read(name: str, text: str, joints: int) -> Fault:
    optional = FORMS[name].replace("[", "(?:").replace("]", ")?")
    match = re.fullmatch(re.sub("[A-Z]", lambda letter: f"(?P<{letter[0]}>[^=@/]+)", optional), text)
    if match is None:
        raise ValueError
    words = match.groupdict()
    joint = words.pop("J", None)
    numbers = {letter: float(word) for letter, word in words.items()}
    possible = all(0.0 <= number < math.inf for number in numbers.values()) and numbers.get("P", 0.0) <= 1.0
    if not possible or numbers.get("D", 0.0) >= numbers.get("E", math.inf):
        raise ValueError
    chosen = {"overheat": (min(HOT_JOINT, joints) - 1,), "voltage": tuple(range(joints))}.get(name, ())
    if joint is not None:
        chosen = (range(joints).index(int(joint) - 1),)
    return Fault(joints=chosen, **{_LETTERS[letter]: number for letter, number in numbers.items()})


def in_force(faults: Faults, name: str, elapsed: float) -> list[Fault]:
    """Faults of a name that hold ``elapsed`` [s] after the first byte."""
    return [fault for fault in faults.get(name, ()) if fault.holds(elapsed)]


def size_of(faults: Faults, name: str) -> float:
    """Size of a fault that may be given once; 0 without it."""
    return sum(fault.size for fault in faults.get(name, ()))


SPLIT_PAUSE = 0.05
"""[s] between the pieces of an answer (chosen)"""
MOST_GARBAGE = 12
"""[bytes] (chosen)"""

_CHANCES = tuple(name for name, form in FORMS.items() if form == "=P")


class WireFaults:
    """Applies faults to a link; times in [s] after the first byte."""

    def __init__(self, faults: Faults, seed: int = 0) -> None:
        self._faults = faults
        self.delay = size_of(faults, "slow")
        """[s] extra time of every answer"""
        self._streams = {name: np.random.default_rng([seed, place]) for place, name in enumerate(_CHANCES)}
        # kind of a request, and head of its answer: the servo or command that it is of -> the last of both
        self._earlier: dict[tuple[int, bytes], tuple[bytes, bytes]] = {}

    def check(self, elapsed: float) -> None:
        """DeathError after the end, LinkGoneError without a link."""
        if in_force(self._faults, "die", elapsed):
            raise DeathError
        if in_force(self._faults, "gone", elapsed):
            raise LinkGoneError

    def still_until(self, elapsed: float) -> float:
        """End of a stall, else ``elapsed``."""
        if in_force(self._faults, "silent", elapsed):
            return math.inf
        for stall in self._faults.get("stall", ()):
            if elapsed >= stall.every:
                return max(elapsed, stall.every * math.floor(elapsed / stall.every) + stall.duration)
        return elapsed

    def pieces(self, request: bytes, answer: bytes) -> list[bytes]:
        """Pieces sent instead of ``answer``, with a `SPLIT_PAUSE` between; empty: lost."""
        chances = {name: size_of(self._faults, name) for name in _CHANCES if name in self._faults}
        hit = {name for name, chance in chances.items() if self._streams[name].random() < chance}
        if "stale" in self._faults:
            key = request[3], answer[: 5 if answer[2:4] == b"\xfd\x00" else 4]  # Dynamixel's has the ID behind
            asked, answered = self._earlier.get(key, (b"", b""))
            if "stale" in hit and asked == request:
                answer = answered
            else:
                self._earlier[key] = request, answer
        if "drop" in hit:
            return []
        if "half" in hit:
            answer = answer[: self._cut("half", answer)]
        if "garbage" in hit:
            stream = self._streams["garbage"]
            noise = stream.bytes(int(stream.integers(1, MOST_GARBAGE, endpoint=True)))
            place = 0 if stream.random() < 0.5 else self._cut("garbage", answer)
            answer = answer[:place] + noise + answer[place:]
        answer = ("echo" in hit) * request + answer
        answer *= 1 + ("double" in hit)
        cut = self._cut("split", answer) if "split" in hit else len(answer)
        return [answer[:cut], answer[cut:]] if cut < len(answer) else [answer]

    def _cut(self, name: str, answer: bytes) -> int:
        return int(self._streams[name].integers(1, max(len(answer), 2)))


OVER_TEMPERATURE_BIT = 1 << 2
BITS = {"voltage": 1 << 0, "current": 1 << 3, "overload": 1 << 5}
"""Bits of the servo status (pymycobot 4.0.7, robot_info)"""
BROKEN_VOLTAGE, FULL_CURRENT = 7.0, 3.25
"""[V] of a broken supply (chosen), [A] full scale: 500 steps of 6.5 mA (Feetech STS memory table)"""
SUPPLY_VOLTAGE = 12.0
"""[V] (vendor's product parameters)"""


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


class EmulatedArm(ABC):
    """An emulated arm of n joints, with faults that begin in time; its ``plant`` holds one arm."""

    kind: ClassVar[type[Plant]] = Plant
    """of its plant"""

    def __init__(self, arm: Arm, wear: Wear, *, seed: int = 0, **truth: Any) -> None:  # noqa: ANN401
        """Put the arm at rest; ``truth`` as of `Plant`."""
        self.plant, self.arm = self.kind(arm, [wear], seed=seed, **truth), arm
        self.faults = NONE
        self._elapsed = -1.0

    @classmethod
    def build(cls, arm: Arm, wear_name: str, *, seed: int = 0) -> Self:
        """Arm at rest with the wear profile ``wear_name``."""
        built = cls(arm, load_wear(wear_name, arm), seed=seed)
        built.advance(0.01)  # compiles the plant now instead of during the first request
        return built

    @property
    def angles(self) -> Array:
        """(n,) [rad] by the encoders."""
        true, arm = self.plant.encoder()[0], self.arm
        high = true >= 0.5 * (arm.lower + arm.upper)
        outwards, end = np.where(high, 1.0, -1.0), np.where(high, arm.upper + BEYOND_LIMIT, arm.lower - BEYOND_LIMIT)
        run = np.clip(RUN_AWAY * self._since("limit"), 0.0, np.maximum(outwards * (end - true), 0.0))
        return true + outwards * (run - JUMP * self._begun("jump"))

    @property
    def temperature(self) -> Array:
        """(n,) [deg C]."""
        true = self.plant.temperature[0]
        return true + np.maximum(np.minimum(HEATING * self._since("overheat"), HOT - true), 0.0)

    @property
    def voltage(self) -> Array:
        """(n,) [V] supply."""
        return np.where(self._begun("voltage"), BROKEN_VOLTAGE, SUPPLY_VOLTAGE)

    @property
    def least_current(self) -> Array:
        """(n,) [A]."""
        return np.where(self._begun("current"), FULL_CURRENT, 0.0)

    @property
    def alarms(self) -> NDArray[np.uint8]:
        """(n,) status bits of faults, besides over-temperature."""
        return np.sum([bit * self._begun(kind) for kind, bit in BITS.items()], axis=0).astype(np.uint8)

    def suffer(self, elapsed: float) -> None:
        """Let faults begin; ``elapsed`` [s] after the first byte."""
        self._elapsed = elapsed
        self.plant.freeze(self._begun("freeze")[None])
        self.plant.blind(self._begun("blind")[None])

    def was_read(self) -> None:
        """End jumps after one reading."""
        if "jump" in self.faults:
            later = tuple(fault for fault in self.faults["jump"] if fault.after > self._elapsed)
            self.faults = {**self.faults, "jump": later}

    def _since(self, kind: str) -> Array:
        """(n,) [s] since a fault began: below 0 not yet, infinite if it was there from the first byte."""
        since = np.full(self.arm.joints, -np.inf)
        for fault in in_force(self.faults, kind, self._elapsed):
            since[list(fault.joints)] = self._elapsed - fault.after if fault.after else np.inf
        return since

    def _begun(self, kind: str) -> NDArray[np.bool_]:
        return self._since(kind) >= 0.0

    @abstractmethod
    def advance(self, duration: float) -> None:
        """Advance by [s]."""
