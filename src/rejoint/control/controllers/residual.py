"""The command law of a learned policy: a classical law plus a bounded correction.

Park et al. 2024, equation 17: next command = position + damped least-squares step + action. The ``anchor`` is what the
action is added to:

* ``measured``: the measured position, as printed.
* ``goal``: the command of the feed-forward controller (residual policy learning: Silver et al. 2018, arXiv:1812.06298;
  Johannink et al. 2019, arXiv:1812.03201). On a trajectory that controller acts alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from rejoint.arms import Arm, Array, clip_norm
from rejoint.arms.workspace import heaviest_load, moves_tool, unloaded_joints
from rejoint.control.controllers.classical import GAIN, STEP_LIMIT, between, fade, limit_lead, limit_position
from rejoint.control.controllers.feedforward import LOOSEN, FeedforwardController, FeedforwardGains
from rejoint.control.controllers.observation import View
from rejoint.control.robot import ControlInput
from rejoint.system.errors import InputError


@dataclass(frozen=True, kw_only=True)
class CommandLaw:
    """Constants of the law, part of a contract."""

    anchor: Literal["goal", "measured"] = "measured"
    stiffness: tuple[float, ...] = ()
    """[N m/rad] in training (anchor ``goal``)"""
    learning: FeedforwardGains = field(default_factory=FeedforwardGains)
    """(anchor ``goal``)"""
    loosen: float = LOOSEN
    """[rad/s] push of stuck joints (anchor ``goal``)"""
    step_gain: float = GAIN
    step_limit: float = float(STEP_LIMIT)
    """[rad] largest element"""
    authority_floor: float = float(np.radians(0.12))
    """[rad] least authority (chosen: just above an encoder count)"""
    authority_slope: float = 0.5
    """authority over the largest element of the step"""
    authority_limit: float = float(np.radians(4.0))
    """[rad] largest authority"""
    lead_limit: float = float(np.radians(20.0))
    """[rad] largest following error (anti-windup)"""
    load_penalty: float = 0.0
    """near the target the most loaded joint moves by 1 + this times less: load causes stick-slip (anchor ``goal``)"""
    load_penalty_distance: float = 0.003
    """[m] TCP distance of half of that (chosen)"""
    decay_start: float = 0.0
    """[s] after which corrections of unloaded joints decrease as a power of time (anchor ``goal``; Robbins and Monro
    1951); 0: never"""
    decay_power: float = 1.5
    """(chosen: 1 lets joints swing after 8 s, 2 stops more short)"""
    decay_step: float = float(np.radians(1.0))
    """[rad] largest step element with full corrections"""

    envelope_margin: float = float(np.radians(35.0))
    """[rad] from the goal posture (anchor ``goal``; chosen)"""

    def authority(self, step: Array) -> Array:
        """Return authority (B, 1) [rad] at ``step`` (B, n) [rad]."""
        largest = np.maximum.reduce(np.abs(step), axis=-1, keepdims=True)
        return np.minimum(self.authority_floor + self.authority_slope * largest, self.authority_limit)

    def decayed(self, since_target: Array, step: Array) -> Array:
        """Factor (B, 1) on corrections of unloaded joints, (B,) [s] after the target, at ``step`` (B, n) [rad]."""
        late = (self.decay_start / np.maximum(since_target, self.decay_start)[:, None]) ** self.decay_power
        largest = np.abs(step).max(axis=-1, keepdims=True)
        return late + (1.0 - late) * np.minimum(largest / self.decay_step, 1.0) ** 2

    def command(self, arm: Arm, view: View, position: Array, action: Array) -> Array:
        """Commands (B, n) [rad] of the anchor ``measured``: ``position`` (B, n) [rad], ``action`` (B, n) in [-1, 1]."""
        wanted = position + self.step_gain * clip_norm(view.step, self.step_limit)
        wanted = wanted + self.authority(view.step) * np.clip(action, -1.0, 1.0)
        return limit_position(arm, limit_lead(wanted, position, self.lead_limit))


class Commander(FeedforwardController):
    """Turns actions into commands."""

    heeds_turn = False

    def __init__(self, arm: Arm, law: CommandLaw) -> None:
        if law.anchor == "goal" and len(law.stiffness) != arm.joints:
            raise InputError(f"the law needs the stiffness of {arm.joints} servos, got {list(law.stiffness)}")
        super().__init__(arm, np.array(law.stiffness) if law.anchor == "goal" else None, law.learning, law.loosen)
        load, self.law = heaviest_load(arm), law
        self.moves = moves_tool(arm).astype(float)
        self.spared = 1.0 - 1.0 / (1.0 + law.load_penalty * load / max(load.max(), 1e-9))

    def commands(self, inputs: ControlInput, view: View, action: Array) -> Array:
        """Commands (B, n) [rad] for actions (B, n) in [-1, 1]."""
        law = self.law
        if law.anchor == "measured":
            return law.command(self._arm, view, inputs.state.position, action)
        near = 1.0 / (1.0 + (view.distance / law.load_penalty_distance) ** 2)
        step = fade(view.error, law.learning.fade) * clip_norm(view.step, law.step_limit)
        step = step * (1.0 - near[:, None] * self.spared)
        extra = law.authority(view.step) * self.moves * between(action, -1.0, 1.0)
        if law.decay_start > 0.0:
            factor = np.where(unloaded_joints(self._arm), law.decayed(inputs.since_target, view.step), 1.0)
            step, extra = factor * step, factor * extra
        extra = np.where(self.on_the_way(inputs)[:, None], 0.0, extra)  # the law knows the way
        extra = extra + self.loosening(inputs, view.step, view.distance)
        wanted, margin = self.correct(inputs, step, extra, view.distance), law.envelope_margin
        return limit_position(self._arm, between(wanted, inputs.goal - margin, inputs.goal + margin))
