"""Motions of a session: one at a time, in any thread, ended from any thread."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.control.controller import ControlInput, turned_off
from rejoint.control.correction import Apparent
from rejoint.control.reference import Reference, Setpoint
from rejoint.control.robot import JointState, Mask
from rejoint.system.errors import NotReachedError

CALM = 0.3
"""[s] at the goal (chosen)"""
RESTS, JITTER = 0.8, float(np.radians(0.3))
"""[s] from the last new joint goal to rest, and [rad] jitter of a resting hand (chosen)"""


class EndedError(Exception):
    """A motion was asked to end, and has ended: no error."""


class ArmMotion:
    """``work`` drives and returns its result; `ended` asks it to end."""

    def __init__(self, goal: str, work: Callable[[ArmMotion], object]) -> None:
        self.goal, self._work = goal, work
        """where the arm is on its way to, in words"""
        self.ended, self.over = threading.Event(), threading.Event()
        self.result: object = None
        self.error: BaseException | None = None
        """what ended it early"""

    def start(self) -> None:
        """Drive in a thread of its own."""
        threading.Thread(target=self.run, name="motion", daemon=True).start()

    def run(self) -> None:
        """Drive until the end."""
        try:
            self.result = self._work(self)
        except EndedError:
            pass
        except BaseException as error:  # noqa: BLE001 - raised again where a caller waits
            self.error = error
        finally:
            self.over.set()

    @property
    def under_way(self) -> bool:
        """Whether the arm is still driven."""
        return not self.over.is_set()

    def give_up(self, _: ControlInput) -> Mask:
        """Tell the control loop whether to end, see `rejoint.control.loop.Schedule`."""
        return np.array([self.ended.is_set()])


class GoalCheck:
    """Decides whether the encoders stay at the goal for `CALM`."""

    def __init__(self, motion: ArmMotion, arm: Arm, within: float, within_turn: float = np.inf) -> None:
        """Take bounds: of the tool in metres and radians."""
        self._motion, self._arm, self._within, self._within_turn = motion, arm, within, within_turn
        self._since: float | None = None
        self._reached, self._left = False, ""

    def at_point(self, inputs: ControlInput) -> Mask:
        """Whether the tool is at its target; for the loop."""
        error = float(np.linalg.norm(inputs.target[0] - tcp_position(self._arm, inputs.state.position[0])))
        turned = float(turned_off(self._arm, inputs)[0])
        self._left = f"{1e3 * error:.1f} mm" + (f" and {np.degrees(turned):.1f} deg" if np.isfinite(turned) else "")
        return self._judge(inputs, near=error < self._within and not turned > self._within_turn)

    def at_joints(self, goal: Array) -> Callable[[ControlInput], Mask]:
        """Return a check of joints at ``goal`` (n,) [rad]; for the loop."""

        def at_goal(inputs: ControlInput) -> Mask:
            away = np.abs(inputs.state.position[0] - goal)
            worst = int(away.argmax())
            self._left = f"{np.degrees(away[worst]):.1f} deg at {self._arm.joint_names[worst]}"
            return self._judge(inputs, near=bool(away[worst] < self._within_turn))

        return at_goal

    def require(self, wanted: str, seconds: float) -> None:
        """Raise NotReachedError unless it arrived or was asked to end."""
        if not (self._reached or self._motion.ended.is_set()):
            raise NotReachedError(
                f"the arm did not come within {wanted} of {self._motion.goal} in {seconds:g} s, still {self._left} "
                "off; it holds. Give it more time or room, or look whether something is in its way"
            )

    def _judge(self, inputs: ControlInput, *, near: bool) -> Mask:
        now = float(inputs.state.time[0])
        self._since = (now if self._since is None else self._since) if near else None
        self._reached = self._since is not None and now - self._since >= CALM
        return np.array([self._reached or self._motion.ended.is_set()])


class GoalStream(Reference):
    """Goes to the newest joint goal at full speed; rests after `RESTS` without a new one.

    Goals are those of a perfect arm with its tool in the same place.
    """

    def __init__(self, apparent: Apparent, position: Array) -> None:
        """Begin at ``position`` (n,) [rad]."""
        self.apparent = replace(apparent, came=position)
        self.goal: Array | None = None
        """(n,) [rad]; None: stay"""
        self._mean, self._posture = np.full_like(position, np.nan), position
        self._time, self._changed = np.inf, -np.inf

    def advance(self, state: JointState, since: Array, /) -> Setpoint:  # noqa: ARG002 - it goes by its own clock
        """Return where the arm is to be: at first, where it is."""
        now, goal = float(state.time[0]), self.goal
        elapsed, self._time = max(now - self._time, 0.0), now
        rested = now - self._changed > RESTS
        if goal is None:
            return Setpoint(self._posture[None])
        if not np.abs(goal - self._mean).max() < JITTER:
            if rested:
                self.apparent.came = self._posture
            self._mean, self._changed, rested = goal, now, False
        # The mean over all the rest: one that goes on wandering with the hand moves joints that stick.
        self._mean = self._mean + elapsed / (now - self._changed + RESTS) * (goal - self._mean)
        aim = self.apparent.measured(self._mean if rested else goal)
        reach = self.apparent.arm.max_speed * elapsed
        self._posture = self._posture + np.clip(aim - self._posture, -reach, reach)
        arrived = rested and bool((self._posture == aim).all())
        return Setpoint(self._posture[None], arrived=np.array([arrived]))
