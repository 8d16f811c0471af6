"""The control loop behind a served arm: the one loop, in pieces of minutes, until it is told to end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from rejoint.arms import Array, tcp_position
from rejoint.control.controller import ControlInput
from rejoint.control.guard import GuardLimits, Reason, reason_names
from rejoint.control.loop import Schedule, run
from rejoint.control.posture import PostureController, Wanted
from rejoint.control.recording import PIECE, Cycle, Recording, recording_of
from rejoint.control.robot import JointState, Mask, Robot
from rejoint.robots.serving.relay import Relay
from rejoint.robots.serving.served import ServedArm

LONGEST_PIECE = 3.0 * PIECE
"""[s] after which a piece of the motion is written as a run log, whether the arm rests or not (chosen, as `PIECE`)"""

OBSTACLES = np.uint16(Reason.FLOOR | Reason.COLLISION | Reason.POSITION)
"""What the guard keeps an arm from for good, other than a speed"""


class MotionLog(Protocol):
    """What keeps the motion, piece by piece; `rejoint.runs.stages.longlog.LongLog` is one."""

    def see(self, cycle: Cycle) -> None:
        """Take a control cycle."""

    def turn(self, piece: Recording | None) -> None:
        """End a piece, which is kept unless it is None, and begin the next one."""

    def rescue(self, piece: Recording | None) -> str:
        """End a piece that failed; returns what became of it."""


class ServedWay:
    """The way of a served arm, and where it had the tool in every cycle."""

    def __init__(self, served: ServedArm) -> None:
        self._served = served
        self.place = np.full(3, np.nan)
        """(3,) [m] where the tool is to be, by the encoders"""

    def advance(self, state: JointState) -> Wanted:
        """See `ServedArm.advance`."""
        wanted = self._served.advance(state)
        self.place = tcp_position(self._served.arm, wanted.posture[0])
        return wanted


@dataclass(frozen=True, kw_only=True, eq=False)
class ServedDrive:
    """What is driven, and how."""

    robot: Robot
    served: ServedArm
    controller: PostureController
    way: ServedWay
    """that the controller follows"""
    limits: GuardLimits
    relay: Relay
    over: Callable[[], bool]
    """whether to end; asked once a cycle"""
    orders: Callable[[], int]
    """how many orders have come"""

    def until_over(self, sent: Array, log: MotionLog) -> None:
        """Drive, with the command ``sent`` (1, n) [rad] in force; ``log`` keeps the pieces in which something came.

        Raises what `run` raises, with a note of what became of the log; the arm holds then.
        """
        while not self.over():
            places: list[Array] = []
            before, moving = self.orders(), self.served.moving
            try:
                recording = self._piece(sent, log, places)
            except BaseException as error:
                partial = recording_of(error)
                error.add_note(log.rescue(None if partial is None else _with_places(partial, places)))
                raise
            idle = self.orders() == before and not moving  # an arm that nobody orders for days fills no disk
            log.turn(None if idle else _with_places(recording, places))
            sent = recording.command[-1]

    def _piece(self, sent: Array, log: MotionLog, places: list[Array]) -> Recording:
        def watch(cycle: Cycle) -> None:
            places.append(self.way.place)
            self.served.held_back = " and ".join(reason_names(cycle.reasons[0] & OBSTACLES))
            log.see(cycle._replace(target=self.way.place[None]))
            self.relay.serve()

        def give_up(inputs: ControlInput) -> Mask:
            rests = bool(inputs.since_target[0] > PIECE) and not self.served.moving
            return np.array([rests or self.over()])

        nowhere = np.full((1, 1, 3), np.nan)  # postures are followed, and no target
        schedule = Schedule(dwell=LONGEST_PIECE, sent=sent, give_up=give_up)
        return run(self.robot, self.controller, nowhere, schedule, limits=self.limits, on_cycle=watch)


def _with_places(recording: Recording, places: list[Array]) -> Recording:
    """Return the recording with where the tool was to be as its targets."""
    rows = len(recording.time)
    filled = np.array([*places[:rows], *[np.full(3, np.nan)] * (rows - len(places))]).reshape(rows, 1, 3)
    return replace(recording, target=filled, aim=filled)
