"""Requests that are none of the arm's joints, such as those of a gripper, passed on to the robot itself.

Only the control loop speaks to the robot. So the server leaves a request here and waits; the loop takes it once in a
cycle. What a robot once left without an answer is not asked again: each such question would hold the loop up.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

from rejoint.system.errors import RobotError

PATIENCE = 0.25
"""[s] for which the server waits (chosen: clients over TCP give up after 0.3)"""

Passes = Callable[[int, bytes], bytes | None]
"""Asks the robot: the id of a command and its payload to the payload of the answer, None where there is none"""


@dataclass(eq=False)
class _Request:
    command: int
    payload: bytes
    answer: bytes | None = None
    done: threading.Event = field(default_factory=threading.Event)


class Relay:
    """One request at a time on its way from the server to the control loop; ``passes`` None answers nothing."""

    def __init__(self, passes: Passes | None) -> None:
        self._passes = passes
        self._waiting: _Request | None = None
        self._silent: set[int] = set()

    def ask(self, command: int, payload: bytes) -> bytes | None:
        """Return the payload of the robot's answer, None where there is none in time. For the server's thread."""
        if self._passes is None or command in self._silent:
            return None
        request = _Request(command, payload)
        self._waiting = request
        request.done.wait(PATIENCE)
        return request.answer

    def serve(self) -> None:
        """Pass on what waits. For the control loop."""
        request, self._waiting = self._waiting, None
        if request is None or self._passes is None:
            return
        try:
            request.answer = self._passes(request.command, request.payload)
        except RobotError:
            request.answer = None
        if request.answer is None:
            self._silent.add(request.command)
        request.done.set()
