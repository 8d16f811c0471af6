"""The motion for a diagnosis: a seeded plan, checked before the arm moves.

Segments: ``approach``; ``still`` (noise, hunting); ``sweep``, slow, at two speeds; ``step`` of each joint alone (lag,
overshoot); ``multisine``, band-limited (dynamics); ``hold``, postures of different gravity torques, from both sides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from rejoint.arms import Arm, Array, gravity_torque
from rejoint.arms.workspace import (
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
from rejoint.control.recording import OnCycle
from rejoint.control.robot import Robot
from rejoint.control.start import begin, move, play
from rejoint.control.targets import draw_set
from rejoint.diagnosis.segments import DWELL, TARGETS, TARGETS_LABEL, Segment, attach_segments
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.numbers import interpolated
from rejoint.system.progress import Progress, no_progress, part
from rejoint.system.records import entity, value_type


class Excitation:
    """A joint trajectory in named segments, from a posture (n,) [rad] at time 0."""

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        self.time: Array = np.zeros(1)
        """(K,) [s] of the knots"""
        self.position: Array = arm.rest[None]
        """(K, n) [rad] of the knots, linear between"""
        self.segments: list[Segment] = []

    @property
    def duration(self) -> float:
        """[s]."""
        return float(self.time[-1])

    def command(self, time: float | Array) -> Array:
        """Joint positions (..., n) [rad] at ``time`` (...) [s]; held before and after."""
        return interpolated(time, self.time, self.position)

    @contextmanager
    def segment(self, name: str, kind: str, joints: tuple[int, ...] = ()) -> Iterator[None]:
        """Name what the ``with`` block adds."""
        start = self.duration
        yield
        self.segments.append(Segment(name=name, kind=kind, start=start, stop=self.duration, joints=joints))

    def wait(self, duration: float) -> None:
        """Stay for ``duration`` [s]."""
        self._add(duration, self.position[-1])

    def travel(self, goal: Array, speed: float) -> None:
        """Go straight to ``goal`` (n,) [rad], the farthest joint at ``speed`` [rad/s]."""
        self._add(np.abs(goal - self.position[-1]).max() / speed, goal)

    def sweep(self, plan: Plan, travel: float) -> None:
        """Sweep all joints about rest, as planned; ``travel`` [rad/s] in between."""
        rest, joints = self.arm.rest, tuple(range(self.arm.joints))
        way = plan.sweep_amplitude * (-1.0) ** (np.arange(self.arm.joints) // 2)  # each with one neighbour opposed
        for index, (speed, cycles) in enumerate(zip(plan.sweep_speeds, plan.sweep_cycles, strict=True)):
            self.travel(rest - way, travel)
            self.wait(SETTLE)
            for half in range(2 * cycles):
                with self.segment(f"sweep/{index}/{half}", "sweep", joints):
                    self.travel(rest + (way if half % 2 == 0 else -way), speed)
        self.travel(rest, travel)
        self.wait(SETTLE)

    def approach(self, begin: Array, posture: Array, plan: Plan) -> None:
        """Come slowly to a ``posture`` (n,) [rad], from ``begin`` (n,) [rad]."""
        self.travel(begin, plan.travel_speed)
        self.wait(SETTLE)
        self.travel(posture, plan.hold_speed)

    def follow(self, time: Array, position: Array) -> None:
        """Append samples (K,) [s] from 0 and (K, n) [rad] from here."""
        self.time = np.append(self.time, self.duration + time[1:])
        self.position = np.vstack([self.position, position[1:]])

    def _add(self, duration: float, goal: Array) -> None:
        if duration > 0.0:
            self.follow(np.array([0.0, duration]), np.stack([goal, goal]))


@value_type
class Plan:
    """Amplitudes, speeds and durations of an excitation, about 60 s; chosen."""

    still: float = 2.0
    """[s]"""
    sweep_amplitude: float = 0.18
    """[rad]; several times a worn joint's hysteresis"""
    sweep_speeds: tuple[float, ...] = (0.2, 0.5)
    """[rad/s]; three times the Stribeck velocity; fast: viscous lag outweighs friction"""
    sweep_cycles: tuple[int, ...] = (2, 4)
    step_size: float = 0.2
    """[rad]; half of the guard's limit"""
    step_dwell: float = 0.85
    """[s]; nearly two periods of 2 Hz"""
    step_speed: float = 2.0
    """[rad/s]; just below the ramp of small servos"""
    multisine_period: float = 15.0
    """[s]"""
    multisine_band: float = 2.5
    """[Hz] highest line"""
    multisine_amplitude: float = 0.4
    """[rad] largest excursion, less where it is not safe"""
    multisine_speed: float = 2.0
    """[rad/s] largest speed"""
    hold_offset: float = HOLD_OFFSET
    """[rad] of the approach"""
    hold_speed: float = 0.3
    """[rad/s] at its end"""
    hold_dwell: float = 0.6
    """[s]"""
    travel_speed: float = 0.8
    """[rad/s] between postures"""
    posture_spread: float = HOLD_SPREAD
    """[rad] largest distance of hold postures from rest"""
    region: float = 1.0
    """share of the region of a check's poses"""


SETTLE = 0.3
"""[s] pause between segments; chosen"""

HOLDS = 4
"""Postures that are held; chosen"""

_ATTEMPTS, _SMALLER = 12, 0.8
"""Attempts, and factor on too large amplitudes; chosen"""

_LEAST_SPREAD = 0.2
"""[rad] least spread of hold postures; chosen"""

_AMPLITUDES = {
    "sweep": ("sweep_amplitude",),
    "step": ("step_size",),
    "multisine": ("multisine_amplitude",),
    "hold": ("posture_spread",),
    "pose": ("region", "hold_offset"),
}
"""Fields of `Plan` to reduce if unsafe"""

_REMEDY = (
    "give another rest_deg in the arm's TOML file, farther from the floor, from the joint limits and from postures "
    "that load the arm more than its targets do, or leave out rest_deg and targets to have them derived; where "
    "joints move the TCP on a surface only, choose another tip"
)


def plan_excitation(arm: Arm, *, seed: int) -> Excitation:
    """Plan the excitation of an arm at rest.

    Slows and shrinks motion; InputError if that does not suffice.
    """

    def build(plan: Plan) -> Excitation:
        rng, path = np.random.default_rng(seed), Excitation(arm)
        with path.segment("approach", "approach"):
            path.wait(0.5)
        with path.segment("still", "still"):
            path.wait(plan.still)
        path.sweep(plan, plan.travel_speed / 2)
        _add_steps(path, plan)
        _add_multisine(path, plan, rng)
        _add_holds(path, plan, rng)
        with path.segment("return", "approach"):
            path.travel(arm.rest, plan.travel_speed / 2)
        return path

    plan, slower = Plan(), max(1.0, length_size(arm)) ** 0.5  # as long arms swing
    waits = {name: slower * getattr(plan, name) for name in ("still", "step_dwell", "hold_dwell")}
    return fitted(arm, replace(plan, **waits), build)


def fitted(arm: Arm, plan: Plan, build: Callable[[Plan], Excitation]) -> Excitation:
    """Motion that ``build`` makes of the plan, slowed for the arm, with safe amplitudes."""
    if why := unsafe(arm, arm.rest):
        raise InputError(f"arm {arm.name}: its rest posture is not safe to excite it about: {why}; {_REMEDY}")
    limit = arm.max_speed.min()
    most = {"step_speed": 0.8, "multisine_speed": 0.6, "travel_speed": 0.4, "hold_speed": 0.2}
    plan = replace(
        plan,
        multisine_band=plan.multisine_band / max(length_size(arm), 1.0) ** 0.5,
        sweep_speeds=tuple(min(speed, 0.2 * limit) for speed in plan.sweep_speeds),
        **{name: min(getattr(plan, name), share * limit) for name, share in most.items()},
    )
    for _ in range(_ATTEMPTS):
        motion = build(plan)
        time = np.union1d(motion.time, np.arange(0.0, motion.duration, 0.05))
        safe = is_safe(arm, q := motion.command(time))
        if safe.all():
            return motion
        first = np.argmin(safe)
        segment = next((s for s in motion.segments if s.stop >= time[first]), motion.segments[-1])
        where = f"{segment.name!r} ({unsafe(arm, q[first])})"
        if segment.kind not in _AMPLITUDES:
            break
        plan = replace(plan, **{name: _SMALLER * getattr(plan, name) for name in _AMPLITUDES[segment.kind]})
    raise InputError(f"arm {arm.name}: its motion is not safe in {where}; {_REMEDY}")


def _add_steps(path: Excitation, plan: Plan) -> None:
    half = (path.arm.joints + 1) // 2
    for first in range(half):
        joints = tuple(range(first, path.arm.joints, half))
        for index, side in enumerate((1.0, 0.0, -1.0, 0.0)):
            goal = path.arm.rest.copy()
            goal[list(joints)] += side * plan.step_size
            with path.segment(f"step/{first}/{index}", "step", joints):
                path.travel(goal, plan.step_speed)
                path.wait(plan.step_dwell)


def _add_multisine(path: Excitation, plan: Plan, rng: np.random.Generator) -> None:
    joints, duration = path.arm.joints, plan.multisine_period
    time = np.arange(0.0, duration + 1e-9, 0.01)
    lines = np.arange(1, int(plan.multisine_band * duration) + 1)
    motion = np.zeros((len(time), joints))
    for joint in range(joints):
        own = lines[lines % joints == joint % joints]
        phase = rng.uniform(0.0, 2 * np.pi, len(own))
        angle = 2 * np.pi * np.outer(time, own) / duration + phase
        wave = (np.cos(angle) / np.sqrt(own)).sum(axis=1)  # 1/sqrt(f): between equal position and equal speed
        speed = np.abs(np.gradient(wave, time)).max()
        motion[:, joint] = wave * min(plan.multisine_amplitude / np.abs(wave).max(), plan.multisine_speed / speed)
    rise, fall = (0.5 - 0.5 * np.cos(np.pi * np.clip(t, 0.0, 1.0)) for t in (time, duration - time))
    with path.segment("multisine", "multisine", tuple(range(joints))):
        path.follow(time, path.arm.rest + (rise * fall)[:, None] * motion)
        path.wait(SETTLE)


def _add_holds(path: Excitation, plan: Plan, rng: np.random.Generator) -> None:
    arm = path.arm
    for index, posture in enumerate(_hold_postures(arm, plan, rng)):
        for side, name in ((-1.0, "below"), (1.0, "above")):
            begin = posture + side * plan.hold_offset
            if not line_is_safe(arm, path.position[-1], begin):
                path.travel(arm.rest, plan.travel_speed)
            path.approach(begin, posture, plan)
            with path.segment(f"hold/{index}/{name}", "hold", tuple(range(arm.joints))):
                path.wait(plan.hold_dwell)


def _hold_postures(arm: Arm, plan: Plan, rng: np.random.Generator) -> Array:
    """Postures (P, n) [rad] of most different scaled gravity torques (farthest-point sampling)."""
    spread = plan.posture_spread
    while len(q := postures_to_hold(arm, rng, spread=spread, offset=plan.hold_offset)) < HOLDS:
        if spread <= _LEAST_SPREAD:
            raise InputError(
                f"arm {arm.name}: only {len(q)} of {POSTURES} postures around its rest posture are safe, expected "
                f"{HOLDS} to hold; {_REMEDY}"
            )
        spread *= _SMALLER
    torque = gravity_torque(arm, q)
    torque = torque / np.maximum(np.abs(torque).max(axis=0), LOAD_MARGIN * torque_size(arm))
    chosen = [np.argmax(np.linalg.norm(torque - torque.mean(axis=0), axis=1))]
    distance = np.full(len(q), np.inf)
    while len(chosen) < HOLDS:
        distance = np.minimum(distance, np.linalg.norm(torque - torque[chosen[-1]], axis=1))
        chosen.append(np.argmax(distance))
    return q[chosen]


EXCITATION_LABEL = "diagnosis/excitation"


@entity
class DiagnosisLogs:
    """Logs for a diagnosis of one arm."""

    targets: RunLog
    """ten targets open loop"""
    excitation: RunLog
    """segments in ``extra``"""


def record(robot: Robot, *, seed: int, on_progress: Progress = no_progress) -> tuple[DiagnosisLogs, ...]:
    """Drive every arm through the diagnosis; return the logs of each.

    NotReadyError before it moves if unsafe; GuardTripError or RobotError if the motion had to be ended.
    """
    arm, extra = robot.arm, {"seed": str(seed)}
    excitation = plan_excitation(arm, seed=seed)  # refused, if it is, before anything moves
    rng = np.random.default_rng(seed)
    targets = np.stack([draw_set(arm, rng, TARGETS) for _ in range(robot.count)])
    duration, sent = TARGETS * DWELL, begin(robot).command[-1]
    share = duration / (duration + excitation.duration)
    see = reporting("ten targets", duration, part(on_progress, 0.0, share), robot)
    open_loop = run(robot, DefaultController(arm), targets, Schedule(dwell=DWELL, sent=sent), on_cycle=see)
    move(robot, arm.rest)
    return tuple(
        DiagnosisLogs(targets=open_loop.log(b, TARGETS_LABEL, extra), excitation=log)
        for b, log in enumerate(played(robot, excitation, EXCITATION_LABEL, part(on_progress, share, 1.0), extra))
    )


def played(
    robot: Robot, excitation: Excitation, label: str, on_progress: Progress, extra: dict[str, str] | None = None
) -> list[RunLog]:
    """Drive every arm through an excitation; return the logs of each, with its segments."""
    see = reporting(label.rpartition("/")[2], excitation.duration, on_progress, robot)
    done = play(robot, excitation.command, excitation.duration, on_cycle=see)
    return [attach_segments(done.log(b, label, extra), excitation.segments, done.waits(b)) for b in range(robot.count)]


def reporting(what: str, duration: float, on_progress: Progress, robot: Robot) -> OnCycle:
    """Progress callback for a motion of ``duration`` [s]."""
    since = robot.read().time[0]
    return lambda cycle: on_progress(float(min((cycle.time[0] - since) / duration, 1.0)), what)
