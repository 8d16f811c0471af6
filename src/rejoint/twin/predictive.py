"""Predictive control: the way to a target is planned on the arm's own twin, the rest is left to another controller.

A twin knows where friction will stop a joint before it does, and so the plan arrives sooner than laws that wait and
see. Within the last millimetres, and where twin and arm disagree, it knows less than the encoders: there the command is
handed over to a controller that goes by these alone, from the last command on, until the next target.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from rejoint.arms import Arm, Array, position_kinematics
from rejoint.control.catalogue import PREDICTIVE
from rejoint.control.controller import ControlInput, Controller
from rejoint.control.robot import JointState, Mask
from rejoint.twin.planning import Planner, PlanSettings
from rejoint.twin.simulation import Draw
from rejoint.twin.twin import Twin


class Holder(Controller, Protocol):
    """A controller that can go on from what another one has sent."""

    def take_over(self, inputs: ControlInput, where: Mask) -> None:
        """Go on from the last command of the arms in ``where`` (B,); `command` follows in the same cycle."""


@dataclass(frozen=True, kw_only=True)
class HandOver:
    """When the plan is left; ``near`` and ``late`` were chosen on worn arms of family 4, none of which is ``lost``."""

    near: float = 0.5e-3
    """[m] distance of the tool from its target, by the encoders"""
    late: float = 1.0
    """[s] since the target was set"""
    lost: float = 0.010
    """[m] by which the twin mispredicts the tool"""
    memory: float = 0.1
    """[s] over which that is averaged"""


class PredictiveController:
    """Drives B arms, each on its own twin."""

    name = PREDICTIVE

    def __init__(
        self, arm: Arm, twins: Draw, holder: Holder, settings: PlanSettings | None = None,
        hand_over: HandOver | None = None,
    ) -> None:  # fmt: skip
        """Take the twins (B,) of the arms, or one for all, and the controller that is left the last millimetres."""
        self._arm, self._holder = arm, holder
        self._planner, self._until = Planner(arm, twins, settings), hand_over or HandOver()
        self.contract = getattr(holder, "contract", None)  # of a policy: it is checked before anything moves
        self._planning: Mask = np.zeros(0, dtype=bool)
        self._wrong: Array = np.zeros(0)  # (B,) [m]
        self._time: Array = np.zeros(0)

    @classmethod
    def of(cls, arm: Arm, twin: Twin, holder: Holder) -> PredictiveController:
        """Make it for one arm and its twin, and have all compiled that a plan needs: no control cycle may wait for it.

        ContractError where the twin is of another arm.
        """
        twin.require(arm)
        twins = Draw.of(twin.parameters.repeat(1), twin.stiction, twin.acceleration)
        state = JointState(time=np.zeros(1), position=arm.rest[None], age=np.zeros(1))
        inputs = ControlInput(
            state=state, target=arm.targets.lower[None], sent=arm.rest[None], since_target=np.zeros(1)
        )
        trial = Planner(arm, twins)
        for cycle in range(2):  # in the first one the shadow does not move
            now = replace(inputs, state=replace(state, time=np.full(1, 0.02 * cycle)))
            if cycle == 0:
                trial.reset(now, np.ones(1, dtype=bool))
            trial.follow(now)
            trial.command(now)
        return cls(arm, twins, holder)

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Plan for the new targets of the arms in ``where`` (B,)."""
        count = len(inputs.sent)
        if len(self._planning) != count:
            self._planning, self._wrong, self._time = np.zeros(count, dtype=bool), np.zeros(count), np.zeros(count)
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
        """Tell which arms (B,) the plan is to be left for, given what the twins ``missed`` (B, n) [rad]."""
        until = self._until
        tcp, jacobian = position_kinematics(self._arm, inputs.state.position)
        wrong = np.linalg.norm((jacobian @ missed[..., None])[..., 0], axis=-1)
        share = np.clip((inputs.state.time - self._time) / until.memory, 0.0, 1.0)
        self._wrong, self._time = self._wrong + share * (wrong - self._wrong), inputs.state.time.copy()
        near = np.linalg.norm(inputs.target - tcp, axis=-1) < until.near
        over: Mask = near | (inputs.since_target > until.late) | (self._wrong > until.lost)
        return over
