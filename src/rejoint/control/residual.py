"""The command law of a learned policy: a classical law plus a bounded correction.

Park et al. 2024, equation 17: next command = position + damped least-squares step + action. Three
readings, by what the action is added to (``anchor``):

* ``measured``: the measured position, literally. A worn servo then forgets each cycle what it took to
  hold the arm up.
* ``sent``: the last sent command. The law integrates, which removes the sag.
* ``goal``: the command of the feed-forward controller, our strongest classical law, so that the policy
  learns what that one lacks and nothing else (residual policy learning: Silver et al. 2018, arXiv:1812.06298;
  Johannink et al. 2019, arXiv:1812.03201). While the goal moves along a way, that law alone acts.
  Actions add to its correction and so are remembered.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from rejoint.arms import Arm, Array, clip_norm
from rejoint.arms.workspace import heaviest_load, moves_tool, unloaded_joints
from rejoint.control.controller import ControlInput
from rejoint.control.feedforward import LOOSEN, FeedforwardController, FeedforwardGains
from rejoint.control.law import GAIN, STEP_LIMIT, between, limit_lead, limit_position, plain
from rejoint.control.observation import View
from rejoint.control.robot import Mask
from rejoint.system.errors import InputError
from rejoint.system.shell import Late

compiled = Late("rejoint.control.compiled")


@dataclass(frozen=True, kw_only=True)
class CommandLaw:
    """Constants of the law; they are part of a policy's contract."""

    anchor: Literal["goal", "sent", "measured"] = "sent"
    """what step and action are added to"""
    stiffness: tuple[float, ...] = ()
    """[N m/rad] of the servos, as far as it is known when the policy is trained; needed by the anchor ``goal``"""
    learning: FeedforwardGains = field(default_factory=FeedforwardGains)
    """what the controller under the anchor ``goal`` learns by itself"""
    loosen: float = LOOSEN
    """[rad/s] by which that controller pushes joints that stick"""
    step_gain: float = GAIN
    """fraction of the damped least-squares step taken each cycle"""
    step_limit: float = float(STEP_LIMIT)
    """[rad] largest element of the damped least-squares step"""
    authority_floor: float = float(np.radians(0.12))
    """[rad] correction that the policy always has (chosen: just above one encoder count)"""
    authority_slope: float = 0.5
    """growth of the authority with the largest element of the damped least-squares step"""
    authority_limit: float = float(np.radians(4.0))
    """[rad] largest correction"""
    lead_limit: float = float(np.radians(20.0))
    """[rad] largest distance between command and measured position (anti-windup)"""
    rest_gain: float = 0.05
    """fraction of the way to the goal posture taken each cycle in the null space (chosen: a policy without it
    lets the wrist drift to its limits over a few dozen targets)"""
    rest_distance: float = 0.01
    """[m] TCP distance below which that pull fades, so that it does not disturb a settled arm"""

    load_penalty: float = 0.0
    """by which the anchor ``goal`` spares joints that carry weight, near the target: the one with the largest load is
    moved by 1 + this times less there. Load rubs: such a joint breaks loose late, jumps over the target and does
    so for ever, where lighter ones can do its work"""
    load_penalty_distance: float = 0.003
    """[m] TCP distance at which half of that holds (chosen: what such a jump covers)"""
    decay_start: float = 0.0
    """[s] since the target was set after which the anchor ``goal`` corrects joints that carry no weight by ever less,
    as a power of the time; 0: never. In the play of its gear such a joint answers late and coasts on, and what ends
    its swinging is a gain that falls (after Robbins and Monro 1951)"""
    decay_power: float = 1.5
    """of that fall (chosen: with 1 some joints still swing after 8 s, with 2 more stop short)"""
    decay_step: float = float(np.radians(1.0))
    """[rad] largest element of the damped least-squares step from which on corrections are in full again"""

    envelope_margin: float = float(np.radians(35.0))
    """[rad] how far from the goal posture the anchor ``goal`` may command a joint (chosen)"""

    def authority(self, step: Array) -> Array:
        """Largest correction (B, 1) [rad] at the damped least-squares steps ``step`` (B, n) [rad]."""
        largest = np.maximum.reduce(np.abs(step), axis=-1, keepdims=True)
        return np.minimum(self.authority_floor + self.authority_slope * largest, self.authority_limit)

    def decayed(self, since_target: Array, step: Array) -> Array:
        """Factor (B, 1) on the corrections of unloaded joints, (B,) [s] after the target was set.

        ``step`` (B, n) [rad] is the damped least-squares step.
        """
        late = (self.decay_start / np.maximum(since_target, self.decay_start)[:, None]) ** self.decay_power
        largest = np.abs(step).max(axis=-1, keepdims=True)
        return late + (1.0 - late) * np.minimum(largest / self.decay_step, 1.0) ** 2

    def command(self, arm: Arm, view: View, position: Array, sent: Array, action: Array) -> Array:
        """Return the wanted joint positions (B, n) [rad] of the anchors ``sent`` and ``measured``.

        ``position`` (B, n) [rad] is measured, ``sent`` (B, n) [rad] the last command after the guard,
        ``action`` (B, n) the policy's output in [-1, 1], ``view`` made at the same position.
        """
        anchor = sent if self.anchor == "sent" else position
        wanted = anchor + self.step_gain * clip_norm(view.step, self.step_limit)
        wanted = wanted + self.authority(view.step) * np.clip(action, -1.0, 1.0)
        if self.rest_gain:
            pull = self.rest_gain * np.minimum(view.distance / self.rest_distance, 1.0)
            wanted = wanted + pull[:, None] * clip_norm(view.homing, self.step_limit)
        return limit_position(arm, limit_lead(wanted, position, self.lead_limit))


class Commander:
    """Turns actions into commands for B arms and remembers what the law needs between cycles."""

    def __init__(self, arm: Arm, law: CommandLaw) -> None:
        self._arm, self.law = arm, law
        self._base: FeedforwardController | None = None
        load = heaviest_load(arm)
        self._moves = moves_tool(arm).astype(float)
        self._spared = 1.0 - 1.0 / (1.0 + law.load_penalty * load / max(load.max(), 1e-9))
        if law.anchor == "goal":
            if len(law.stiffness) != arm.joints:
                raise InputError(f"the law needs the stiffness of {arm.joints} servos, got {list(law.stiffness)}")
            self._base = FeedforwardController(arm, np.array(law.stiffness), law.learning, law.loosen)

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Take over the new targets of the arms in ``where`` (B,)."""
        if self._base is not None:
            self._base.reset(inputs, where)

    def reset_learned(self, inputs: ControlInput, where: Mask) -> None:
        """Start again with other arms in ``where`` (B,)."""
        if self._base is not None:
            self._base.reset_learned(inputs, where)

    def take_over(self, inputs: ControlInput, where: Mask) -> None:
        """Go on from the last command of the arms in ``where`` (B,), which another controller gave."""
        if self._base is not None:  # other anchors start from the last command or the measured position anyway
            self._base.take_over(inputs, where)

    def command(self, inputs: ControlInput, view: View, action: Array) -> Array:
        """Return the wanted joint positions (B, n) [rad] for actions (B, n) in [-1, 1]."""
        law = self.law
        if self._base is None:
            return law.command(self._arm, view, inputs.state.position, inputs.sent, action)
        step, extra = out = np.empty((2, *view.step.shape))
        compiled.weigh(
            out, plain(view.step), plain(view.error), plain(view.distance), plain(action), self._moves,
            self._spared, law.authority_floor, law.authority_slope, law.authority_limit,
            law.step_limit, law.learning.fade, law.load_penalty_distance,
        )  # fmt: skip
        if law.decay_start > 0.0:
            factor = np.where(unloaded_joints(self._arm), law.decayed(inputs.since_target, view.step), 1.0)
            step, extra = factor * step, factor * extra
        extra = np.where(self._base.on_the_way(inputs)[:, None], 0.0, extra)  # the law knows the way
        extra = extra + self._base.loosening(inputs, view.step, view.distance)
        wanted, margin = self._base.correct(inputs, step, extra, view.distance), law.envelope_margin
        return limit_position(self._arm, between(wanted, inputs.goal - margin, inputs.goal + margin))

    def memory(self) -> dict[str, Array]:
        """Return everything that is remembered, by name; live arrays."""
        return {} if self._base is None else self._base.memory()
