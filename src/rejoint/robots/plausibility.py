"""What an arm can possibly answer: the judge between the wire and everything that computes with it."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.system.errors import ImpossibleReplyError, StaleReplyError

RANGE_MARGIN = np.radians(5.0)
"""[rad] a joint can be beyond its limit by sag and by the stops (chosen)"""
MAX_SPEED_FACTOR = 2.0
"""Times the arm's speed limit: for a myCobot 300 deg/s, just above the no-load speed of its servos (chosen)"""
JUMP_SLACK = np.radians(5.0)
"""[rad] covers that answers are sampled up to 30 ms away from their arrival (chosen)"""
DOUBT = 1.0
"""[s] during which a doubted answer stays as impossible as it was (chosen: longer than it is asked for again)"""
SURE = 0.1
"""[s] of full speed that one answer alone is believed: after a pause a joint could be anywhere, also where a wrong
byte puts it (chosen: two periods of a slow wire)"""
COMMAND_TRAVEL = np.radians(10.0)
"""[rad] a command that went this far moves at least one joint by an encoder step (chosen)"""
COMMANDED_JOINTS = 2
"""joints that must have been sent that far (chosen: one alone may be stuck, which a diagnosis has to find out)"""
REPEAT_GRACE = 0.3
"""[s] of identical answers that latency and acceleration explain (chosen)"""
REPEAT_LIMIT = 1.5
"""[s] of identical answers under a changed command that nothing explains (chosen)"""


def judge(position: Array, arm: Arm) -> None:
    """ImpossibleReplyError unless these are joint positions (n,) [rad] that ``arm`` can have, NaN for none."""
    if np.shape(position) != (arm.joints,):
        raise ImpossibleReplyError(f"expected {arm.joints} joint angles, got {position!r}")
    unreadable = np.isnan(position)
    if unreadable.any():
        names = ", ".join(name for name, bad in zip(arm.joint_names, unreadable, strict=True) if bad)
        raise ImpossibleReplyError(f"the servos of {names} cannot be read")
    outside = (position < arm.lower - RANGE_MARGIN) | (position > arm.upper + RANGE_MARGIN)
    if outside.any():
        j = int(np.argmax(outside))
        angle, low, high = np.degrees([position[j], arm.lower[j], arm.upper[j]])
        raise ImpossibleReplyError(
            f"{arm.joint_names[j]} reads {angle:.1f} deg, outside the arm's range of {low:.0f} to {high:.0f} deg by "
            f"more than {np.degrees(RANGE_MARGIN):.0f}: it fell or was pushed there, or its zero or the answer is wrong"
        )


class Continuity:
    """Compares every answer with the one before it and with what was commanded."""

    def __init__(self, arm: Arm) -> None:
        self._max_speed = MAX_SPEED_FACTOR * arm.max_speed
        self._last: tuple[float, Array] | None = None
        self._before: tuple[float, Array] | None = None
        self._doubted: float | None = None
        self._candidate: Array | None = None
        self._confirmed = False
        self._command_then: Array | None = None
        self._waiting_since: float | None = None

    def check(self, time: float, position: Array) -> None:
        """ImpossibleReplyError if no servo gets from the last answer to ``position`` (n,) [rad] by ``time`` [s].

        An answer that comes again after it was doubted, within `DOUBT`, had no more time for its way than the first.
        Where a joint went farther than in `SURE`, as it may after a pause, two answers have to agree; and two that do
        overrule the very first one. They overrule the last one as well where they suit the one before it: a wrong
        byte may move a joint by no more than is possible, and is then believed once.
        """
        if self._last is None:
            return
        then, before = self._last
        if self._doubted is not None and time - self._doubted < DOUBT:
            time = self._doubted
        gone, elapsed = np.abs(position - before), max(time - then, 0.0)
        jumped = gone > self._max_speed * elapsed + JUMP_SLACK
        sudden = gone > self._max_speed * min(elapsed, SURE) + JUMP_SLACK
        agreed = self._candidate is not None and bool((np.abs(position - self._candidate) <= JUMP_SLACK).all())
        self._doubted = time if jumped.any() else None
        doubtful = jumped.any() and self._confirmed and not (agreed and self._suits_the_one_before(time, position))
        if doubtful or (sudden.any() and not agreed):
            self._candidate = position
            i = int(np.argmax(jumped if jumped.any() else sudden))
            says = "cannot have jumped" if jumped.any() else "is said, once, to have gone"
            raise ImpossibleReplyError(
                f"joint {i + 1} {says} from {np.degrees(before[i]):.1f} to {np.degrees(position[i]):.1f} deg in "
                f"{elapsed:.3f} s"
            )
        self._candidate = None

    def _suits_the_one_before(self, time: float, position: Array) -> bool:
        if self._before is None:
            return False
        then, before = self._before
        return bool((np.abs(position - before) <= self._max_speed * max(time - then, 0.0) + JUMP_SLACK).all())

    def accept(self, time: float, position: Array, command: Array | None) -> float:
        """Take over an answer; return its age [s]: how long it should have changed and did not.

        Standing still is no offence, and a stuck joint neither: only when the commands in force of at
        least two joints have moved by more than 10 deg since the last change, and not one of the
        encoders by one step.
        Raises StaleReplyError when that lasts.
        """
        if self._last is None or np.any(position != self._last[1]):
            self._command_then = command
            self._waiting_since = None
        elif command is not None and self._command_then is None:
            self._command_then = self._last[1]
        self._confirmed = self._last is not None
        self._before, self._last = self._last, (time, position)
        if command is None or self._command_then is None:
            return 0.0
        if self._waiting_since is None:
            if np.count_nonzero(np.abs(command - self._command_then) > COMMAND_TRAVEL) >= COMMANDED_JOINTS:
                self._waiting_since = time
            return 0.0
        age = time - self._waiting_since
        if age > REPEAT_LIMIT:
            raise StaleReplyError(
                f"the same joint angles for {age:.1f} s although the command moved by more than "
                f"{np.degrees(COMMAND_TRAVEL):.0f} deg: the answers are old, or the arm is blocked or switched off"
            )
        return age if age > REPEAT_GRACE else 0.0
