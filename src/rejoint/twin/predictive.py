"""Predictive control: a plan on the arm's own twin for the motion, another controller near the target.

Also where twin and arm disagree. The plan averages simulated candidates by exp(-cost) (model predictive path integral
control: Williams et al., ICRA 2017). An offset of the commands takes up the model's error (Pannocchia and Rawlings,
AIChE Journal 49(2), 2003).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rejoint.arms import Arm, Array, Mask, gravity_torque, position_kinematics
from rejoint.control.controllers.catalogue import PREDICTIVE
from rejoint.control.controllers.classical import Pace, limit_lead, limit_position
from rejoint.control.controllers.feedforward import FeedforwardController
from rejoint.control.robot import ControlInput
from rejoint.twin.parameters import TwinParameters
from rejoint.twin.simulation import ChainBatch, Draw, Simulation
from rejoint.twin.twin import Twin

# The holder takes over; chosen.
AT_TARGET = 0.5e-3
"""[m] tool to target, by encoders"""
LATE = 1.0
"""[s] since the target was set"""
LOST, MEMORY = 0.010, 0.1
"""[m] tool prediction error, and [s] over which it is averaged"""


class PredictiveController:
    """Controls B arms, each by its own twin."""

    name = PREDICTIVE

    def __init__(self, arm: Arm, twins: Draw, holder: FeedforwardController) -> None:
        """Take twins (B,), or one for all, and the holder."""
        self._arm, self._holder, self._planner = arm, holder, Planner(arm, twins)
        self.contract = getattr(holder, "contract", None)  # of a policy: it is checked before anything moves
        self._begin(0)

    @classmethod
    def of(cls, arm: Arm, twins: Sequence[Twin], holder: FeedforwardController) -> PredictiveController:
        """Make it for B twins, with their compiled simulation; ContractError for other arms."""
        for twin in twins:
            twin.require(arm)
        count = len(twins)
        draw = Draw.of(
            TwinParameters.stacked([twin.parameters for twin in twins]),
            np.array([twin.acceleration for twin in twins]),
        )
        trial, rest = Simulation(arm, count), arm.rest[None]
        trial.place(draw, rest, rest)
        trial.advance(np.full(count, TIMESTEP))
        return cls(arm, draw, holder)

    def _begin(self, count: int) -> None:
        self._planning: Mask = np.zeros(count, dtype=bool)
        self._wrong = np.zeros(count)  # [m]

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Plan for new targets of the arms in ``where`` (B,)."""
        if len(self._planning) != len(inputs.sent):
            self._begin(len(inputs.sent))
        self._planner.reset(inputs, where)
        self._holder.reset(inputs, where)
        self._planning = self._planning | where
        self._wrong = np.where(where, 0.0, self._wrong)

    def command(self, inputs: ControlInput) -> Array:
        """Return the plan's first command, or the holder's, (B, n) [rad]."""
        missed = self._planner.follow(inputs)
        done = self._planning & self._over(inputs, missed)
        if done.any():
            self._holder.take_over(inputs, done)
            self._planning = self._planning & ~done
        held = self._holder.command(inputs)  # in every cycle: it learns what the arm does
        if not self._planning.any():
            return held
        return np.where(self._planning[:, None], self._planner.command(inputs), held)

    def _over(self, inputs: ControlInput, missed: Array) -> Mask:
        """Whose plan (B,) is over, by the prediction error ``missed`` (B, n) [rad]."""
        tcp, jacobian = position_kinematics(self._arm, inputs.state.position)
        wrong = np.linalg.norm((jacobian @ missed[..., None])[..., 0], axis=-1)
        self._wrong = self._wrong + np.minimum(self._planner.elapsed / MEMORY, 1.0) * (wrong - self._wrong)
        near = np.linalg.norm(inputs.target - tcp, axis=-1) < AT_TARGET
        return near | (inputs.since_target > LATE) | (self._wrong > LOST)


_OVERDRIVE = np.array([-0.5, 0.0, 0.5, 1.0, 2.0, 4.0])
"""Candidates: goal's command plus these shares of the way; chosen"""
_SHADOW_STEPS = 4


SAMPLES = 32
"""Candidates per arm and cycle; chosen"""
CORRECTION, OFFSET_RATE = 0.4, 1.0
"""Of the prediction error, per cycle, and [1/s] for the offset of the commands; chosen"""
TIMESTEP, HORIZON = 0.008, 0.28
"""[s] of the rollouts, and beyond the delay; chosen"""
BEND = 0.12
"""[s] from first to last command; chosen"""
SPREAD_FLOOR, SPREAD_SLOPE = np.radians(0.15), 0.25
"""[rad] of random candidates, and their growth with the largest joint error; chosen"""
TEMPERATURE = 0.1
"""Relative to the spread of the costs; chosen"""
NEAR = 0.003
"""[m] distance of half the cost; chosen"""
EFFORT = 0.3
"""[1/rad] cost of a change of command; chosen"""
LEAD, MOST_OFFSET = np.radians(20.0), np.radians(30.0)
"""[rad] largest following error, and offset of the commands; chosen"""


class Planner:
    """Plans for B arms, with their simulation ``shadow``."""

    def __init__(self, arm: Arm, twins: Draw) -> None:
        """Take the twins of B arms, or one for all."""
        self._arm, self._given = arm, twins
        self._pace = Pace()
        self._offset: Array = np.zeros((0, arm.joints))
        self._rng = np.random.default_rng(0)

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Take new targets of the arms in ``where`` (B,)."""
        if len(self._offset) != len(inputs.sent):
            self._begin(inputs)
        self._plan[where] = self._holding(inputs)[where, None]

    def _holding(self, inputs: ControlInput) -> Array:
        """Commands (B, n) [rad] that hold the goals."""
        sag = gravity_torque(self._arm, inputs.goal) / self._twin.stiffness
        return inputs.goal + (1.0 - self._twin.compensation) * sag - self._twin.offset - self._offset

    def command(self, inputs: ControlInput) -> Array:
        """Return the plan's first command (B, n) [rad], after `follow`."""
        candidates = self._candidates(inputs)
        costs = self._costs(inputs, candidates)
        best = costs.min(axis=1, keepdims=True)
        spread = np.maximum(costs.std(axis=1, keepdims=True), 1e-9)
        weights = np.exp(-(costs - best) / (TEMPERATURE * spread))
        weights /= weights.sum(axis=1, keepdims=True)
        self._plan = (weights[:, :, None, None] * candidates).sum(axis=1)
        return limit_position(self._arm, self._plan[:, 0])

    def follow(self, inputs: ControlInput) -> Array:
        """Advance the twins to now and learn from their errors (B, n) [rad]."""
        now = inputs.state.time
        elapsed = self.elapsed = self._pace.tick(now)
        shadow = self.shadow
        if (now <= shadow.time).all():
            return np.zeros_like(inputs.sent)
        shadow.send(inputs.sent)
        shadow.advance(np.maximum(elapsed, 1e-4), self._offset)
        shadow.time = now.copy()
        missed = inputs.state.position - shadow.twins.qpos
        shadow.twins.qpos[:] += CORRECTION * missed
        shadow.twins.qvel[:] += 0.5 * CORRECTION**2 * missed / np.maximum(elapsed, 1e-3)[:, None]
        learned = self._offset + OFFSET_RATE * elapsed[:, None] * missed
        self._offset = np.clip(learned, -MOST_OFFSET, MOST_OFFSET)
        return missed

    def _begin(self, inputs: ControlInput) -> None:
        count, n = inputs.sent.shape
        arms = self._given.rows(np.arange(count) % len(self._given.period))
        self._twin, start = arms.twin, inputs.state.position
        self.shadow = Simulation(self._arm, count, substeps=_SHADOW_STEPS)
        self.shadow.place(arms, start, inputs.sent)
        self.shadow.time = inputs.state.time.copy()
        self._rollouts = ChainBatch(self._arm, count * SAMPLES, timestep=TIMESTEP)
        self._rollouts.write(arms.rows(np.repeat(np.arange(count), SAMPLES)))
        self._offset = np.zeros((count, n))
        self._plan = np.zeros((count, 2, n))  # first command, and the one after `bend`

    def _candidates(self, inputs: ControlInput) -> Array:
        """Commands (B, K, 2, n) [rad]: first, and after the bend."""
        measured = inputs.state.position
        way, holding = inputs.goal - self.shadow.twins.qpos, self._holding(inputs)
        driven = holding[:, None] + _OVERDRIVE[:, None] * way[:, None]
        fixed = np.stack([driven, np.broadcast_to(holding[:, None], driven.shape)], axis=2)
        count = SAMPLES - len(_OVERDRIVE) - 1
        spread = SPREAD_FLOOR + SPREAD_SLOPE * np.abs(way).max(axis=1)
        noise = self._rng.standard_normal((len(measured), count, *self._plan.shape[1:]))
        random = self._plan[:, None] + spread[:, None, None, None] * noise
        every = np.concatenate([fixed, self._plan[:, None], random], axis=1)
        return limit_position(self._arm, limit_lead(every, measured[:, None, None], LEAD))

    def _costs(self, inputs: ControlInput, candidates: Array) -> Array:
        """Cost (B, K): mean distance, by the goal's Jacobian, plus effort."""
        delay = self._twin.delay
        count, n = inputs.sent.shape
        steps = int(np.ceil((delay.max() + HORIZON) / TIMESTEP))
        ahead = np.linspace(0.0, (steps - 1) * TIMESTEP, steps)
        sent, _ = self.shadow.latency.in_force(inputs.state.time[:, None] + ahead)  # without new commands
        since = ahead - delay[:, None]
        share = np.clip(since / BEND, 0.0, 1.0)[:, None, :, None]
        first, last = candidates[:, :, 0, None], candidates[:, :, 1, None]
        wanted = np.where((since >= 0.0)[:, None, :, None], first + share * (last - first), sent[:, None])
        each, now = np.repeat(np.arange(count), SAMPLES), self.shadow.twins
        control = self.shadow.reference.ahead(each, wanted.reshape(-1, steps, n), TIMESTEP)
        if self.shadow.feed.any():
            control += self.shadow.feed[each, None] * gravity_torque(self._arm, control)
        control += self._offset[each, None]
        self._rollouts.restart(now.qpos[each], now.qvel[each])
        passed = self._rollouts.rollout(control).reshape(count, SAMPLES, steps, n)
        miss = passed - inputs.goal[:, None, None]
        error = np.einsum("bij,bktj->bkti", position_kinematics(self._arm, inputs.goal)[1], miss)
        distance = np.sqrt((error**2).sum(axis=-1))
        far = distance / (distance + NEAR) + 10.0 * distance
        rest = np.abs(passed[:, :, -1] - passed[:, :, -3]).sum(axis=-1)  # still moving at the end
        change = np.abs(candidates[:, :, 0] - inputs.sent[:, None]).mean(axis=-1)
        posture = (miss[:, :, -1] ** 2).sum(axis=-1)  # the null space, which the distance does not see
        return far.mean(axis=-1) + 2.0 * rest + EFFORT * change + posture
