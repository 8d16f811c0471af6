"""On one real arm a controller that fails is driven no further; everybody else goes on.

A target that is missed costs its whole time, so a controller that reaches nothing costs minutes of a worn arm for a
result that is known after the first targets. And a command that is not a number is the fault of whoever gave it and
not of the arm: it ends that trial, while what is wrong with the arm itself (a hot servo, an old answer) ends the
comparison, as everywhere else. Emulated batches cost nothing and are driven to the end.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.arms.orientation import REACHED_TURN
from rejoint.control.comparison.protocols import Kind
from rejoint.control.comparison.result import Protocol
from rejoint.control.controller import ControlInput, Controller, turned_off
from rejoint.control.guard import Reason
from rejoint.control.recording import Recording
from rejoint.control.robot import Mask

MISSES = 3
"""Targets missed in a row after which a controller is driven no further (chosen: one that reaches nine targets in ten
misses three in a row in fewer than one of a hundred sets of ten)."""


class Watched:
    """A controller on trial: passes on what it is told, and says when the trial of this one arm is to end."""

    def __init__(self, controller: Controller, arm: Arm, protocol: Protocol, last: float, missed: int) -> None:
        """``missed`` are the targets that it missed in a row until now, in ``last`` [s] each."""
        self._controller, self._arm, self._protocol, self._last = controller, arm, protocol, last
        self._missed, self._reached = missed, False
        self.failed = False
        """whether it gave a command that is not a number although everything it was told was one"""
        self.servo_gains = getattr(controller, "servo_gains", None)

    @property
    def name(self) -> str:
        """Name in tables."""
        return self._controller.name

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Pass a new target on."""
        self._reached = False
        self._controller.reset(inputs, where)

    def command(self, inputs: ControlInput) -> Array:
        """Return the controller's command (1, n) [rad]; the last one again where it has failed."""
        wanted = self._controller.command(inputs)
        known = np.isfinite(inputs.state.position).all() and np.isfinite(inputs.sent).all()
        if known and not np.isfinite(wanted).all():
            self.failed = True
            return np.array(inputs.sent)
        return wanted

    def give_up(self, inputs: ControlInput) -> Mask:
        """Tell (1,) whether the trial is to end here, see `Schedule.give_up`; called once per cycle."""
        if np.isfinite(self._last):
            tcp = tcp_position(self._arm, inputs.state.position)
            near = bool(np.linalg.norm(inputs.target - tcp, axis=-1)[0] < self._protocol.threshold)
            self._reached |= near and not turned_off(self._arm, inputs)[0] > REACHED_TURN
            if self._reached:
                self._missed = 0
            if inputs.since_target[0] >= self._last:
                self._missed += not self._reached
        return np.array([self.failed or self._missed >= MISSES])

    def mark(self, recording: Recording) -> Recording:
        """Return the recording with what the guard would have said where the controller has failed."""
        if not self.failed:
            return recording
        flag = np.uint16(Reason.NOT_FINITE.value)
        reasons = recording.reasons.copy()
        reasons[-1] |= flag
        return replace(recording, reasons=reasons, tripped=recording.tripped | flag)


class Elimination:
    """Who is still driven in the comparison of one arm; follows from the results of the trials so far."""

    def __init__(self, protocol: Protocol, judged: Kind = "crossing") -> None:
        """``judged`` is the protocol under which a target is seen to be missed: in a race the only one, the hold."""
        self._protocol, self._judged = protocol, judged
        self._missed: dict[str, int] = {}
        self._out: dict[str, str] = {}

    def out(self, name: str) -> str:
        """Why a controller is driven no further; empty while it is."""
        return self._out.get(name, "")

    def drop(self, name: str, why: str) -> None:
        """Drive a controller no further, because it ``was beaten``, say."""
        self._out.setdefault(name, why)

    def watch(self, name: str, controller: Controller, arm: Arm, kind: Kind) -> Watched:
        """Put a controller on trial."""
        last = self._protocol.dwell if kind == "crossing" else self._protocol.hold
        return Watched(
            controller, arm, self._protocol, last if kind == self._judged else np.inf, self._missed.get(name, 0)
        )

    def note(self, name: str, kind: Kind, place: tuple[int, int], crossed: Iterable[float], failed: bool) -> None:
        """Take over a trial (set, repetition), just driven or read back: ``crossed`` (K,) as in `Crossings`."""
        where = f"set {place[0] + 1}, repetition {place[1] + 1}"
        if failed:
            self._out[name] = f"gave a command that is not a number ({kind} protocol, {where})"
        if kind != self._judged:
            return
        for k, reached in enumerate(crossed, start=1):
            if np.isnan(reached):
                break
            self._missed[name] = 0 if reached else self._missed.get(name, 0) + 1
            if self._missed[name] >= MISSES:
                self._out.setdefault(name, f"missed {MISSES} targets in a row ({where}, up to target {k})")
