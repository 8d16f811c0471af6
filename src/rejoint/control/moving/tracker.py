"""The controller that follows: the inverse of the twin ahead of time, and an observer for what the twin does not know.

What it sends is the command under which the twin would move as is wanted a moment later, less what the observer says
pushes the joint, less its deviation in stiffness and damping that the worn servo has not. The delay costs nothing: what
is corrected is the deviation at which a command begins to work.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rejoint.arms import Arm, Array, dls, position_kinematics
from rejoint.control.controller import ControlInput
from rejoint.control.law import limit_position
from rejoint.control.moving.folding import home_of
from rejoint.control.moving.observer import PushObserver, Trust
from rejoint.control.moving.posture import PathPostures, joint_weights
from rejoint.control.moving.servos import Moment, Servos, command_for
from rejoint.control.pace import NOMINAL_PERIOD, Pace
from rejoint.control.robot import Mask

_LEAST_DELAY = 0.02
"""[s] that is believed where gains are chosen: a fit may put a part of it into the damping (that of an emulated SO-101
said 9 ms where it has 20, and joint 1 swung by 2 deg)"""
_RELIEF_DAMPING = 0.01  # [m] keeps what heavy joints take over finite (chosen: a fifth of the usual)
_SLOWER = 1.2  # times the usual period up to which a wire is as quick as ever (chosen: its jitter)
_SMOOTHING = 0.1  # share of the newest period in their mean (chosen)


@dataclass(frozen=True, kw_only=True)
class TrackerGains:
    """Settings; chosen on the worn arms 30001 to 30004, see docs/daily-use.md."""

    stiffness: float = 1.25
    """by which a joint is held stiffer than its servo does, as a share of that"""
    damping: float = 0.065
    """[s] the same of damping, over the servo's stiffness"""
    slow_damping: float = 0.12
    """[s] that is added to it where a joint is to move slowly: friction falls with the speed there, so that it would
    stick and slip (chosen on the worn arms 20001, 30001, 30009 and 10003: of 0.80 mm on circle-20s 0.73 are left, with
    0.2 s 0.79)"""
    slow: float = 0.08
    """[rad/s] up to about which a joint is slow (chosen there; 0.15 makes no difference)"""
    early: float = 0.0075
    """[s] beyond the twin's delay and half a control period, for which a command stands, by which commands go out: what
    the servo's own filter takes"""
    pace: float = 1.0
    """largest product of the frequency [rad/s] at which a joint so held would swing, and the time that passes until a
    command works and is read (measured: with 1.5 arms at a period of 50 ms, and healthy ones, swing for ever)"""
    step: float = 0.03
    """[s] between the places of a motion that speed and acceleration are taken from"""
    relief: float = 0.15
    """[s] in which heavy joints take over what light ones miss: one that is too weak for its load stays where it is. On
    two arms of family 0 that have such a joint 1.9 and 1.5 mm became 0.8 and 0.7 (0.05 to 0.4 s make no difference)"""
    push_limit: float = float(np.radians(30.0))
    """[rad] largest correction of what pushes a joint"""
    trust: Trust = field(default_factory=Trust)


class Tracker:
    """Follows targets that move, for B arms."""

    name = "tracker"

    def __init__(
        self, arm: Arm, servos: Servos, gains: TrackerGains | None = None, period: float = NOMINAL_PERIOD,
        home: Array | None = None,
    ) -> None:  # fmt: skip
        """``period`` [s] is the usual one of the control cycles, which the gains must suit.

        ``home`` (n,) or (B, n) [rad] is what the postures keep near to; by default what `home_of` says.
        """
        self._arm, self._servos, self._gains = arm, servos, gains or TrackerGains()
        self._usual = period
        self.home = home_of(arm, servos) if home is None else home
        """[rad] arms begin near it"""
        self._begun = False

    def reset(self, inputs: ControlInput, where: Mask) -> None:  # noqa: ARG002 - a gap in the answers forgets nothing
        """Begin where the arms are; later resets change nothing, since targets that move are no new ones."""
        if self._begun:
            return
        self._begun = True
        count = len(inputs.sent)
        now = np.zeros(1)
        turns = inputs.turns(now)
        begin = inputs.aims(now)[0], turns and turns[0]
        self._postures, self._seen = (PathPostures(self._arm, *begin, home=self.home) for _ in range(2))
        self._observer = PushObserver(self._arm, self._servos, self._gains.trust, self._usual)
        self._pace = Pace()
        self._pace.begin(inputs.state.time, np.ones(count, dtype=bool))
        self._wanted = self._expected = inputs.sent.copy()
        self._missed = np.zeros((count, 3))  # [m] by light joints, smoothed
        self._last: Array | None = None  # (B,) [s] when the last command went out
        self._period = np.full(count, self._usual)

    def command(self, inputs: ControlInput) -> Array:
        """Return what is to be sent, (B, n) [rad]."""
        gains, observer, now = self._gains, self._observer, inputs.state.time
        if self._last is not None:
            observer.sent(self._last, self._effective(inputs.sent) - self._wanted)
        elapsed = self._pace.tick(now)
        self._period += _SMOOTHING * (elapsed > 0.0) * (elapsed - self._period)
        position, planned = inputs.state.position, self._planned(inputs)
        shift = self._relieve(position, position - planned, elapsed)
        observer.see(now, elapsed, position - planned - shift)
        away, speed = observer.soon(now)
        motion = self._motion(inputs, shift)
        self._wanted, self._last = command_for(self._arm, self._servos, motion), now.copy()
        self._expected = motion.position + away
        push = np.clip(observer.push, -gains.push_limit, gains.push_limit)
        damping = gains.damping + gains.slow_damping * np.exp(-((motion.speed / gains.slow) ** 2))
        held = gains.stiffness * away + damping * speed
        return limit_position(self._arm, self._wanted - push - self._firm(observer.mass) * held)

    def _firm(self, mass: Array) -> Array:
        """Share (B, n) of the gains that joints of this ``mass`` (B, n) [kg m^2] bear at the delay and the period.

        A wire that grows slower on the way makes joints swing, with their readings as late as their commands.
        """
        slower = np.maximum(self._period - _SLOWER * self._usual, 0.0)
        late = (np.maximum(self._servos.delay, _LEAST_DELAY) + 0.5 * self._usual + slower)[:, None]
        most = (self._gains.pace / late) ** 2 * mass / self._servos.stiffness - 1.0
        return np.clip(most / self._gains.stiffness, 0.0, 1.0)

    def _relieve(self, position: Array, away: Array, elapsed: Array) -> Array:
        """Return how far (B, n) [rad] heavy joints go beside the plan for what light ones are ``away`` (B, n)."""
        light = joint_weights(self._arm) > 1.0
        jacobian = position_kinematics(self._arm, position)[1]
        missed = ((jacobian * light) @ away[..., None])[..., 0]
        self._missed += (1.0 - np.exp(-elapsed / self._gains.relief))[:, None] * (missed - self._missed)
        return dls(jacobian * ~light, -self._missed, _RELIEF_DAMPING)

    def _planned(self, inputs: ControlInput) -> Array:
        """Return the postures (B, n) [rad] that are wanted now."""
        return np.asarray(self._seen.at(inputs.aims(np.zeros(1)), inputs.turns(np.zeros(1)))[0])

    def _motion(self, inputs: ControlInput, shift: Array) -> Moment:
        step = self._gains.step
        ahead = self._servos.delay + 0.5 * self._period + self._gains.early
        later = ahead + step * np.arange(-1.0, 2.0)[:, None]
        plan = self._postures.at(inputs.aims(later), inputs.turns(later))
        return Moment(around=plan + shift, step=step)

    def _effective(self, sent: Array) -> Array:
        """Return ``sent`` (B, n) [rad], no farther from the joint than its servo makes more torque of: no windup."""
        joint = self._expected - self._servos.offset
        return np.clip(sent, joint - self._servos.most(), joint + self._servos.most())
