"""Gains of the servos' position loops, and a safe search.

Whole numbers in servo units per joint, by name (``p``, ``i``, ``d``, ``dead``, ...). The search changes one gain at a
time; each joint keeps a value that reduces its error without unrest. Constants without a source are chosen.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np

from rejoint.arms import Arm, Array, Mask
from rejoint.control.comparison.protocols import visits
from rejoint.control.controllers.catalogue import POLICY, PREDICTIVE
from rejoint.control.controllers.classical import DefaultController
from rejoint.control.controllers.policy import PolicyContract
from rejoint.control.correction import tool_error
from rejoint.control.guard import GuardLimits
from rejoint.control.loop import Schedule, run
from rejoint.control.robot import ControlInput, Controller, Robot, part_of
from rejoint.control.start import begin
from rejoint.system.errors import ContractError, InputError, NotReadyError, RejointError, RobotError, first_line
from rejoint.system.progress import Progress, no_progress
from rejoint.system.records import Readable, entity, value_type
from rejoint.system.shell import Late
from rejoint.system.stopping import shielded

signal = Late("scipy.signal")

ServoGains = Mapping[str, tuple[int, ...]]
"""(n,) per name"""
HOTTEST, HEAVIEST = 55.0, 0.7
"""[deg C] and torque share that end a round"""


class OverloadedError(RobotError):
    """The servo of a ``joint`` does not bear new gains; the old ones are back."""

    def __init__(self, message: str, joint: int) -> None:
        super().__init__(message)
        self.joint = joint


@dataclass(frozen=True)
class Rung:
    """Values that a search tries."""

    names: tuple[str, ...]
    """gains set alike"""
    values: tuple[int, ...]
    rising: bool = True
    beside: tuple[tuple[str, int], ...] = ()
    """other gains set with it"""
    alone: bool = False
    """not for servos below a controller"""


@runtime_checkable
class Tunable(Protocol):
    """Servos with adjustable gains."""

    def servo_gains(self) -> ServoGains | None:
        """Gains in force; None: unknown."""

    def rungs(self) -> tuple[Rung, ...]:
        """Search order: the safest first."""

    def tune(self, gains: ServoGains) -> None:
        """Set gains in small steps until power-off; RobotError."""

    def keep(self, gains: ServoGains) -> None:
        """Set gains permanently."""


def gains_in_force(robot: Robot) -> ServoGains | None:
    """Gains in force; None: unknown."""
    servos = part_of(robot, Tunable)
    return None if servos is None else servos.servo_gains()


def own_gains(controller: object) -> ServoGains | None:
    """Gains that a ``controller`` drives under; None: those in force."""
    return getattr(controller, "servo_gains", None)


def tunable(robot: Robot) -> tuple[Tunable, ServoGains]:
    """Servos and gains of ``robot``; InputError if none can be set."""
    servos, before = part_of(robot, Tunable), gains_in_force(robot)
    if servos is None or before is None:
        raise InputError(f"{robot.address} has no servo gains that could be set; an SO-101 on its own bus has")
    return servos, before


@contextmanager
def under_gains(robot: Robot, controller: object) -> Iterator[None]:
    """Drive under the ``controller``'s gains, then restore the others; ContractError, InputError."""
    require_gains(robot, controller)
    if (wanted := own_gains(controller)) is not None:
        servos, before = tunable(robot)
        if differing(wanted, before):
            with put_back(servos, before):
                servos.tune(wanted)
                yield
            return
    yield


@contextmanager
def put_back(servos: Tunable, before: ServoGains) -> Iterator[None]:
    """Restore ``before`` at the end."""
    try:
        yield
    except BaseException as error:
        with shielded():
            try:
                servos.tune(before)
            except (RejointError, OSError) as other:  # the first error is the one to report
                error.add_note(
                    f"The servos' gains were not put back ({first_line(other)}). Before they were {in_words(before)}, "
                    "as they are again once the arm's power was off."
                )
        raise
    with shielded():
        servos.tune(before)


def limits_under(limits: GuardLimits | None, robot: Robot, controller: object) -> GuardLimits | None:
    """Limits under the gains of ``controller``."""
    gains = own_gains(controller) or gains_in_force(robot)
    if limits is None or limits.gains is None or gains is None or not differing(gains, limits.gains):
        return limits
    now = {**limits.gains, **gains}
    stiffer = stiffness_under(np.ones(limits.arm.joints), limits.gains, now)
    if limits.bands is None or "p" not in now or any(now.get("i", ())) or (stiffer < 1.0).any():
        return replace(limits, bands=None)
    return replace(limits, bands=replace(limits.bands, slope=limits.bands.slope / stiffer))


def require_gains(robot: Robot, controller: object) -> None:
    """Raise ContractError for a policy of other gains."""
    contract = getattr(controller, "contract", None)
    if not isinstance(contract, PolicyContract) or contract.servo_gains is None:
        return
    found = own_gains(controller) or gains_in_force(robot)
    if found is None or not (other := differing(contract.servo_gains, found)):
        return
    name, joint = other[0]
    ours, theirs = contract.servo_gains[name][joint], found[name][joint]
    raise ContractError(
        f"the policy was trained for servos with {name}={ours} at {robot.arm.joint_names[joint]}, and {name} is "
        f"{theirs} there; set it back ({in_words(contract.servo_gains)}), or repair the arm again"
    )


def differing(wanted: ServoGains, found: ServoGains) -> list[tuple[str, int]]:
    """Names and joints with different gains."""
    return [
        (name, joint)
        for name, values in wanted.items()
        for joint, value in enumerate(values)
        if name not in found or joint >= len(found[name]) or found[name][joint] != value
    ]


def stiffness_under(stiffness: Array, before: ServoGains | None, now: ServoGains | None) -> Array:
    """Stiffness (n,) [N m/rad] under the gains ``now``: proportional to P."""
    if before is None or now is None or "p" not in before or "p" not in now:
        return stiffness
    return stiffness * np.array(now["p"]) / np.maximum(before["p"], 1)


def in_words(gains: ServoGains) -> str:
    """Gains in words."""
    return ", ".join(
        f"{name} {values[0]}" if len(set(values)) == 1 else f"{name} {'/'.join(map(str, values))}"
        for name, values in gains.items()
    )


GEARED = "servo-gains"
"""Tuned servo loops alone; ``servo-gains+NAME``: below a controller"""
UNDER = ("integrator", "feedforward", POLICY, PREDICTIVE)
"""Controllers also run with tuned gains"""
RIVALS = (GEARED, *(f"{GEARED}+{name}" for name in UNDER))
GEARED_POLICY, GEARED_PREDICTIVE = (f"{GEARED}+{name}" for name in (POLICY, PREDICTIVE))


def inner_name(name: str) -> str:
    """Name the controller above tuned gains."""
    return DefaultController.name if name == GEARED else name.removeprefix(f"{GEARED}+")


def own_policy(names: Sequence[str]) -> str | None:
    """Name a run's own policy, or None."""
    return next((name for name in names if inner_name(name) == POLICY), None)


def geared(controller: Controller, gains: ServoGains) -> Controller:
    """Name a ``controller`` by the tuned ``gains`` that it drives under; returns it."""
    inner = controller.name
    vars(controller).update(name=GEARED if inner == DefaultController.name else f"{GEARED}+{inner}", servo_gains=gains)
    return controller


DWELL = 2.5
"""[s] at each target"""
LOOKED = 0.8
"""[s] evaluated at its end"""
GAIN = 0.25
"""[counts] least improvement"""
LOUDER = 1.5
"""allowed multiple of the first unrest"""
QUIET = 1.0
"""[counts] of no unrest"""
SHAKES = np.radians(2.0)
"""[rad] swing within `LOOKED` that ends a round"""
LABOURS = 1.0
"""[s] beyond `HEAVIEST` that end it"""


@entity
class Round:
    """Result of a round over the targets."""

    error: Array
    """(n,) [rad] mean error"""
    unrest: Array
    """(n,) [rad] mean standard deviation at rest"""
    tool: float
    """[m] mean tool error by the encoders"""


@value_type
class GainsFound(Readable):
    """Result of a search; gains by name, one per joint."""

    arm: str
    robot: str
    """address"""
    found: ServoGains
    """before and after the search"""
    under: ServoGains
    """best below a controller"""
    alone: ServoGains
    """best for the servos alone"""
    before: Round
    with_under: Round
    with_alone: Round
    rounds: int
    """driven"""


def search(
    robot: Robot, targets: Array, *, limits: GuardLimits | None = None, on_progress: Progress = no_progress
) -> GainsFound:
    """Try the rungs of ``robot``, one arm, at ``targets`` (K, 3) [m], and restore its gains; InputError."""
    servos, found = tunable(robot)
    climb = _Climb(robot, servos, targets, limits, found, on_progress)
    with put_back(servos, found):
        climb.sent = begin(robot, limits).command[-1]
        climb.drive(found, targets[-1:])
        first, bad = climb.drive(found)
        if first is None:
            names = ", ".join(np.array(robot.arm.joint_names)[bad])
            raise NotReadyError(
                f"{names}: warmer than {HOTTEST:.0f} deg C, shaking, or giving more than {100 * HEAVIEST:.0f} % of the "
                "torque already under the gains that are there; let the arm cool down, then the same command goes on"
            )
        climb.first = climb.best = first
        under, with_under = climb.climb(alone=False)
        alone, with_alone = climb.climb(alone=True)
    return GainsFound(
        arm=robot.arm.name,
        robot=robot.address,
        found=found,
        under=under,
        alone=alone,
        before=first,
        with_under=with_under,
        with_alone=with_alone,
        rounds=climb.rounds,
    )


@dataclass(eq=False)
class _Climb:
    robot: Robot
    servos: Tunable
    targets: Array
    limits: GuardLimits | None
    gains: ServoGains
    on_progress: Progress
    sent: Array | None = None
    first: Round = field(init=False)
    """under the gains that were there"""
    best: Round = field(init=False)
    """so far"""
    error: Array = field(init=False)
    """(n,) [rad] least so far in this climb"""
    rounds: int = 0

    def climb(self, *, alone: bool) -> tuple[ServoGains, Round]:
        """Climb rungs and drive once more; returns the gains and round that are best now."""
        last, self.error = self.gains, self.best.error
        for rung in self.servos.rungs():
            if rung.alone == alone:
                self.rung(rung)
        if self.gains != last:
            seen, _ = self.drive(self.gains)
            if seen is None or seen.error.sum() > self.best.error.sum():
                self.gains = last
                self.servos.tune(last)
            else:
                self.best = seen
        return self.gains, self.best

    def rung(self, rung: Rung) -> None:
        """Give each joint the best value; it ends where it is loud or bad, and after two values that do not help."""
        done, missed = np.full((2, self.robot.arm.joints), False)
        step, sign = self.robot.arm.encoder_step, 1 if rung.rising else -1
        total = sum(len(one.values) for one in self.servos.rungs()) + 2
        for value in rung.values:
            old = self.gains
            trying = ~done & (sign * np.array(old[rung.names[0]]) < sign * value)
            if not trying.any():
                continue
            self.on_progress(min(self.rounds / total, 1.0), f"{rung.names[0]} {value}")
            seen, bad = self.drive(_with(old, rung, value, trying))
            if seen is None:
                done |= bad if (trying & bad).any() else trying
                self.gains = old
                self.servos.tune(old)
                continue
            loud = seen.unrest > np.maximum(LOUDER * self.first.unrest, QUIET * step)
            taken = trying & ~loud & (seen.error < self.error - GAIN * step)
            done |= trying & (loud | (missed & ~taken))  # one value that does not help may be friction
            missed = trying & ~taken
            self.gains = _with(old, rung, value, taken)
            self.servos.tune(self.gains)
            self.error = np.where(taken, seen.error, self.error)

    def drive(self, gains: ServoGains, targets: Array | None = None) -> tuple[Round | None, Mask]:
        """Return what a round under ``gains`` shows, or None, and the joints (n,) that ended it."""
        if gains != self.gains:
            try:
                self.servos.tune(gains)
            except OverloadedError as heavy:  # ends the rung for this joint alone
                return None, np.arange(self.robot.arm.joints) == heavy.joint
            self.gains = gains
        arm, targets, watch = self.robot.arm, self.targets if targets is None else targets, _RoundWatch(self.robot.arm)
        schedule = Schedule(dwell=DWELL, sent=self.sent, give_up=watch.bad)
        limits = limits_under(self.limits, self.robot, None)
        recording = run(self.robot, DefaultController(arm), targets[None], schedule, limits=limits)
        self.rounds += 1
        self.sent = recording.command[-1]
        if watch.joints.any():
            return None, watch.joints
        found = []
        for _, k, visit in visits(recording, len(targets)):
            last = visit.at(visit.since_target > DWELL - LOOKED)
            tool = tool_error(arm, last.position, targets[k]).mean()
            unrest = signal.detrend(last.position, axis=0).std(axis=0)  # an I part that still pulls is none
            found.append((np.abs(last.command - last.position).mean(axis=0), unrest, tool))
        error, unrest, tools = (np.mean(part, axis=0) for part in zip(*found, strict=True))
        return Round(error=error, unrest=unrest, tool=float(tools)), watch.joints


class _RoundWatch:
    def __init__(self, arm: Arm) -> None:
        self.joints = np.full(arm.joints, False)
        self._labours = np.zeros(arm.joints)
        self._seen: list[tuple[float, Array]] = []
        self._last = np.inf

    def bad(self, inputs: ControlInput) -> bool:
        """Whether the round ends."""
        state, now = inputs.state, inputs.state.time[0]
        elapsed, self._last = max(now - self._last, 0.0), now
        if state.temperature is not None:
            self.joints |= state.temperature[0] > HOTTEST
        if state.load is not None:
            self._labours = np.where(np.abs(state.load[0]) > HEAVIEST, self._labours + elapsed, 0.0)
            self.joints |= self._labours > LABOURS
        self._seen = [one for one in self._seen if now - one[0] < LOOKED] + [(now, state.position[0])]
        if inputs.since_target[0] > 2 * LOOKED:  # it is long there
            self.joints |= np.ptp([one for _, one in self._seen], axis=0) > SHAKES
        return bool(self.joints.any())


def _with(gains: ServoGains, rung: Rung, value: int, joints: Mask) -> ServoGains:
    set_to = {**dict.fromkeys(rung.names, value), **dict(rung.beside)}
    return {
        name: tuple(set_to.get(name, old) if take else old for old, take in zip(values, joints, strict=True))
        for name, values in gains.items()
    }
