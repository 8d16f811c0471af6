"""The motions of the arm of `rejoint.connect`, each in a thread of its own: to a point, and along a path."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np

from rejoint.arms import Array, tcp_position
from rejoint.arms.orientation import Orientation
from rejoint.control.controller import ControlInput, turned_off
from rejoint.control.moving.drive import Followed
from rejoint.control.moving.path import Path
from rejoint.control.moving.routes import Stream
from rejoint.control.robot import Mask
from rejoint.robots.serving.served import CALM
from rejoint.runs.stages.armdrive import ArmCarrier, ArmDrive, EndedError
from rejoint.runs.stages.pathdrive import Follower, PathDrive
from rejoint.system.errors import NotReachedError


class MotionThread(threading.Thread, ABC):
    """One motion; `error` is what ended it early."""

    def __init__(self, goal: str) -> None:
        super().__init__(name="motion", daemon=True)
        self.goal, self.ended = goal, threading.Event()
        """where the arm is on its way to, in words; set to end the motion"""
        self.error: BaseException | None = None

    def run(self) -> None:
        """Drive until the motion is over, or its end is asked for."""
        try:
            self._go()
        except EndedError:
            pass
        except BaseException as error:  # noqa: BLE001 - raised again where somebody waits
            self.error = error

    @abstractmethod
    def _go(self) -> None: ...


class MoveTo(MotionThread):
    """A motion to a target (3,) [m], with the tool turned as in ``turn`` (), ``within`` metres and radians."""

    def __init__(
        self, drive: ArmDrive, target: Array, within: tuple[float, float], timeout: float,
        turn: Orientation | None = None,
    ) -> None:  # fmt: skip
        super().__init__(_mm(target))
        self._drive, self._target, self._turn, self._timeout = drive, target, turn, timeout
        self._within, self._turned_within = within
        self._near_since: float | None = None
        self._reached, self._error, self._turned = False, float("nan"), float("nan")

    def _go(self) -> None:
        self._drive.to_target(self._target, self._turn, self._timeout, self._done)
        if not (self._reached or self.ended.is_set()):
            wanted, left = f"{1e3 * self._within:g} mm", f"{1e3 * self._error:.1f} mm"
            if np.isfinite(self._turned):
                wanted += f" and {np.degrees(self._turned_within):g} deg"
                left += f" and {np.degrees(self._turned):.1f} deg"
            raise NotReachedError(
                f"the arm did not come within {wanted} of {self.goal} in {self._timeout:g} s, still {left} off; it "
                "holds. Give it more time or room, or look whether something is in its way"
            )

    def _done(self, inputs: ControlInput) -> Mask:
        tool = tcp_position(self._drive.robot.arm, inputs.state.position[0])
        self._error = float(np.linalg.norm(inputs.target[0] - tool))
        now = float(inputs.state.time[0])
        since = self._near_since if self._near_since is not None else now
        self._turned = float(turned_off(self._drive.robot.arm, inputs)[0])
        near = self._error < self._within and not self._turned > self._turned_within
        self._near_since = since if near else None
        self._reached = self._near_since is not None and now - self._near_since >= CALM
        return np.array([self._reached or self.ended.is_set()])


class AlongPath(MotionThread):
    """A motion along a path, or behind a stream for ``duration`` [s]."""

    def __init__(
        self, drive: ArmDrive, path: Path | Stream, follower: Follower, *, repeat: int, rate: float | None,
        duration: float | None, within: float, keep: Callable[[Followed], None],
    ) -> None:  # fmt: skip
        super().__init__("the end of its path")
        self._drive, self._path, self._follower = drive, path, follower
        self._repeat, self._rate, self._duration, self._within, self._keep = repeat, rate, duration, within, keep

    def _go(self) -> None:
        drive = self._drive
        sent, usual = drive.begin()
        along = PathDrive(
            arm=drive.robot.arm, follower=self._follower, usual=usual, correction=drive.correction,
            within=self._within, carrier=ArmCarrier(drive=drive, ended=self.ended),
        )  # fmt: skip
        if isinstance(self._path, Stream):
            self._keep(along.behind(self._path, self._duration or 0.0, sent))
        else:
            self._keep(along.along(self._path, self._repeat, self._rate, sent))


def _mm(point: Array) -> str:
    return f"({', '.join(f'{1e3 * value:.0f}' for value in point)}) mm"
