"""Joints that do not follow: how soon frozen and blind encoders are noticed, and whether others are taken for them.

    python -m benchmarks following --arms 64 --first 0

Arms are drawn, driven through their diagnosis, and then by every controller to targets of their own; where encoders
break, once more with the same noise and a fault. Two monitors look on and stop nothing, so that both see the same
motion: one that knows at which pushes joints stand by the arm's own diagnosis, and one that is told nothing but
positions.

``--first`` is added to all seeds: constants are chosen with
other draws than those that judge them.
"""

import time
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array, Mask, mycobot280
from rejoint.arms.postures import find_postures
from rejoint.control.controllers.catalogue import SHELF, make_controller
from rejoint.control.guard import GuardLimits, guard, warm_up
from rejoint.control.monitor import Bands, Following, standing_bands
from rejoint.control.robot import ControlInput
from rejoint.diagnosis.excitation import DiagnosisLogs, record
from rejoint.diagnosis.measurement import measure
from rejoint.system.errors import GuardTripError
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.servo import Channel, Keys
from rejoint_lab.plant.wear import Wear, load_wear

ARM = mycobot280()
LIMITS = GuardLimits.of(ARM)
CONTROLLERS = ("default", "integrator", "feedforward", SHELF)
PROFILES = ("worn", "healthy", "play-in-loop")
KINDS = (*PROFILES, "stuck")
BREAKING = {"worn": ("frozen", "blind"), "healthy": ("frozen", "blind")}
"""How encoders break, by kind of arm"""
STUCK = (5.0, 10.0, 15.0, 1000.0)
"""[deg] of lead at which a stuck joint moves"""
SLOW = Channel(latency=(0.008, 0.030), age=(0.006, 0.030), period=(0.045, 0.055))
WIRES = {"25ms": Channel(), "50ms": SLOW, "stalling": SLOW, "late": SLOW}
"""Wires; the slow ones keep commands and readings up to 30 ms under way. After the diagnosis one of them stalls, and
the arm behind another one is late with what it has acknowledged"""
STALLS, STALL = 0.25, (0.02, 0.12)
"""Share of the cycles in which a wire stalls, and [s] for how long (chosen: a busy computer)"""
LATE = 0.1
"""Share of the cycles whose command comes late, by as long as a wire stalls, in cycles as long as ever (chosen: an arm
whose own computer is busy)"""
TARGETS, DWELL = 4, 2.5
"""Targets of a run, and [s] for each"""
FAR = 0.030
"""[m] off its way that the tool may be before the trip"""
MONITORS = ("diagnosed", "positions alone")


@dataclass(frozen=True, kw_only=True)
class Stalling:
    """A channel that stalls: some commands come late, and their cycles are longer by as much, or not at all."""

    channel: Channel
    share: float = STALLS
    longer: bool = True

    def draw(self, keys: Keys, cycle: NDArray[np.int64]) -> Array:
        """Delays of cycle number ``cycle`` (B,) for the arms with these stream keys (B,)."""
        latency, age, period = self.channel.draw(keys, cycle)
        low, high = np.array(self.channel).T[..., None]
        _, share, chance = (self.channel.draw(keys, cycle + 2**40) - low) / (high - low)
        late = np.where(chance < self.share, STALL[0] + share * (STALL[1] - STALL[0]), 0.0)
        return np.stack([latency + late, age, period + late * self.longer])


@dataclass(frozen=True)
class Faults:
    """What breaks, and when: joints (B,), clocks (B,) [s], blind or frozen."""

    joint: Array
    at: Array
    blind: bool

    def break_now(self, robot: EmulatedRobot, done: Mask) -> None:
        """Break what is due and not ``done`` (B,) yet."""
        due = (robot.plant.time >= self.at) & ~done
        if due.any():
            joints = (np.arange(ARM.joints) == self.joint[:, None]) & due[:, None]
            (robot.plant.blind if self.blind else robot.plant.freeze)(joints)
            done |= due


@dataclass(frozen=True)
class Seen:
    """What came of one run; the lists are by monitor."""

    wire: str
    kind: str
    controller: str
    fault: str
    tripped: list[bool]
    """after the fault; where there is none: at all"""
    early: list[bool]
    """tripped before the fault"""
    off: list[float]
    """[m] how far the tool was off its way at the trip, or at most where there was none"""
    worst: list[float]
    """[m] how far it was off its way until then, at most"""
    joint: list[int]
    """that tripped, -1 for none"""


def stuck(wear: Wear, joint: int, lead_deg: float) -> Wear:
    """Make a ``joint`` of a ``wear`` move at leads above ``lead_deg`` only."""
    friction = wear.position_gain[joint] * np.radians(lead_deg)
    coulomb, stiction = wear.coulomb.copy(), wear.stiction.copy()
    coulomb[joint], stiction[joint] = friction, 1.1 * friction
    return replace(wear, name=f"{wear.name}, joint {joint + 1} stuck", coulomb=coulomb, stiction=stiction)


def draw(kind: str, count: int, seed: int) -> list[Wear]:
    """Draw arms of a profile, or of all with a stuck joint."""
    rng = np.random.default_rng([seed, len(kind)])
    if kind != "stuck":
        return [load_wear(f"{kind}?seed={seed + i}", ARM) for i in range(count)]
    plain = [load_wear(f"{PROFILES[i % 3]}?seed={seed + i}", ARM) for i in range(count)]
    return [stuck(wear, int(rng.integers(5)), float(rng.choice(STUCK))) for wear in plain]


def opened(wears: list[Wear], wire: str, seed: int, first: int = 0) -> EmulatedRobot:
    """Return arms behind a wire."""
    robot = EmulatedRobot(ARM, wears, seed=seed, first=first, channel=WIRES[wire])
    if wire in ("stalling", "late"):
        robot._channel = Stalling(
            channel=SLOW,
            share=STALLS if wire == "stalling" else LATE,
            longer=wire == "stalling",
        )
    return robot


def recorded(wears: list[Wear], wire: str, seed: int, first: int = 0) -> list[DiagnosisLogs | None]:
    """Drive each arm through its diagnosis; None for one in which the guard ends it."""
    try:
        return list(record(opened(wears, wire, seed, first), seed=0))
    except GuardTripError as error:
        if len(wears) == 1:
            print(f"a diagnosis was ended: {wears[0].name}: {error}", flush=True)
            return [None]
        half = len(wears) // 2
        return recorded(wears[:half], wire, seed, first) + recorded(wears[half:], wire, seed, first + half)


def diagnosed(wears: list[Wear], wire: str, seed: int) -> Bands:
    """See what the logs of each arm's diagnosis tell; of one that was ended nothing is known."""
    bands = []
    for logs in recorded(wears, wire, seed):
        pair = () if logs is None else (logs.excitation, logs.targets)
        law = 2 * [np.full(ARM.joints, np.nan)] if logs is None else measure(ARM, logs.excitation).balance(ARM)
        bands.append(standing_bands(ARM, pair, *law))

    fields = ("slope", "offset", "reach", "width", "stood", "lifted")
    return Bands(**{name: np.array([getattr(one, name) for one in bands]) for name in fields})


@dataclass(frozen=True)
class Driven:
    """What came of a batch; by monitor (M, B) the clock of the first trip (or infinite), and its joint."""

    trip: Array
    joint: Array
    path: Array
    """(T, B, 3) [m] the tool"""
    clock: Array
    """(T, B) [s]"""


def drive(wears: list[Wear], name: str, wire: str, seed: int, known: Bands, faults: Faults | None = None) -> Driven:
    """Drive a batch with nobody but the guard, and see what the monitors say."""
    count = len(wears)
    robot = opened(wears, wire, seed)
    controller = make_controller(name, ARM)
    goals = ARM.targets.sample(np.random.default_rng(seed), (count, TARGETS))
    state, sent = robot.read(), robot.read().position
    watchers = [
        Following(ARM, state, sent, known),
        Following(ARM, state, sent),
    ]
    trip, joint = np.full((len(watchers), count), np.inf), np.full((len(watchers), count), -1)
    done, aimed, speed = np.zeros(count, bool), np.ones(count, bool), np.zeros_like(sent)
    index, begun, period = np.full(count, -1), np.full(count, -np.inf), np.full(count, 0.02)
    path, clock, posture = [], [], sent.copy()
    while (state.time < TARGETS * DWELL).any():
        renewed = (state.time - begun >= DWELL) & (index < TARGETS - 1)
        index, begun = index + renewed, np.where(renewed, state.time, begun)
        path.append(robot.true_tcp()), clock.append(state.time.copy())
        for m, watcher in enumerate(watchers):
            bad = watcher.check(replace(state, load=None), sent, aimed)
            new = bad.any(axis=-1) & np.isinf(trip[m])
            trip[m, new], joint[m, new] = state.time[new], bad.argmax(axis=-1)[new]
        inputs = ControlInput(
            state=state, target=goals[np.arange(count), index], goal=posture, sent=sent, since_target=state.time - begun
        )
        if renewed.any():
            posture[renewed] = find_postures(ARM, goals[renewed, index[renewed]], sent[renewed], None)
            controller.reset(inputs, renewed)
        sent, _, speed = guard(LIMITS, controller.command(inputs), sent, speed, state, period)
        if faults is not None:
            faults.break_now(robot, done)
        before, state = state, robot.step(sent)
        period = state.time - before.time
    return Driven(trip, joint, np.array(path), np.array(clock))


def compare(whole: Driven, driven: Driven, at: Array) -> list[dict[str, Any]]:
    """Tell of each run how far the tool was from where that of the ``whole`` arm is; encoders broke ``at`` (B,) [s]."""
    length, arms = min(len(whole.path), len(driven.path)), np.arange(driven.trip.shape[1])
    off = np.linalg.norm(driven.path[:length] - whole.path[:length], axis=-1)
    worst = np.maximum.accumulate(off, axis=0)  # an arm may be far off and come back before the trip
    tripped = np.isfinite(driven.trip) & (driven.trip >= at)
    row = np.array([np.argmax(driven.clock[:length] >= trip, axis=0) for trip in driven.trip])
    seen = {
        "tripped": tripped,
        "early": driven.trip < at,
        "joint": driven.joint,
        "off": np.where(tripped, off[row, arms], worst[-1]),
        "worst": np.where(tripped, worst[row, arms], worst[-1]),
    }
    return [{name: value[:, b].tolist() for name, value in seen.items()} for b in arms]


def watched(wire: str, kind: str, count: int, first: int) -> list[Seen]:
    """Drive ``count`` arms of a kind by every controller, whole and broken."""
    seed = first + 1000 * KINDS.index(kind)
    wears, seen = draw(kind, count, seed), []
    known = diagnosed(wears, "25ms" if wire == "25ms" else "50ms", seed)
    for c, name in enumerate(CONTROLLERS):
        whole = drive(wears, name, wire, seed + c, known)
        found = {"none": compare(whole, whole, np.zeros(count))}
        for fault in BREAKING.get(kind, ()):
            rng = np.random.default_rng([seed, c, len(fault)])
            at, joint = rng.uniform(0.5, (TARGETS - 1) * DWELL, count), rng.integers(0, 5, count)
            broken = drive(wears, name, wire, seed + c, known, Faults(joint, at, fault == "blind"))
            found[fault] = compare(whole, broken, at)
        seen += [Seen(wire, kind, name, fault, **one) for fault, runs in found.items() for one in runs]
    return seen


def say(seen: list[Seen]) -> None:
    """Print what the monitors saw."""
    print(f"{'wire':>8} {'arms':>12} {'runs':>5}  false trips: {'; '.join(MONITORS)}")
    for wire in WIRES:
        for kind in KINDS:
            runs = [one for one in seen if (one.wire, one.kind, one.fault) == (wire, kind, "none")]
            if runs:
                wrong = np.sum([one.tripped for one in runs], axis=0).tolist()
                print(f"{wire:>8} {kind:>12} {len(runs):>5}  {wrong}")
    for wire in WIRES:
        for kind, fault in ((kind, fault) for kind, faults in BREAKING.items() for fault in faults):
            runs = [one for one in seen if (one.wire, one.kind, one.fault) == (wire, kind, fault)]
            for m, monitor in enumerate(MONITORS if runs else ()):
                tripped = [1e3 * one.off[m] for one in runs if one.tripped[m]]
                fine = sum(one.worst[m] <= FAR for one in runs)
                spread = np.percentile(tripped, [50, 90, 100]).round(1).tolist() if tripped else "none"
                print(
                    f"{wire} {kind:>8} {fault:>6}  {monitor:>23}: tripped {len(tripped)} of {len(runs)}, tool off at "
                    f"the trip 50, 90, 100 %: {spread} mm; never {1e3 * FAR:.0f} mm off before it {fine}; tripped "
                    f"before the fault {sum(one.early[m] for one in runs)}"
                )


def main(arms: int = 64, first: int = 0, wires: str = ",".join(WIRES)) -> None:
    """Drive ``arms`` of each kind; ``first`` is added to all seeds."""
    warm_up(LIMITS)
    seen = []
    for wire, kind in product(wires.split(","), KINDS):
        start, found = time.perf_counter(), watched(wire, kind, arms, first)
        print(f"{wire} {kind}: {len(found)} runs in {time.perf_counter() - start:.0f} s", flush=True)
        seen += found
    say(seen)
