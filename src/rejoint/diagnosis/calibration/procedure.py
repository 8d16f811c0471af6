"""Measuring an arm: slowly and under the guard from posture to posture, each from two sides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.control.comparison.iso import reversal
from rejoint.control.guard import GuardLimits
from rejoint.control.playback import move
from rejoint.control.recording import Recording
from rejoint.control.robot import Robot
from rejoint.control.start import Stance, begin
from rejoint.diagnosis.calibration.gauges import Gauge, Stop
from rejoint.diagnosis.calibration.measurements import Measurements, MeasuringSession
from rejoint.diagnosis.calibration.postures import Suggestion
from rejoint.system.errors import InputError, NotReadyError
from rejoint.system.progress import Progress, no_progress
from rejoint.system.stopping import check, noted

SPEED = 0.5
"""[rad/s] of the fastest joint on the way (chosen: a fifth of what joints can do)"""
SETTLE = 1.5
"""[s] in which an arm comes to rest (chosen: worn arms ring for less than one)"""
WINDOW = 0.4
"""[s] at its end whose readings are averaged (chosen: 16 at 25 ms)"""
MOVED = np.radians(2.0)
"""[rad] that a joint may have gone while its arm was measured (chosen: what hunts in its play stays within, and more is
a centimetre at the tool)"""
TRIES = 3
"""Times that a posture is measured in which the arm did not stand still (chosen)"""
OnMeasured = Callable[[Measurements, int], object]
"""Called after each posture with all measurements and how many postures were measured or left out, to keep them"""


@dataclass(kw_only=True, eq=False)
class _Rows:
    position: list[Array] = field(default_factory=list)
    approach: list[Array] = field(default_factory=list)
    point: list[Array] = field(default_factory=list)
    posture: list[int] = field(default_factory=list)

    @classmethod
    def of(cls, measured: Measurements | None) -> _Rows:
        if measured is None:
            return cls()
        return cls(
            position=list(measured.position), approach=list(measured.approach), point=list(measured.point),
            posture=measured.posture.tolist(),
        )  # fmt: skip

    def measurements(self, gauge: Gauge) -> Measurements:
        return Measurements(
            position=np.array(self.position), approach=np.array(self.approach), point=np.array(self.point),
            sigma=np.full(len(self.posture), gauge.sigma), posture=np.array(self.posture), frame=gauge.frame,
            source=gauge.source,
        )  # fmt: skip


def measure(
    robot: Robot, gauge: Gauge, plan: Suggestion, *, limits: GuardLimits | None = None,
    stance: Stance | None = None, on_progress: Progress = no_progress, on_measured: OnMeasured | None = None,
    begun: tuple[Measurements, MeasuringSession] | None = None,
) -> Measurements:  # fmt: skip
    """Bring one arm to the postures of ``plan``, each from where it says, and measure the tool there.

    It goes on with what was ``begun`` of the same plan; nothing moves where all of that is done. A posture that was
    not kept while it was measured is measured again. InputError where nothing was measured, NotReadyError where the
    arm does not stand still; what `run` raises where the motion had to be ended.
    """
    total = len(plan.posture)
    earlier, done = (None, 0) if begun is None else (begun[0], begun[1].answered)
    if earlier is not None and done >= total:
        return earlier
    drive, rows = StandingDrive(robot, limits, stance), _Rows.of(earlier)
    for number in range(done, total):
        on_progress(number / total, f"measurement {number + 1} of {total}")
        found = _measured(drive, gauge, plan, number)
        if found is not None:
            position, approach, point = found
            rows.position.append(position)
            rows.approach.append(approach)
            rows.point.append(point)
            rows.posture.append(int(plan.posture[number]))
        if on_measured is not None and rows.posture:
            on_measured(rows.measurements(gauge), number + 1)
    on_progress(1.0, "measured")
    drive.rest()
    if not rows.posture:
        raise InputError("calibration: nothing was measured; type x, y and z of the tool at each stop")
    return rows.measurements(gauge)


class StandingDrive:
    """Brings one arm to postures, slowly and under the guard, to stand still in each; begins at rest."""

    def __init__(self, robot: Robot, limits: GuardLimits | None = None, stance: Stance | None = None) -> None:
        self.robot, self._limits = robot, limits or GuardLimits.of(robot.arm)
        with noted():
            self._sent = begin(robot, self._limits, stance).command[-1]

    def stand(self, posture: Array, before: Array) -> tuple[Array, Array]:
        """Go to ``before`` (n,) [rad] and from there to ``posture`` (n,); return the readings (n,) here and there."""
        came = self._go(before, settle=0.3)
        return _reading(self._go(posture, settle=SETTLE)), came.position[-1, 0]

    def rest(self) -> None:
        """Go back to the rest posture."""
        with noted():
            move(self.robot, self.robot.arm.rest, sent=self._sent, limits=self._limits)

    def _go(self, posture: Array, settle: float) -> Recording:
        with noted():
            gone = move(self.robot, posture, sent=self._sent, speed=SPEED, settle=settle, limits=self._limits)
        self._sent = gone.command[-1]
        return gone


def _measured(drive: StandingDrive, gauge: Gauge, plan: Suggestion, number: int) -> tuple[Array, Array, Array] | None:
    """Measure at one posture, again where it was not kept: readings (n,) there and before, and the tool (3,).

    None where it is left out.
    """
    robot, again = drive.robot, ""
    for _ in range(TRIES):
        position, approach = drive.stand(plan.postures[number], plan.approach[number])
        stop = Stop(number + 1, len(plan.posture), tcp_position(robot.arm, position), again)
        point = gauge.measure(robot, stop)
        check()
        if not np.isfinite(point).any():
            return None
        again = _gone(robot, position)
        if not again:
            return position, approach, point
    raise NotReadyError(f"{again}, {TRIES} times; what moves it?")


def _gone(robot: Robot, position: Array) -> str:
    """Say which joint went how far from ``position`` (n,) [rad] while the arm was measured; nothing where none did."""
    with noted():
        away = np.abs(robot.read().position[0] - position)
    j = int(np.argmax(away))
    if away[j] <= MOVED:
        return ""
    return f"{robot.arm.joint_names[j]} went {np.degrees(away[j]):.0f} deg while the arm was measured"


def _reading(recording: Recording) -> Array:
    """Mean of the last readings (n,) [rad]."""
    rows = recording.time[:, 0] > recording.time[-1, 0] - WINDOW
    return np.asarray(recording.position[rows, 0].mean(axis=0))


def reversals(arm: Arm, measured: Measurements, frame: Array) -> tuple[float, ...]:
    """Reversal values [m] at the tool (ISO 230-2) of the postures that were measured from both sides, once each.

    What the encoders saw of the difference is taken out: it is what lies behind them that counts. ``frame`` (4, 4) is
    the pose of the measuring frame in the base.
    """
    away = measured.point @ frame[:3, :3].T + frame[:3, 3] - tcp_position(arm, measured.position)
    found = []
    for number in np.unique(measured.posture):
        both = away[measured.posture == number]
        if len(both) == 2 and np.isfinite(both).all():
            found.append(float(reversal(both[:1], both[1:])))
    return tuple(found)
