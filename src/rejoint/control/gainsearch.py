"""A safe search for better gains of the servos' own loops, on the arm itself.

The arm is sent to a few targets, each commanded once, again and again, with one value more of one gain each time. Every
joint judges for itself: it takes a value that brings it nearer to its command and leaves it as quiet, else it goes
back to the one before; where it gets loud, or two values in a row do not help, it is done with that gain. A joint that
shakes, labours or gets warm ends the round at once. At the end the gains are as they were.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.control.controller import ControlInput
from rejoint.control.default import DefaultController
from rejoint.control.guard import GuardLimits
from rejoint.control.loop import Schedule, run
from rejoint.control.robot import Mask
from rejoint.control.servogains import HEAVIEST, HOTTEST, Rung, Tunable, gains_in_force, limits_under, put_back
from rejoint.control.start import begin
from rejoint.system.errors import InputError, NotReadyError
from rejoint.system.progress import Progress, no_progress

DWELL = 2.5
"""[s] at each target (chosen: an arm that is sent there once rests after 1.5)"""
LOOKED = 0.8
"""[s] at its end that are looked at (chosen: several periods of a servo that hunts)"""
GAIN = 0.25
"""[counts] by which a joint has to come nearer, in the mean of the targets (chosen: what three readings leave open)"""
LOUDER = 1.5
"""times the unrest at the start that a joint may have (chosen), but always `QUIET`"""
QUIET = 1.0
"""[counts] of unrest that count as none (chosen: an encoder on the edge of a count)"""
SHAKES = np.radians(2.0)
"""[rad] to and fro within `LOOKED`, long after the command, at which a round ends (chosen: 20 counts)"""
LABOURS = 1.0
"""[s] of a load beyond `HEAVIEST` at which it ends as well (chosen: half of what trips a servo)"""

Values = dict[str, tuple[int, ...]]


@dataclass(frozen=True, kw_only=True)
class Round:
    """What a round over the targets showed."""

    error: tuple[float, ...]
    """(n,) [rad] mean distance of each joint from its command"""
    unrest: tuple[float, ...]
    """(n,) [rad] mean standard deviation of each joint at rest"""
    tool: float
    """[m] mean distance of the tool from its target, by the encoders"""


@dataclass(frozen=True, kw_only=True)
class GainsFound:
    """What a search found; gains by name, one of each joint."""

    arm: str
    robot: str
    """address"""
    found: Values
    """as they were, and are again"""
    under: Values
    """best for a controller that itself removes what is left: without the last rung, the I part of the servos"""
    alone: Values
    """best for the servos alone"""
    before: Round
    with_under: Round
    with_alone: Round
    rounds: int
    """that were driven"""


def search(
    robot: Tunable, targets: Array, *, limits: GuardLimits | None = None, on_progress: Progress = no_progress
) -> GainsFound:
    """Try the rungs of ``robot``, one arm, at ``targets`` (K, 3) [m]; InputError where it has none.

    Whatever ends it early, a signal, the guard, a servo that does not bear a step, the gains before are set first.
    """
    before = gains_in_force(robot)
    if before is None or not robot.rungs():
        raise InputError(f"{robot.address} has no servo gains that could be tuned; an SO-101 on its own bus has")
    found = {name: tuple(values) for name, values in before.items()}
    climb = _Climb(robot, targets, limits, dict(found), on_progress)
    with put_back(robot, found):
        start = begin(robot, limits)
        climb.sent = start.command[-1]
        climb.drive(targets[-1:])
        first = climb.best = climb.drive(targets)
        if first.bad.any():
            names = ", ".join(np.array(robot.arm.joint_names)[first.bad])
            raise NotReadyError(
                f"{names}: warmer than {HOTTEST:.0f} deg C, shaking, or giving more than {100 * HEAVIEST:.0f} % of the "
                "torque already under the gains that are there; let the arm cool down, then the same command goes on"
            )
        *others, last = robot.rungs()
        for rung in others:
            climb.rung(rung, first)
        under, middle = climb.confirm(found, first)
        climb.rung(last, first)
        alone, end = climb.confirm(under, middle)
    return GainsFound(
        arm=robot.arm.name, robot=robot.address, found=found, under=under, alone=alone, before=_round(first),
        with_under=_round(middle), with_alone=_round(end), rounds=climb.rounds,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class _Shown:
    error: Array
    unrest: Array
    tool: float
    bad: Mask
    """(n,) joints that ended the round"""


@dataclass(eq=False)
class _Climb:
    robot: Tunable
    targets: Array
    limits: GuardLimits | None
    gains: Values
    on_progress: Progress
    sent: Array | None = None
    best: _Shown = field(init=False)
    rounds: int = 0

    def rung(self, rung: Rung, first: _Shown) -> None:
        """Climb a rung, every joint as far as it goes."""
        done, missed = np.zeros((2, len(first.error)), dtype=bool)
        for value in rung.values:
            old = self.gains
            present = np.array(old[rung.names[0]])
            beyond = present >= value if rung.rising else present <= value
            trying: Mask = ~done & ~beyond
            if not trying.any():
                continue
            total = sum(len(one.values) for one in self.robot.rungs()) + 2
            self.on_progress(min(self.rounds / total, 1.0), f"{rung.names[0]} {value}")
            while trying.any():
                self.gains = _with(old, rung, value, trying)
                self.robot.tune(self.gains)
                seen = self.drive(self.targets)
                if not seen.bad.any():
                    break
                done |= seen.bad | (trying if not (trying & seen.bad).any() else False)
                trying &= ~done
            else:  # no joint bears it
                self.gains = old
                self.robot.tune(old)
                continue
            nearer, loud = self._compare(seen, first)
            taken = trying & nearer & ~loud
            done |= trying & (loud | (missed & ~taken))  # one value that does not help may be friction
            missed = trying & ~taken
            self.gains = _with(old, rung, value, taken)
            self.robot.tune(self.gains)
            self.best = replace(
                self.best, error=np.where(taken, seen.error, self.best.error),
                unrest=np.where(taken, seen.unrest, self.best.unrest),
            )  # fmt: skip

    def confirm(self, last: Values, before: _Shown) -> tuple[Values, _Shown]:
        """Drive under what the joints took one by one; where they do not bear it together, go back to the ``last``."""
        if self.gains == last:
            return last, before
        seen = self.drive(self.targets)
        if seen.bad.any() or seen.error.sum() > before.error.sum():
            self.gains, seen = last, before
            self.robot.tune(last)
        self.best = seen
        return dict(self.gains), seen

    def _compare(self, seen: _Shown, first: _Shown) -> tuple[Mask, Mask]:
        """Joints (n,) that are nearer to their commands than ever, and those that are less quiet than at the start."""
        step = self.robot.arm.encoder_step
        nearer: Mask = seen.error < self.best.error - GAIN * step
        return nearer, seen.unrest > np.maximum(LOUDER * first.unrest, QUIET * step)

    def drive(self, targets: Array) -> _Shown:
        """Drive to all targets once, and look."""
        watch = _RoundWatch(self.robot.arm)
        limits = limits_under(self.limits, self.robot, None)
        recording = run(
            self.robot, DefaultController(self.robot.arm), targets[None],
            Schedule(dwell=DWELL, sent=self.sent, give_up=watch.bad), limits=limits,
        )  # fmt: skip
        self.rounds += 1
        self.sent = recording.command[-1]
        arm, index, since = self.robot.arm, recording.target_index[:, 0], recording.since_target[:, 0]
        error, unrest, tool = [], [], []
        for k, target in enumerate(targets):
            rows = (index == k) & (since > DWELL - LOOKED)
            if watch.joints.any() or not rows.any():
                nothing = np.full(arm.joints, np.inf)
                return _Shown(error=nothing, unrest=nothing, tool=np.inf, bad=watch.joints)
            here = recording.position[rows, 0]
            error.append(np.abs(recording.command[rows, 0] - here).mean(axis=0))
            unrest.append(here.std(axis=0))
            tool.append(np.linalg.norm(tcp_position(arm, here) - target, axis=-1).mean())
        return _Shown(
            error=np.mean(error, axis=0), unrest=np.mean(unrest, axis=0), tool=float(np.mean(tool)), bad=watch.joints
        )


class _RoundWatch:
    """Ends a round as soon as a joint shakes, labours or gets warm."""

    def __init__(self, arm: Arm) -> None:
        self.joints: Mask = np.zeros(arm.joints, dtype=bool)
        self._labours = np.zeros(arm.joints)
        self._seen: list[tuple[float, Array]] = []
        self._last: float | None = None

    def bad(self, inputs: ControlInput) -> Mask:
        """Tell (1,) whether the round is to end, see `Schedule.give_up`."""
        state, now = inputs.state, float(inputs.state.time[0])
        elapsed = 0.0 if self._last is None else now - self._last
        self._last = now
        if state.temperature is not None:
            self.joints |= state.temperature[0] > HOTTEST
        if state.load is not None:
            heavy = np.abs(state.load[0]) > HEAVIEST
            self._labours = np.where(heavy, self._labours + elapsed, 0.0)
            self.joints |= self._labours > LABOURS
        if inputs.since_target[0] < LOOKED:
            self._seen.clear()
        else:
            self._seen = [one for one in self._seen if now - one[0] < LOOKED] + [(now, state.position[0].copy())]
            if inputs.since_target[0] > 2 * LOOKED:  # it is long there
                self.joints |= np.ptp([one for _, one in self._seen], axis=0) > SHAKES
        return np.array([bool(self.joints.any())])


def _with(gains: Values, rung: Rung, value: int, joints: Mask) -> Values:
    """Gains with a ``value`` of a rung at ``joints`` (n,)."""
    set_to = {**dict.fromkeys(rung.names, value), **dict(rung.beside)}
    return {
        name: tuple(set_to[name] if name in set_to and take else old for old, take in zip(values, joints, strict=True))
        for name, values in gains.items()
    }


def _round(seen: _Shown) -> Round:
    return Round(error=tuple(seen.error.tolist()), unrest=tuple(seen.unrest.tolist()), tool=seen.tool)
