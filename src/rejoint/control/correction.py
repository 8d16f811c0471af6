"""Aiming: where to send the tool by the encoders, so that it really arrives at its target.

A layer between targets and controllers, the same for every controller: what a controller is given is the *aim*, a
target shifted by what lies behind the encoders. Guard and controllers know nothing else of it. By its encoders such an
arm stands beside its target by design, so encoder errors are those from the aim, true errors those from the target.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from rejoint.arms import Arm, Array, Displacement, frames, tcp_position
from rejoint.arms.orientation import Orientation
from rejoint.arms.posing import find_postures
from rejoint.control.controller import ControlInput
from rejoint.control.robot import Mask
from rejoint.system.errors import InputError

ROUNDS = 4
"""Fixed-point steps of the aim (measured: the third changes it by less than 0.01 mm)"""
MOST = 0.05
"""[m] largest shift of a target (chosen: worn arms have 15 mm; more is a damaged file or another arm)"""
CALM = 0.3
"""[s] in which every reading stays within `STILL` before an arm counts as settled (chosen)"""
STILL = np.radians(0.2)
"""[rad] (chosen: two encoder counts)"""
NEAR = 2e-3
"""[m] from its aim within which a settled arm is aimed again (chosen: farther off, it has not arrived)"""
CHANGE = 2e-4
"""[m] by which an aim changes at least (chosen: less is not worth a new motion)"""


class Correction(Protocol):
    """Turns targets into aims; may keep memory between cycles."""

    def aim(self, target: Array, start: Array, where: Mask) -> Array:
        """Return the aims (B, 3) [m] of ``target`` (B, 3) [m], just set for the arms in ``where`` (B,).

        ``start`` (B, n) [rad] is what the arms were sent last.
        """

    def aim_pose(self, target: Array, turn: Orientation, start: Array, where: Mask) -> tuple[Array, Orientation]:
        """Return the aims of ``target``, and how the encoders are to see the tools turned for ``turn`` (B,)."""

    def again(self, target: Array, inputs: ControlInput) -> Array | None:
        """Once a control cycle, return new aims (B, 3) [m]; None where the present ones, in ``inputs``, stay."""


@dataclass(eq=False)
class Modelled:
    """Aims by what is known of the displacements, and once more where the arm has settled."""

    arm: Arm
    displacement: Displacement
    _moved: Arm = field(init=False)
    _came: Array = field(init=False)  # (B, n) [rad] where the arms came from
    _posture: Array = field(init=False)  # (B, n) where the arms were when they last moved
    _since: Array = field(init=False)  # (B,) [s] when that was
    _done: Mask = field(init=False)  # (B,) whether the target was aimed at again
    _turned: Array = field(init=False)  # (B, 3, 3) how the encoders are to see the tools turned

    def __post_init__(self) -> None:
        self._moved = self.displacement.moved(self.arm)
        self._came = self._posture = np.zeros((0, self.arm.joints))
        self._since = np.zeros(0)
        self._done = np.zeros(0, dtype=bool)
        self._turned = np.zeros((0, 3, 3))

    def shift(self, position: Array, approach: Array | None = None) -> Array:
        """Return how far (..., 3) [m] the tool is from where the encoders see it, at ``position`` (..., n) [rad].

        ``approach`` (..., n) [rad] is where the arm came from: joints that float lie as their last motion left them.
        """
        links = self.displacement.joints(self.arm, position, approach)
        return tcp_position(self._moved, links) - tcp_position(self.arm, position)

    def aim(self, target: Array, start: Array, where: Mask) -> Array:
        """Return the aims (B, 3) [m], at the postures that the inverse kinematics finds from ``start`` (B, n) [rad]."""
        return self._aim(target, None, start, where)

    def aim_pose(self, target: Array, turn: Orientation, start: Array, where: Mask) -> tuple[Array, Orientation]:
        """Return the aims and orientations at the postures of the poses."""
        if len(self._turned) != len(where):
            self._turned = turn.rotation.copy()
        aims = self._aim(target, turn, start, where)
        return aims, replace(turn, rotation=self._turned.copy())

    def untwisted(self, turn: Orientation, position: Array, approach: Array | None = None) -> Orientation:
        """Return how the encoders are to see tools (...) turned that are to be as in ``turn``; else as `shift`."""
        links = self.displacement.joints(self.arm, position, approach)
        seen, own = frames(self.arm, position).tcp_rotation, frames(self._moved, links).tcp_rotation
        return replace(turn, rotation=seen @ np.swapaxes(own, -1, -2) @ turn.rotation)

    def _aim(self, target: Array, turn: Orientation | None, start: Array, where: Mask) -> Array:
        if len(self._since) != len(where):
            self._came = self._posture = start.copy()
            self._since = np.full(len(where), -np.inf)
            self._done = np.zeros(len(where), dtype=bool)
        self._done, self._since = self._done & ~where, np.where(where, np.nan, self._since)
        self._came = np.where(where[:, None], start, self._came)
        aims = np.array(target, dtype=float)
        aimed = where & np.isfinite(target).all(axis=-1)
        if not aimed.any():
            return aims
        goal, posture = target[aimed], start[aimed]
        place = goal.copy()
        wanted = own = None if turn is None else turn[aimed]
        for _ in range(ROUNDS):
            posture = find_postures(self.arm, place, posture, own)
            place = goal - self.shift(posture, start[aimed])
            if wanted is not None:
                own = self.untwisted(wanted, posture, start[aimed])
        if own is not None:
            self._turned[aimed] = own.rotation
        aims[aimed] = checked(goal, place)
        return aims

    def again(self, target: Array, inputs: ControlInput) -> Array | None:
        """Aim once more at the posture in which an arm has settled: redundant ones do not end where they were sent."""
        settled = self._settled(inputs) & ~self._done
        if not settled.any():
            return None
        self._done = self._done | settled
        position = inputs.state.position
        fresh = np.where(settled[:, None], target - self.shift(position, self._came), inputs.target)
        changed = np.linalg.norm(fresh - inputs.target, axis=-1) > CHANGE
        if not changed.any():
            return None
        return np.where(changed[:, None], checked(target, fresh), inputs.target)

    def _settled(self, inputs: ControlInput) -> Mask:
        """Arms (B,) that have stood for a while where they were sent."""
        position, now = inputs.state.position, inputs.state.time
        moving = (np.abs(position - self._posture) > STILL).any(axis=-1) | np.isnan(self._since)
        self._posture = np.where(moving[:, None], position, self._posture)
        self._since = np.where(moving, now, self._since)
        calm = now - self._since > CALM
        if not calm.any():
            return calm
        off = np.linalg.norm(inputs.target - tcp_position(self.arm, position), axis=-1)
        return calm & (off < NEAR)


def checked(target: Array, aim: Array) -> Array:
    """Return ``aim`` (..., 3) [m]; InputError where one is farther from its ``target`` than any worn arm needs."""
    far = float(np.linalg.norm(aim - target, axis=-1).max(initial=0.0))
    if not far <= MOST:
        raise InputError(
            f"calibration: it shifts a target by {1e3 * far:.0f} mm, expected at most {1e3 * MOST:.0f}; calibrate again"
        )
    return aim
