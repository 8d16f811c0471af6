"""Choice of postures and planned ways: rates and times on one core.

    python -m benchmarks postures

Places and poses are those of random postures that touch nothing. Times are the processor's, so that other programs do
not count. Every planned way is judged by its own clearances at 200 times and by the guard, cycle by cycle.
"""

from __future__ import annotations

from dataclasses import replace
from time import process_time

import numpy as np

from rejoint.arms import (
    Arm,
    Array,
    Box,
    Motors,
    PlanningError,
    choose_postures,
    clearances,
    frames,
    gravity_torque,
    mycobot280,
    plan,
    so101,
)
from rejoint.arms.collision import guarded_floors
from rejoint.arms.rotations import Orientation, tool_axis
from rejoint.control.guard import GuardLimits, guard
from rejoint.control.robot import JointState

WAYS, PERIOD = 1000, 0.025
BOXES = (
    Box(lower=np.array([0.15, -0.05, 0.0]), upper=np.array([0.2, 0.05, 0.15])),
    Box(lower=np.array([-0.1, 0.15, 0.0]), upper=np.array([0.05, 0.2, 0.3])),
    Box(lower=np.array([-0.25, -0.2, 0.0]), upper=np.array([-0.15, -0.1, 0.35])),
)


def main() -> None:
    """Print the tables."""
    for arm in (mycobot280(), so101()):
        begin = process_time()
        choose_postures(arm, arm.targets.sample(np.random.default_rng(0), (1,)) + 0.1, arm.rest)
        print(f"{arm.name}: first call {process_time() - begin:.2f} s (loops compiled or read, postures stored)")
        fresh = replace(arm)
        begin = process_time()
        choose_postures(fresh, np.array([[2.0, 0.0, 0.3]]), arm.rest)
        print(f"  postures of another arm stored: {process_time() - begin:.2f} s, with one refusal")
        _goals(arm)
        _ways(replace(arm, keep_out=BOXES))


def _goals(arm: Arm) -> None:
    q = _free(arm, 1000)
    f = frames(arm, q)
    limit = Motors(*[np.maximum(0.8 * np.abs(gravity_torque(arm, q)).max(axis=0), 0.05)] * 2)
    turns = {
        name: Orientation(
            rotation=f.tcp_rotation, whole=np.full(len(q), whole), weight=np.full(len(q), 0.05), axis=tool_axis(arm)
        )
        for name, whole in (("directions", False), ("poses", True))
    }
    kinds = [("places", None, None), ("places, torque limits", None, limit), *((k, t, None) for k, t in turns.items())]
    for name, turn, most in kinds:
        times, found = [], 0
        for k in range(len(q)):
            one = None if turn is None else turn[[k]]
            begin = process_time()
            goals = choose_postures(arm, f.tcp_position[[k]], arm.rest, turn=one, motors=most)
            times.append(process_time() - begin)
            found += not goals.refusals[0]
        mean, median, slow = 1e3 * np.mean(times), 1e3 * np.median(times), 1e3 * np.percentile(times, 95)
        print(f"  {name:22} {found:4d} of {len(q)} taken; mean {mean:.2f}, median {median:.2f}, 95 % {slow:.2f} ms")


def _ways(arm: Arm) -> None:
    q, rng, limits = _free(arm, 2000), np.random.default_rng(1), GuardLimits.of(arm)
    times: dict[str, list[float]] = {"straight": [], "detour": [], "none": []}
    longer, touched, changed = [], 0, 0
    for _ in range(WAYS):
        start, goal = q[rng.integers(len(q), size=2)]
        begin = process_time()
        try:
            way = plan(arm, start, goal)
        except PlanningError:
            times["none"].append(process_time() - begin)
            continue
        kind = "straight" if len(way.moves) == 1 else "detour"
        times[kind].append(process_time() - begin)
        if kind == "detour":
            longer.append(way.duration - (np.abs(goal - start) / arm.max_speed).max())
        commands = way.at(np.linspace(0.0, way.duration, 200))
        touched += bool((clearances(arm, commands, guarded_floors(arm)) < -1e-6).any())
        changed += _guarded(limits, way.at(np.arange(0.0, way.duration + PERIOD, PERIOD)))
    for kind, taken in times.items():
        if taken:
            print(f"  {kind:9} {len(taken):4d} ways; median {1e3 * np.median(taken):.2f}, "
                  f"95 % {1e3 * np.percentile(taken, 95):.2f} ms")  # fmt: skip
    print(f"  {touched} touch, {changed} are shortened by the guard; detours take {np.median(longer):.2f} s longer")


def _guarded(limits: GuardLimits, commands: Array) -> bool:
    """Tell whether the guard changes any of the commands (T, n) that follow one another."""
    sent, speed = commands[:1], 0.0 * commands[:1]
    for command in commands[1:, None]:
        state = JointState(time=np.zeros(1), position=sent, age=np.zeros(1))
        answer = guard(limits, command, sent, speed, state, PERIOD)
        if answer.reasons.any():
            return True
        sent, speed = answer.command, answer.speed
    return False


def _free(arm: Arm, count: int) -> Array:
    margin = np.radians(0.5)
    drawn = np.random.default_rng(5).uniform(arm.lower + margin, arm.upper - margin, (8 * count, arm.joints))
    found: Array = drawn[(clearances(arm, drawn, guarded_floors(arm)) > 0.002).all(axis=-1)][:count]
    return found
