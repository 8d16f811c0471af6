"""The motion for a diagnosis: a seeded plan, checked before the arm moves.

Segments: ``approach``; ``still`` (noise, hunting); ``sweep``, slow, at two speeds; ``step`` of each joint alone (lag,
overshoot); ``multisine``, band-limited (dynamics); ``hold``, postures of different gravity torques, from both sides.

Postures respect joint limits, floor, column and the largest load.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from rejoint.arms import Arm, Array, gravity_torque
from rejoint.arms.workspace import (
    EXCURSION,
    HOLD_OFFSET,
    HOLD_SPREAD,
    LOAD_MARGIN,
    POSTURES,
    is_safe,
    length_size,
    line_is_safe,
    postures_to_hold,
    torque_size,
    unsafe,
)
from rejoint.control.controllers.classical import DefaultController
from rejoint.control.loop import Schedule, run
from rejoint.control.recording import Cycle, OnCycle
from rejoint.control.robot import Robot
from rejoint.control.start import begin, move, play
from rejoint.diagnosis.open_loop import DWELL, TARGETS
from rejoint.diagnosis.segments import Segment, attach_segments
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.progress import Progress, no_progress, part


def swept(arm: Arm, joints: tuple[int, ...]) -> Array:
    """Signs (n,) of a group's motion, neighbours opposed; zero for the others."""
    sign = np.zeros(arm.joints)
    sign[list(joints)] = np.where(np.arange(len(joints)) % 2, -1.0, 1.0)
    return sign


class CommandPath:
    """Knots of a trajectory from a posture (n,) [rad] at time 0."""

    def __init__(self, start: Array) -> None:
        self._time = [0.0]
        self._position = [np.array(start, dtype=float)]
        self._segments: list[Segment] = []

    @property
    def segments(self) -> tuple[Segment, ...]:
        """Segments so far."""
        return tuple(self._segments)

    @property
    def end(self) -> Array:
        """(n,) [rad] last knot."""
        return self._position[-1]

    @contextmanager
    def segment(self, name: str, kind: str, joints: tuple[int, ...] = ()) -> Iterator[None]:
        """Name what the ``with`` block adds."""
        start = self._time[-1]
        yield
        self._segments.append(Segment(name=name, kind=kind, start=start, stop=self._time[-1], joints=joints))

    def wait(self, duration: float) -> None:
        """Stay for ``duration`` [s]."""
        self._add(duration, self._position[-1])

    def travel(self, goal: Array, speed: float) -> None:
        """Go straight to ``goal`` (n,) [rad], the farthest joint at ``speed`` [rad/s]."""
        self._add(float(np.abs(goal - self._position[-1]).max()) / speed, goal)

    def sweep(self, arm: Arm, amplitude: float, travel: float, speeds: Sequence[tuple[float, int]]) -> None:
        """Sweep every other joint about rest by ``amplitude`` [rad].

        ``speeds``: [rad/s] and cycles; ``travel`` [rad/s] in between.
        """
        for group in (range(0, arm.joints, 2), range(1, arm.joints, 2)):
            joints = tuple(group)
            way = amplitude * swept(arm, joints)
            for index, (speed, cycles) in enumerate(speeds):
                self.travel(arm.rest - way, travel)
                self.wait(_SETTLE)
                for half in range(2 * cycles):
                    with self.segment(f"sweep/{'-'.join(map(str, joints))}/{index}/{half}", "sweep", joints):
                        self.travel(arm.rest + (way if half % 2 == 0 else -way), speed)
            self.travel(arm.rest, travel)
            self.wait(_SETTLE)

    def follow(self, time: Array, position: Array) -> None:
        """Append samples (K,) [s] from 0 and (K, n) [rad] from here."""
        begin = self._time[-1]
        self._time.extend((begin + time[1:]).tolist())
        self._position.extend(position[1:])

    def knots(self) -> tuple[Array, Array]:
        """Return times (K,) [s] and positions (K, n) [rad]."""
        return np.array(self._time), np.array(self._position)

    def _add(self, duration: float, goal: Array) -> None:
        if duration > 0.0:
            self._time.append(self._time[-1] + duration)
            self._position.append(np.array(goal, dtype=float))


def smooth_ramp(time: Array) -> Array:
    """Rise smoothly from 0 to 1 within a second."""
    return 0.5 - 0.5 * np.cos(np.pi * np.clip(time, 0.0, 1.0))


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Amplitudes, speeds and durations of an excitation; defaults chosen."""

    still: float = 3.0
    """[s]"""
    sweep_amplitude: float = 0.18
    """[rad]; several times a worn joint's hysteresis"""
    sweep_speeds: tuple[float, ...] = (0.12, 0.5)
    """[rad/s]; twice the Stribeck velocity; fast: viscous lag outweighs friction"""
    sweep_cycles: tuple[int, ...] = (2, 4)
    step_size: float = 0.2
    """[rad]; half of the guard's limit"""
    step_dwell: float = 1.0
    """[s]; several periods of 2 Hz"""
    step_speed: float = 2.0
    """[rad/s]; just below the ramp of small servos"""
    multisine_period: float = 15.0
    """[s]"""
    multisine_periods: int = 2
    multisine_band: float = 2.5
    """[Hz] highest line"""
    multisine_amplitude: float = EXCURSION
    """[rad] largest excursion"""
    multisine_speed: float = 1.5
    """[rad/s] largest speed"""
    postures: int = 8
    hold_offset: float = HOLD_OFFSET
    """[rad] of the approach"""
    hold_speed: float = 0.3
    """[rad/s] at its end"""
    hold_dwell: float = 1.0
    """[s]"""
    travel_speed: float = 0.8
    """[rad/s] between postures"""
    posture_spread: float = HOLD_SPREAD
    """[rad] largest distance of hold postures from rest"""


FULL = Plan()
"""About 130 s"""

SHORT = Plan(sweep_cycles=(1, 2), multisine_periods=1, postures=5, step_dwell=0.8, still=2.0)
"""About 75 s, with wider intervals"""

_SETTLE = 0.3
"""[s] pause between segments; chosen"""

_ATTEMPTS, _SMALLER = 12, 0.8
"""Attempts, and factor on too large amplitudes; chosen"""

_LEAST_SPREAD = 0.2
"""[rad] least spread of hold postures; chosen"""

_AMPLITUDES = {
    "sweep": "sweep_amplitude",
    "step": "step_size",
    "multisine": "multisine_amplitude",
    "hold": "posture_spread",
}
"""Field of `Plan` to reduce if unsafe"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Excitation:
    """A joint trajectory in named segments."""

    arm: Arm
    segments: tuple[Segment, ...]
    time: Array
    """(K,) [s] from 0"""
    position: Array
    """(K, n) [rad], linear between"""

    @property
    def duration(self) -> float:
        """[s]."""
        return float(self.time[-1])

    def command(self, time: float | Array) -> Array:
        """Joint positions (..., n) [rad] at ``time`` (...) [s]; held before and after."""
        t = np.asarray(time, dtype=float)
        return np.stack([np.interp(t, self.time, column) for column in self.position.T], axis=-1)


_REMEDY = (
    "give another rest_deg in the arm's TOML file, farther from the floor, from the joint limits and from postures "
    "that load the arm more than its targets do, or leave out rest_deg and targets to have them derived; where "
    "joints move the TCP on a surface only, choose another tip"
)


def plan_excitation(arm: Arm, *, seed: int, start: Array | None = None, plan: Plan = FULL) -> Excitation:
    """Plan the excitation of an arm at ``start`` (n,) [rad] (default: rest).

    Slows and shrinks motion; InputError if that does not suffice.
    """
    why = unsafe(arm, arm.rest)
    if why:
        raise InputError(f"arm {arm.name}: its rest posture is not safe to excite it about: {why}; {_REMEDY}")
    plan, where = _slowed(plan, arm), "its beginning"
    for _ in range(_ATTEMPTS):
        excitation = _plan_once(arm, seed, arm.rest if start is None else np.asarray(start, dtype=float), plan)
        leaves = _first_leaving(excitation)
        if leaves is None:
            return excitation
        segment, posture = leaves
        where = f"{segment.name!r} ({unsafe(arm, posture)})"
        if segment.kind not in _AMPLITUDES:
            break
        name = _AMPLITUDES[segment.kind]
        plan = replace(plan, **{name: _SMALLER * getattr(plan, name)})
    raise InputError(f"arm {arm.name}: the excitation is not safe in {where}; {_REMEDY}")


def _plan_once(arm: Arm, seed: int, start: Array, plan: Plan) -> Excitation:
    rng = np.random.default_rng(seed)
    path = CommandPath(start)
    with path.segment("approach", "approach"):
        path.travel(arm.rest, plan.travel_speed / 2)
        path.wait(0.5)
    with path.segment("still", "still"):
        path.wait(plan.still)
    speeds = list(zip(plan.sweep_speeds, plan.sweep_cycles, strict=True))
    path.sweep(arm, plan.sweep_amplitude, plan.travel_speed / 2, speeds)
    _add_steps(path, arm, plan)
    _add_multisine(path, arm, plan, rng)
    _add_holds(path, arm, plan, rng)
    with path.segment("return", "approach"):
        path.travel(arm.rest, plan.travel_speed / 2)
    time, position = path.knots()
    return Excitation(arm=arm, segments=path.segments, time=time, position=position)


def _add_steps(path: CommandPath, arm: Arm, plan: Plan) -> None:
    for joint in range(arm.joints):
        for index, side in enumerate((1.0, 0.0, -1.0, 0.0)):
            goal = arm.rest.copy()
            goal[joint] += side * plan.step_size
            with path.segment(f"step/{joint}/{index}", "step", (joint,)):
                path.travel(goal, plan.step_speed)
                path.wait(plan.step_dwell)


def _add_multisine(path: CommandPath, arm: Arm, plan: Plan, rng: np.random.Generator) -> None:
    duration = plan.multisine_period * plan.multisine_periods
    time = np.arange(0.0, duration + 1e-9, 0.01)
    lines = np.arange(1, int(plan.multisine_band * plan.multisine_period) + 1)
    motion = np.zeros((len(time), arm.joints))
    for joint in range(arm.joints):
        own = lines[lines % arm.joints == joint % arm.joints]
        phase = rng.uniform(0.0, 2 * np.pi, len(own))
        angle = 2 * np.pi * np.outer(time, own) / plan.multisine_period + phase
        wave = (np.cos(angle) / np.sqrt(own)).sum(axis=1)  # 1/sqrt(f): between equal position and equal speed
        speed = np.abs(np.gradient(wave, time)).max()
        motion[:, joint] = wave * min(plan.multisine_amplitude / np.abs(wave).max(), plan.multisine_speed / speed)
    fade = smooth_ramp(time) * smooth_ramp(duration - time)
    with path.segment("multisine", "multisine", tuple(range(arm.joints))):
        path.follow(time, arm.rest + fade[:, None] * motion)
        path.wait(_SETTLE)


def _add_holds(path: CommandPath, arm: Arm, plan: Plan, rng: np.random.Generator) -> None:
    for index, posture in enumerate(hold_postures(arm, plan, rng)):
        for side, name in ((-1.0, "below"), (1.0, "above")):
            begin = posture + side * plan.hold_offset
            if not line_is_safe(arm, path.end, begin):
                path.travel(arm.rest, plan.travel_speed)
            path.travel(begin, plan.travel_speed)
            path.wait(_SETTLE)
            path.travel(posture, plan.hold_speed)
            with path.segment(f"hold/{index}/{name}", "hold", tuple(range(arm.joints))):
                path.wait(plan.hold_dwell)


def hold_postures(arm: Arm, plan: Plan, rng: np.random.Generator) -> Array:
    """Postures (P, n) [rad] of most different scaled gravity torques (farthest-point sampling)."""
    spread = plan.posture_spread
    q = postures_to_hold(arm, rng, spread=spread, offset=plan.hold_offset)
    while len(q) < plan.postures and spread > _LEAST_SPREAD:
        spread *= _SMALLER
        q = postures_to_hold(arm, rng, spread=spread, offset=plan.hold_offset)
    if len(q) < plan.postures:
        raise InputError(
            f"arm {arm.name}: only {len(q)} of {POSTURES} postures around its rest posture are safe, expected "
            f"{plan.postures} to hold; {_REMEDY}"
        )
    torque = gravity_torque(arm, q)
    torque = torque / np.maximum(np.abs(torque).max(axis=0), LOAD_MARGIN * torque_size(arm))
    chosen = [int(np.argmax(np.linalg.norm(torque - torque.mean(axis=0), axis=1)))]
    distance = np.full(len(q), np.inf)
    while len(chosen) < plan.postures:
        distance = np.minimum(distance, np.linalg.norm(torque - torque[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance)))
    return q[chosen]


def _slowed(plan: Plan, arm: Arm) -> Plan:
    limit = float(arm.max_speed.min())
    return replace(
        plan,
        multisine_band=plan.multisine_band / max(length_size(arm), 1.0) ** 0.5,
        step_speed=min(plan.step_speed, 0.8 * limit),
        multisine_speed=min(plan.multisine_speed, 0.6 * limit),
        travel_speed=min(plan.travel_speed, 0.4 * limit),
        sweep_speeds=tuple(min(speed, 0.2 * limit) for speed in plan.sweep_speeds),
        hold_speed=min(plan.hold_speed, 0.2 * limit),
    )


def _first_leaving(excitation: Excitation) -> tuple[Segment, Array] | None:
    arm, time, position = excitation.arm, excitation.time, excitation.position
    fine = np.union1d(time, np.arange(0.0, time[-1], 0.05))
    q = np.stack([np.interp(fine, time, column) for column in position.T], axis=-1)
    approach = fine <= time[np.argmax((position == arm.rest).all(axis=1))]  # where the arm came from is not ours
    good = is_safe(arm, q) | approach
    if good.all():
        return None
    first = np.argmin(good)
    segment = next((s for s in excitation.segments if s.stop >= fine[first]), excitation.segments[-1])
    return segment, q[first]


TARGETS_LABEL, EXCITATION_LABEL = "diagnosis/targets", "diagnosis/excitation"


@dataclass(frozen=True, kw_only=True, eq=False)
class DiagnosisLogs:
    """Logs for a diagnosis of one arm."""

    targets: RunLog
    """ten targets open loop"""
    excitation: RunLog
    """segments in ``extra``"""


def record(
    robot: Robot,
    *,
    seed: int,
    plan: Plan = FULL,
    on_progress: Progress = no_progress,
    on_cycle: OnCycle | None = None,
) -> tuple[DiagnosisLogs, ...]:
    """Drive every arm through the diagnosis; return the logs of each.

    NotReadyError before it moves if unsafe; GuardTripError or RobotError if the motion had to be ended.
    """
    arm = robot.arm
    extra = {"seed": str(seed)}
    excitation = plan_excitation(arm, seed=seed, plan=plan)  # refused, if it is, before anything moves
    begin(robot, on_cycle=on_cycle)
    whole, first = TARGETS * DWELL + excitation.duration, TARGETS * DWELL
    targets = np.tile(arm.targets.sample(np.random.default_rng(seed), (TARGETS,)), (robot.count, 1, 1))
    open_loop = run(
        robot,
        DefaultController(arm),
        targets,
        Schedule(dwell=DWELL),
        on_cycle=reporting("ten targets", first, part(on_progress, 0.0, first / whole), on_cycle, robot),
    )
    move(robot, arm.rest, on_cycle=on_cycle)
    excited = play(
        robot,
        excitation.command,
        excitation.duration,
        on_cycle=reporting("excitation", excitation.duration, part(on_progress, first / whole, 1.0), on_cycle, robot),
    )
    return tuple(
        DiagnosisLogs(
            targets=open_loop.log(b, TARGETS_LABEL, extra),
            excitation=attach_segments(excited.log(b, EXCITATION_LABEL, extra), excitation.segments, excited.waits(b)),
        )
        for b in range(robot.count)
    )


def reporting(what: str, duration: float, on_progress: Progress, on_cycle: OnCycle | None, robot: Robot) -> OnCycle:
    """Progress callback for a motion of ``duration`` [s]."""
    since = float(robot.read().time[0])

    def report(cycle: Cycle) -> None:
        if on_cycle is not None:
            on_cycle(cycle)
        on_progress(min((float(cycle.time[0]) - since) / duration, 1.0), what)

    return report
