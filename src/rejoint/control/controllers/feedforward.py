"""Model-based control: inverse kinematics, gravity feed-forward, an integrator, and a learned correction.

The command is raised by the servo's sag: gravity torque over stiffness. The integrator corrects slow joints, also for
the next target. A stuck joint is pushed harder until its reading changes; then most of that push is removed. Constants
without a source are chosen.
"""

from dataclasses import field
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from rejoint.arms import Arm, Array, Mask, gravity_torque
from rejoint.arms.kinematics import task
from rejoint.arms.workspace import heaviest_load, length_size, moves_tool, torque_size, unloaded_joints
from rejoint.control.controllers.classical import (
    FADE,
    GAIN,
    LONGEST_PERIOD,
    RATE,
    STEP_LIMIT,
    DlsStep,
    Pace,
    dls_step,
    fade,
    limit_lead,
    null_space,
)
from rejoint.control.controllers.observation import View
from rejoint.control.correction import tool_error
from rejoint.control.robot import ControlInput
from rejoint.system.errors import InputError
from rejoint.system.records import value_type

NOMINAL_STIFFNESS = 6.0
"""[N m/rad] of a worn myCobot's servos (chosen: twins have 3 to 12); other arms scale with load"""

LOOSEN, TAKEN_BACK, CALMER, CLOSE = float(np.radians(10.0)), 0.9, 0.7, 4e-4
"""[rad/s] fastest push of a stationary joint; removed share; remaining share when a joint breaks loose the other way;
[m] of a myCobot 280 without a push (chosen on family 1)"""

GENTLE, EARLY, LEAST_PUSH = 2e-3, 6.0, 0.5
"""Pushes are slower by the error over the [m] of a myCobot 280 and the time over the [s], and their least share (chosen
by `python -m benchmarks postures`)"""

HELD_BACK = np.radians(3.0)
"""[rad] excess over the last command that stops the integrator"""

SPEED_SMOOTHING = 0.5
"""Share of the newest difference"""


Constant = Annotated[float, Meta(ge=0.0, le=1e6)]
"""of a policy's law, in SI units; its file is refused with another (chosen)"""


@value_type
class FeedforwardGains:
    """Settings of the integrator."""

    rate: Constant = RATE
    """[1/s] integrated share of the step"""
    fade: Constant = FADE
    """[m] distance at which the steps fade to half"""
    learned_limit: Constant = float(np.radians(45.0))
    """[rad] largest correction (chosen: other joints make up for a stuck one)"""
    forgetting: Constant = 2.0
    """[1/s] decay of the correction's null-space part far from the target"""
    far: tuple[float, float] = (0.005, 0.015)
    """[m] distances between which that begins, and a new goal clears it"""
    moving: Constant = 0.1
    """[rad/s] of a moving joint (chosen: two encoder counts per 30 ms)"""


class FeedforwardController:
    """Gravity feed-forward with an integrator."""

    name = "feedforward"
    heeds_turn = True
    xp: Any = np
    """functions of the arrays; PyTorch's where the law is exported"""

    def __init__(
        self,
        arm: Arm,
        stiffness: Array | float | None = None,
        gains: FeedforwardGains | None = None,
        loosen: float = LOOSEN,
    ) -> None:
        """``stiffness`` (n,) or (B, n) [N m/rad]; ``loosen`` as `LOOSEN`, larger for arms longer than a myCobot 280."""
        self._arm, self._gains = arm, gains or FeedforwardGains()
        self.loosen = loosen * max(length_size(arm), 1.0)
        self.close, self.gentle = np.array([CLOSE, GENTLE]) * length_size(arm)
        stiffness = NOMINAL_STIFFNESS * torque_size(arm) if stiffness is None else stiffness
        self.stiffness = np.atleast_2d(np.asarray(stiffness, dtype=float) + np.zeros(arm.joints))
        if not (self.stiffness > 0.0).all():
            raise InputError(f"feedforward: stiffness must be positive in N m/rad, got {self.stiffness.tolist()}")
        self._pace, self._limits = Pace(), (arm.lower, arm.upper)
        self._clear(0)

    def _clear(self, count: int) -> None:
        n = self._arm.joints
        self._goal, self._raised, self._correction, self._speed, self._position = np.zeros((5, count, n))
        self._pushed, self._eager, self._came, self._asked = np.zeros((4, count, n))
        self._idle = np.zeros((count, n, n))  # projection onto the null space

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Take new goals of ``where`` (B,); corrections stay. Far from the target their null-space parts go."""
        if len(self._position) != len(inputs.sent):
            self.reset_learned(inputs, np.full(len(inputs.sent), True))
        self._take(inputs, where)
        distance = tool_error(self._arm, inputs.state.position, inputs.target)
        self._correction -= (where * self._far(distance))[:, None] * self._unneeded()

    def on_the_way(self, inputs: ControlInput) -> Mask:
        """Arms (B,) with moving goals."""
        return np.logical_or.reduce(inputs.goal != self._goal, axis=-1)

    def _unneeded(self) -> Array:
        """Null-space parts (B, n) [rad] of the corrections."""
        return (self._idle @ self._correction[..., None])[..., 0]

    def _far(self, distance: Array) -> Array:
        """Share (B,), from 0 near to 1 far, at ``distance`` (B,) [m]."""
        near, far = self._gains.far
        return ((distance - near) / (far - near)).clip(0.0, 1.0)

    def _take(self, inputs: ControlInput, where: Mask) -> None:
        goal = self._goal[where] = inputs.goal[where]
        self._eager[where], self._came[where] = 1.0, 0.0
        stiffness = np.broadcast_to(self.stiffness, self._goal.shape)[where]
        self._raised[where] = goal + gravity_torque(self._arm, goal) / stiffness
        jacobian = task(self._arm, goal, inputs.target[where], inputs.turn and inputs.turn[where])[1]
        self._idle[where] = null_space(jacobian[:, None], np.eye(self._arm.joints)).mT

    def command(self, inputs: ControlInput) -> Array:
        """See `Controller`."""
        seen = dls_step(self._arm, inputs.state.position, inputs.target, inputs.turn)
        self._asked = self.integrate(inputs, seen, np.linalg.norm(seen.error[:, :3], axis=-1))
        return self._asked.copy()

    def integrate(self, inputs: ControlInput, seen: DlsStep, distance: Array) -> Array:
        """Commands (B, n) [rad] that integrate the ``seen`` step and loosen stuck joints; ``distance`` (B,) [m]."""
        step = fade(seen.error, self._gains.fade) * seen.step
        extra, short = self.loosening(inputs, seen.step, distance), self._asked - inputs.sent
        held = abs(short) > HELD_BACK  # nothing winds up that is not sent
        step, extra = (self.xp.where(held & (short * one > 0.0), 0.0, one) for one in (step, extra))
        return self.correct(inputs, step, extra, distance)

    def loosening(self, inputs: ControlInput, step: Array, distance: Array) -> Array:
        """Push (B, n) [rad] of stuck joints; call `correct` next.

        ``step`` (B, n) [rad]: joint errors; ``distance`` (B,) [m]: tool errors.
        """
        xp, moved = self.xp, inputs.state.position - self._position
        elapsed = (inputs.state.time - self._pace.last).clip(0.0, LONGEST_PERIOD)[:, None]
        stays = ~self.on_the_way(inputs)[:, None]
        sticks = stays & (moved == 0.0)
        most = xp.amax(abs(step), axis=-1, keepdims=True).clip(1e-9)
        strength = (distance / self.gentle + inputs.since_target / EARLY).clip(LEAST_PUSH, 1.0)[:, None]
        added = (
            elapsed * self.loosen * strength * self._eager * (step / most) * (sticks & (distance > self.close)[:, None])
        )
        loose = stays & (moved * self._pushed > 0.0)
        taken, back = xp.where(loose, TAKEN_BACK * self._pushed, 0.0), loose * xp.sign(self._pushed)
        self._eager = xp.where(back * self._came < 0.0, CALMER * self._eager, self._eager)
        self._came, self._pushed = xp.where(loose, back, self._came), xp.where(sticks, self._pushed + added, 0.0)
        return added - taken

    def correct(self, inputs: ControlInput, step: Array, extra: Array, distance: Array) -> Array:
        """Integrate ``step`` (B, n) [rad] of slow joints and add ``extra`` (B, n) [rad]; returns the commands.

        ``distance`` as in `loosening`.
        """
        xp, position, speed, gains = self.xp, inputs.state.position, self._speed, self._gains
        moved, limit = self.on_the_way(inputs), gains.learned_limit
        if moved.any():
            self._take(inputs, moved)
        elapsed = self._pace.tick(inputs.state.time)[:, None]
        self._decay(distance, elapsed)
        later = elapsed > 0.0
        newest = xp.where(later, (position - self._position) / xp.where(later, elapsed, 1.0), speed)
        self._speed = speed = SPEED_SMOOTHING * newest + (1.0 - SPEED_SMOOTHING) * speed
        push = gains.rate * elapsed * step
        push = xp.where((abs(speed) > gains.moving) & (speed * push > 0.0), 0.0, push)
        self._position = xp.asarray(position, copy=True)
        # Bounded by itself, not by the measured position: on the way the command leads by the whole distance.
        self._correction = (self._correction + push + extra).clip(-limit, limit)
        return (self._raised + self._correction).clip(*self._limits)

    def _decay(self, distance: Array, elapsed: Array) -> None:
        """Let the null-space parts of corrections decay, after ``elapsed`` (B, 1) [s] at ``distance`` (B,) [m]."""
        if np.count_nonzero(distance > self._gains.far[0]):
            forgotten = self._far(distance)[:, None] * -np.expm1(-self._gains.forgetting * elapsed)
            self._correction -= forgotten * self._unneeded()

    def reset_learned(self, inputs: ControlInput, where: Mask) -> None:
        """Clear corrections of ``where`` (B,); call `reset` next."""
        if len(self._position) != len(inputs.sent):
            self._clear(len(inputs.sent))
        self._correction[where] = self._speed[where] = self._pushed[where] = 0.0
        self._asked[where] = inputs.sent[where]
        self._position[where] = inputs.state.position[where]
        self._pace.begin(inputs.state.time, where)

    def take_over(self, inputs: ControlInput, where: Mask) -> None:
        """Continue from another controller's command, where ``where`` (B,)."""
        self._correction[where] = inputs.sent[where] - self._raised[where]
        self._asked[where] = inputs.sent[where]
        self._pushed[where] = 0.0


@value_type
class CommandLaw:
    """Constants of a policy's law, part of a contract: a classical law plus a bounded correction.

    Park et al. 2024, equation 17: next command = position + damped least-squares step + action. The ``anchor`` is what
    the action is added to. ``measured``: the measured position, as printed. ``goal``: the command of the feed-forward
    controller (residual policy learning: Silver et al. 2018, arXiv:1812.06298; Johannink et al. 2019,
    arXiv:1812.03201). On a trajectory that controller acts alone.
    """

    anchor: Literal["goal", "measured"] = "measured"
    stiffness: tuple[Constant, ...] = ()
    """[N m/rad] in training (anchor ``goal``)"""
    learning: FeedforwardGains = field(default_factory=FeedforwardGains)
    """(anchor ``goal``)"""
    loosen: Constant = LOOSEN
    """[rad/s] push of stuck joints (anchor ``goal``)"""
    step_gain: Constant = GAIN
    step_limit: Constant = float(STEP_LIMIT)
    """[rad] largest element"""
    authority_floor: Constant = 0.0
    """[rad] least authority; above 0, policies move the arm away from its target"""
    authority_slope: Constant = 0.5
    """authority over the largest element of the step"""
    authority_limit: Constant = float(np.radians(4.0))
    """[rad] largest authority"""
    lead_limit: Constant = float(np.radians(20.0))
    """[rad] largest following error (anti-windup)"""
    load_penalty: Constant = 0.0
    """near the target the most loaded joint moves by 1 + this times less: load causes stick-slip (anchor ``goal``)"""
    load_penalty_distance: Constant = 0.003
    """[m] TCP distance of half of that (chosen)"""
    decay_start: Constant = 0.0
    """[s] after which corrections of unloaded joints decrease as a power of time (anchor ``goal``; Robbins and Monro
    1951); 0: never"""
    decay_power: Constant = 1.5
    """(chosen: 1 lets joints swing after 8 s, 2 stops more short)"""
    decay_step: Constant = float(np.radians(1.0))
    """[rad] largest step element with full corrections"""

    envelope_margin: Constant = float(np.radians(35.0))
    """[rad] from the goal posture (anchor ``goal``; chosen)"""


class Commander(FeedforwardController):
    """Turns actions into commands."""

    heeds_turn = False

    def __init__(self, arm: Arm, law: CommandLaw) -> None:
        if law.anchor == "goal" and len(law.stiffness) != arm.joints:
            raise InputError(f"the law needs the stiffness of {arm.joints} servos, got {list(law.stiffness)}")
        super().__init__(arm, np.array(law.stiffness) if law.anchor == "goal" else None, law.learning, law.loosen)
        load, self.law = heaviest_load(arm), law
        self.moves, self.unloaded = moves_tool(arm).astype(float), unloaded_joints(arm)
        self.spared = 1.0 - 1.0 / (1.0 + law.load_penalty * load / max(load.max(), 1e-9))

    def commands(self, inputs: ControlInput, view: View, action: Array) -> Array:
        """Commands (B, n) [rad] for actions (B, n) in [-1, 1]."""
        law, xp, position = self.law, self.xp, inputs.state.position
        largest = xp.amax(abs(view.step), axis=-1, keepdims=True)
        step = view.step * (law.step_limit / largest.clip(1e-12)).clip(None, 1.0)
        authority = (law.authority_floor + law.authority_slope * largest).clip(None, law.authority_limit)
        extra = authority * action.clip(-1.0, 1.0)
        if law.anchor == "measured":
            wanted = position + law.step_gain * step + extra
            return limit_lead(wanted, position, law.lead_limit).clip(*self._limits)
        near = 1.0 / (1.0 + (view.distance / law.load_penalty_distance) ** 2)
        step = fade(view.error, law.learning.fade) * step * (1.0 - near[:, None] * self.spared)
        extra = extra * self.moves
        if law.decay_start > 0.0:
            late = (law.decay_start / inputs.since_target.clip(law.decay_start)[:, None]) ** law.decay_power
            decayed = late + (1.0 - late) * (largest / law.decay_step).clip(None, 1.0) ** 2
            factor = xp.where(self.unloaded, decayed, 1.0)
            step, extra = factor * step, factor * extra
        extra = xp.where(self.on_the_way(inputs)[:, None], 0.0, extra)  # the law knows the way
        extra = extra + self.loosening(inputs, view.step, view.distance)
        wanted, margin = self.correct(inputs, step, extra, view.distance), law.envelope_margin
        return wanted.clip(inputs.goal - margin, inputs.goal + margin).clip(*self._limits)
