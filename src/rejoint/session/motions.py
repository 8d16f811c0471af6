"""Motions of a session: one at a time, in any thread, ended from any thread."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.control.controller import ControlInput, turned_off
from rejoint.control.goal import pace
from rejoint.control.posture import Wanted
from rejoint.control.robot import JointState, Mask
from rejoint.system.errors import NotReachedError

CALM = 0.3
"""[s] at the goal (chosen)"""
RESTS = 0.8
"""[s] without a new joint goal before the arm rests (chosen)"""


class EndedError(Exception):
    """A motion was asked to end, and has ended: no error."""


class ArmMotion:
    """One motion: ``work`` drives and returns its result; `ended` asks it to end."""

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


class PlannedWay:
    """Goes along a planned way and stays at its end; slower where a joint lags behind."""

    def __init__(self, arm: Arm, at: Callable[[float], Array], duration: float) -> None:
        """Take postures (n,) [rad] ``at`` times [s], up to the ``duration``."""
        self._arm, self._at, self._duration, self._since, self._time = arm, at, duration, 0.0, np.nan

    def advance(self, state: JointState) -> Wanted:
        """Return where the arm is to be; the first call begins the way."""
        now = float(state.time[0])
        if now > self._time:
            self._since += (now - self._time) * pace(self._arm, self._at(self._since), state.position[0])
        self._time = now
        return Wanted(posture=self._at(self._since)[None], arrived=np.array([self._since >= self._duration]))


class GoalStream:
    """Goes to the newest joint goal at full speed; rests after `RESTS` without a new one."""

    def __init__(self, arm: Arm) -> None:
        self._speed = arm.max_speed
        self.goal: Array | None = None
        """(n,) [rad]; None: stay"""
        self._posture = self._last = np.zeros(0)
        self._time = self._changed = -np.inf

    def advance(self, state: JointState) -> Wanted:
        """Return where the arm is to be: at first, where it is."""
        now, goal = float(state.time[0]), self.goal
        if not len(self._posture):
            self._posture = self._last = state.position[0].copy()
            self._time = now
        goal = self._last if goal is None else goal
        if (goal != self._last).any():
            self._last, self._changed = goal, now
        reach = self._speed * max(now - self._time, 0.0)
        self._posture = self._posture + np.clip(goal - self._posture, -reach, reach)
        self._time = now
        arrived = now - self._changed > RESTS and bool((self._posture == goal).all())
        return Wanted(posture=self._posture[None], arrived=np.array([arrived]))


def in_mm(point: Array) -> str:
    """Return a place (3,) [m] in words."""
    return f"({', '.join(f'{1e3 * value:.0f}' for value in point)}) mm"
