"""Where every arm of a run is in its sequence of targets, and what is known of its clock."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.arms.orientation import Orientation
from rejoint.control.controller import ControlInput
from rejoint.control.correction import Correction
from rejoint.control.following import Following
from rejoint.control.limits import GuardLimits, Reasons
from rejoint.control.robot import JointState, Mask
from rejoint.control.route import Route
from rejoint.control.stillness import Stillness
from rejoint.system.errors import InputError

FIRST_PERIOD = 0.02
"""[s] period assumed before one has been measured (chosen: the shortest regular one, so the smallest first step)."""

GAP = 0.8
"""[s] without an answer after which an arm goes on as from a start (chosen: longer than a lost answer and a stall of
half a second, after which a usual step is as good as before; shorter than a new connection takes)"""
GAP_PERIODS = 3.0
"""Times the usual period that a gap also exceeds (chosen: where periods of half a second were asked for)"""
LATE_PERIODS = 2.0
"""Times the usual period from which a cycle is late: the arm may move as far as in a usual one, not farther (chosen)"""
_SMOOTHING = 0.1  # share of the newest period in that mean (chosen)

ELSEWHERE = np.radians(5.0)
"""[rad] by which a joint may have left the way to its last command in a pause (chosen: what its sag changes there, and
as much as a joint may hunt at the start)"""
_ROUNDING = 1e-6  # [s] of a difference of times, many times over
EASE = 1.0
"""[s] after a gap during which an arm may move at `EASE_SHARE` of its speed only (chosen: long enough to be seen)"""
EASE_SHARE = 0.2
"""(chosen: the share that `move` takes by default)"""


def elsewhere(before: Array, command: Array, position: Array) -> Mask:
    """Tell which arms (B,) are at a ``position`` (B, n) [rad] to which the last ``command`` (B, n) did not bring them.

    ``before`` (B, n) is where they were when it was sent. Whoever holds, lags or sags stays on the way between the two.
    """
    low, high = np.minimum(before, command) - ELSEWHERE, np.maximum(before, command) + ELSEWHERE
    return np.logical_or.reduce((position < low) | (position > high), axis=-1)


def in_force(state: JointState, sent: Array) -> Array:
    """Return the command (B, n) [rad] from which arms go on that were last ``sent`` (B, n) one.

    That is where they stand for arms that no longer know it: to send it once more would throw them there.
    """
    known = np.array(sent, dtype=float)
    return known if state.elsewhere is None else np.where(state.elsewhere[:, None], state.position, known)


@dataclass(kw_only=True, eq=False)
class RunState:
    """Where every arm is in its sequence of targets."""

    state: JointState
    targets: Array
    sent: Array
    speed: Array
    index: NDArray[np.intp]
    set_at: Array
    """(B,) [s] when the target was set; later by the gaps since then, see `_wait`"""
    active: Mask
    tripped: Reasons
    period: Array
    following: Following
    stillness: Stillness
    slow: Array
    """(n,) [rad/s] at which an arm may move after a gap"""
    correction: Correction | None = None
    route: Route | None = None
    """where the only target of each arm goes, None where targets stand still"""
    turns: Orientation | None = None
    """(B, K) how the tools are to be turned at the targets, None where that does not matter"""
    unbelieved: Mask | None = None
    """(B, n) joints whose readings are not believed in this cycle, None where all are"""
    wanted: Array = field(init=False)
    """(B, n) [rad] what the controller wanted in the newest cycle, before the guard"""
    last_time: Array = field(init=False)
    usual: Array = field(init=False)
    """(B,) [s] running mean of the periods; NaN before one has been measured"""
    gap: Mask = field(init=False)
    """(B,) whether the state came after a gap"""
    eased_until: Array = field(init=False)
    """(B,) [s]"""
    doubted: NDArray[np.intp] = field(init=False)
    """(B,) times that an arm went on after a joint that was not believed broke loose"""
    aim: Array = field(init=False)
    """(B, 3) [m] where the controllers are sent: the targets, or what a correction makes of them"""
    turn: Orientation | None = field(init=False, default=None)
    """(B,) how the tools are to be turned there by the encoders, None where that does not matter"""

    def __post_init__(self) -> None:
        self.last_time, self.wanted = self.state.time, self.sent
        count = len(self.sent)
        self.usual, self.eased_until = np.full(count, np.nan), np.full(count, -np.inf)
        self.gap, self.doubted = np.zeros(count, dtype=bool), np.zeros(count, dtype=np.intp)
        self.aim = self.target
        self._take_aim(np.ones(count, dtype=bool))

    @classmethod
    def begin(
        cls, state: JointState, targets: Array, sent: Array | None, limits: GuardLimits,
        correction: Correction | None = None, route: Route | None = None, turns: Orientation | None = None,
    ) -> RunState:  # fmt: skip
        """Begin with ``targets`` (B, K, 3) [m] and the command in force, ``sent`` (B, n) [rad]; None: the position."""
        count = len(targets)
        if sent is not None and np.shape(sent) != state.position.shape:
            raise InputError(f"schedule: sent has shape {np.shape(sent)}, expected {state.position.shape}")
        told = np.array(state.position if sent is None else sent, dtype=float)
        sent = in_force(state, told)
        begun = cls(
            state=state, targets=targets, sent=sent, speed=np.zeros_like(sent), index=np.zeros(count, dtype=np.intp),
            set_at=state.time.copy(), active=np.ones(count, dtype=bool), tripped=np.zeros(count, dtype=np.uint16),
            period=np.full(count, FIRST_PERIOD),
            following=Following(limits.arm, state, sent, limits.servos, bands=limits.bands), correction=correction,
            stillness=Stillness(state, sent, limits.arm.encoder_step), slow=EASE_SHARE * limits.max_speed, route=route,
            turns=turns,
        )  # fmt: skip
        if state.elsewhere is not None:
            begun._ease(state.elsewhere, told)
        return begun

    @property
    def target(self) -> Array:
        """(B, 3) [m] in force."""
        if self.route is not None:
            return self.route.place(self.state.time - self.set_at)
        return self.targets[np.arange(len(self.index)), self.index]

    def inputs(self) -> ControlInput:
        """Return what a controller knows."""
        since = self.state.time - self.set_at
        return ControlInput(
            state=self.state, target=self.aim, sent=self.sent, since_target=since, route=self.route, turn=self.turn
        )  # fmt: skip

    def leave_out(self, longest: float, dwell: float) -> None:
        """Let the time since the target was set jump to its ``dwell`` [s] where an arm stood for the ``longest`` [s].

        Asked for in every cycle, or in none.
        """
        enough = self.stillness.look(self.state, self.sent) >= longest
        if np.count_nonzero(enough):
            over = self.state.time - dwell - _ROUNDING
            self.set_at = np.where(enough, np.minimum(self.set_at, over), self.set_at)

    def advance(self, finished: Mask) -> Mask:
        """Set the next target where the present one is finished; returns the arms that got one."""
        last = self.index == self.targets.shape[1] - 1
        renewed = finished & ~last
        self.active = self.active & ~(finished & last)
        self.index = self.index + renewed
        self.set_at = np.where(renewed, self.state.time, self.set_at)
        if renewed.any():
            self._take_aim(renewed)
        return renewed

    def aim_again(self) -> Mask | None:
        """Let the correction change aims on the way; returns the arms (B,) whose aim changed, None where none did."""
        fresh = None if self.correction is None else self.correction.again(self.target, self.inputs())
        if fresh is None:
            return None
        changed = self.active & (fresh != self.aim).any(axis=-1)
        self.aim = np.where(changed[:, None], fresh, self.aim)
        return changed

    def _take_aim(self, where: Mask) -> None:
        """Aim at the targets that were just set for the arms in ``where`` (B,)."""
        if self.route is not None:
            now = self.state.time - self.set_at
            at_once = np.zeros((1, len(now)))
            self.aim, turn = self.route.aims(now, at_once)[0], self.route.turns(now, at_once)
            self.turn = None if turn is None else turn[0]
            return
        target = self.target
        turn = None if self.turns is None else self.turns[np.arange(len(self.index)), self.index]
        if self.correction is None:
            fresh = target
        elif turn is None:
            fresh = self.correction.aim(target, self.sent, where)
        else:
            fresh, turn = self.correction.aim_pose(target, turn, self.sent, where)
        self.aim, self.turn = np.where(where[:, None], fresh, self.aim), turn

    def stepped(self, state: JointState, command: Array, speed: Array) -> None:
        """Take over what the robot was sent and what it answered."""
        self.sent, self.speed = np.where(self.active[:, None], command, self.sent), speed
        elapsed = state.time - self.last_time
        self.gap = elapsed > np.fmax(GAP, GAP_PERIODS * self.usual)
        late = elapsed > LATE_PERIODS * self.usual  # NaN: not known yet
        # A repeated answer has no news of the clock: the last period stands.
        self.period = np.where(elapsed > 0.0, np.where(late, self.usual, elapsed), self.period)
        known = np.where(np.isnan(self.usual), elapsed, self.usual)
        moved = np.zeros(len(elapsed), dtype=bool)
        if np.count_nonzero(self.gap):
            self._wait(self.gap, elapsed)
            moved = self.gap & elsewhere(self.state.position, self.sent, state.position)
        self.usual = np.where(elapsed > 0.0, known + _SMOOTHING * (np.minimum(elapsed, GAP) - known), self.usual)
        self.state, self.last_time = state, state.time
        if self.route is not None:
            self._take_aim(self.active)
        if np.count_nonzero(self.gap):
            self._begin_again(self.gap, moved)

    def go_on(self, where: Mask) -> None:
        """Let arms (B,) go on, as after a gap, whose joints were led back and broke loose meanwhile."""
        self.doubted = self.doubted + where
        if self.unbelieved is not None:
            self.following.believe(self.state, self.sent, self.unbelieved & where[:, None])
        self._wait(where, self.state.time - self.last_time)
        self.last_time = np.where(where, self.state.time, self.last_time)
        self.gap = self.gap | where
        self._begin_again(where, np.zeros(len(where), dtype=bool))

    def _wait(self, where: Mask, elapsed: Array) -> None:
        """Leave a gap of ``elapsed`` (B,) [s] out of the time that targets, trajectories and paths take.

        What goes by the clock waits for its arm: it would have to be caught up with at full speed otherwise. A route
        that arrives as it goes does not wait.
        """
        if self.route is not None:
            where = where & self.route.waits
        usual = np.where(np.isnan(self.usual), FIRST_PERIOD, self.usual)
        self.set_at = np.where(where, self.set_at + (elapsed - usual), self.set_at)

    def _begin_again(self, where: Mask, moved: Mask) -> None:
        """After a gap, nothing is known of what happened: go on as from a start."""
        self.period = np.where(where, FIRST_PERIOD, self.period)
        self.eased_until = np.where(where, self.state.time + EASE, self.eased_until)
        # An arm that sags keeps its command; one that stands elsewhere no longer knows it.
        far = where[:, None] & (np.abs(self.sent - self.state.position) > GuardLimits.max_lead)
        told, self.sent = self.sent, np.where(far | moved[:, None], self.state.position, self.sent)
        self._ease(moved, told)
        self.speed = np.where(where[:, None], 0.0, self.speed)

    def _ease(self, where: Mask, told: Array) -> None:
        """Let arms that stand elsewhere move slowly until they had the time to be where they were ``told`` to be."""
        way = np.max(np.abs(told - self.state.position) / self.slow, axis=-1)
        self.eased_until = np.where(where, self.state.time + EASE + way, self.eased_until)

    @property
    def ease(self) -> Array:
        """(B,) share of its speed at which an arm may move: less of it after a gap."""
        return np.where(self.state.time < self.eased_until, EASE_SHARE, 1.0)


def own(state: JointState) -> JointState:
    """Copy what is kept beyond this cycle: a robot may reuse its arrays."""
    load = None if state.load is None else state.load.copy()
    return replace(state, time=state.time.copy(), position=state.position.copy(), load=load)


def reported_load(state: JointState) -> Array:
    """Return the loads (B, n) that a state tells; NaN where it tells none."""
    return np.full(state.position.shape, np.nan) if state.load is None else state.load
