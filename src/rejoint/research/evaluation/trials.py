"""One controller on all arms of one variant, side by side as one batch of the plant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.comparison.counting import PROGRESS_CYCLES
from rejoint.control.comparison.metrics import settled
from rejoint.control.comparison.protocols import encoder_tcp, measure_crossings, measure_holds, schedule
from rejoint.control.comparison.result import Protocol
from rejoint.control.controller import Controller
from rejoint.control.loop import run
from rejoint.control.recording import Cycle, Recording
from rejoint.research.evaluation.family import ArmFamily, Variant, family_targets, open_family
from rejoint.research.evaluation.outcome import Outcome
from rejoint.robots.emulated import EmulatedRobot

OnTargets = Callable[[int], object]
"""Called now and then with the number of targets that are done."""

FULL_TORQUE = 0.97
"""Share of its limit from which a motor gives all it can (chosen: the limit falls with the speed)"""


@dataclass(frozen=True, kw_only=True)
class TrialSettings:
    """How arms are tried."""

    family: ArmFamily
    protocol: Protocol
    crossing: bool = True
    """whether the protocol of Park et al. 2024 is run as well"""
    threads: int = 1


@dataclass(frozen=True, kw_only=True, eq=False)
class TrialArms:
    """Arms and their targets."""

    open: Callable[[], EmulatedRobot]
    """puts all arms at rest, as a new batch"""
    targets: Array
    """(A, max(K, C), 3) [m]"""
    wear_seed: Array
    """(A,)"""


def try_controller(
    arm: Arm, variant: Variant, controller: Callable[[Arm], Controller], settings: TrialSettings, on_targets: OnTargets
) -> Outcome:
    """Try a controller on all arms of a variant."""
    family = settings.family
    bench = TrialArms(
        open=lambda: open_family(arm, variant, family, settings.threads),
        targets=family_targets(arm, family, max(family.targets, family.crossings)),
        wear_seed=np.array([family.wear_seed(i) for i in range(family.arms)], dtype=float),
    )
    return try_on(arm, bench, controller, settings, on_targets)


def try_on(
    arm: Arm, bench: TrialArms, controller: Callable[[Arm], Controller], settings: TrialSettings, on_targets: OnTargets
) -> Outcome:
    """Hold every arm at its targets, then send it through the crossing protocol; the guard's trips end single arms."""
    family, targets, robot = settings.family, bench.targets, bench.open()
    watch = _Watch(robot, on_targets)
    held = targets[:, : family.targets]
    plan = schedule("hold", settings.protocol, keep_going=True)
    recording = run(robot, controller(arm), held, plan, on_cycle=watch)
    holds = measure_holds(arm, recording, held, settings.protocol)
    last = _last_seconds(arm, recording, np.array(watch.torque), held, settings.protocol)
    crossed = _unknown((len(targets), family.crossings))
    results = {"error": crossed.copy(), "true_error": crossed.copy(), "time": crossed.copy()}
    if settings.crossing:
        robot = bench.open()
        points = targets[:, : family.crossings]
        plan = schedule("crossing", settings.protocol, keep_going=True)
        found = measure_crossings(
            arm,
            run(robot, controller(arm), points, plan, on_cycle=_Watch(robot, on_targets)),
            points,
            settings.protocol,
        )
        crossed = found.crossed
        results = {name: getattr(found, name) for name in results}
    return Outcome(
        wear_seed=bench.wear_seed, target=held, settled=holds.settled, settled_true=holds.settled_true,
        oscillation=holds.oscillation, stay=np.moveaxis(holds.stay, 0, -1), tripped=recording.tripped.astype(float),
        **last, crossed=crossed, crossing_error=results["error"], crossing_true=results["true_error"],
        crossing_time=results["time"],
    )  # fmt: skip


class _Watch:
    """Notes how hard the motors work, and reports progress."""

    def __init__(self, robot: EmulatedRobot, on_targets: OnTargets) -> None:
        self._robot, self._on_targets, self._limit = robot, on_targets, robot.plant.torque_limit
        self.torque: list[Array] = []

    def __call__(self, cycle: Cycle) -> None:
        self.torque.append(np.abs(self._robot.plant.torque) / self._limit)
        if len(self.torque) % PROGRESS_CYCLES == 0:
            self._on_targets(int(cycle.target_index.sum()))


def _last_seconds(
    arm: Arm, recording: Recording, torque: Array, targets: Array, protocol: Protocol
) -> dict[str, Array]:
    """Measure what the joints did in the last part of every hold; ``torque`` (T, B, n) as a share of the limits."""
    count, length, n = targets.shape[0], targets.shape[1], arm.joints
    found = {name: _unknown((count, length, n)) for name in ("lead", "swing", "saturation")}
    found |= {name: _unknown((count, length)) for name in ("approach", "limited")}
    error = np.linalg.norm(encoder_tcp(arm, recording) - recording.aim, axis=-1)
    for b in range(count):
        for k in range(length):
            rows = np.flatnonzero(recording.active[:, b] & (recording.target_index[:, b] == k))
            since = recording.since_target[rows, b]
            if len(rows) == 0 or since[-1] < protocol.hold:
                continue
            rows = rows[since >= since[-1] - protocol.window]
            position = recording.position[rows, b]
            found["lead"][b, k] = (recording.command[rows, b] - position).mean(axis=0)
            found["swing"][b, k] = np.ptp(position, axis=0)
            found["saturation"][b, k] = (torque[rows, b] > FULL_TORQUE).mean(axis=0)
            found["limited"][b, k] = np.bitwise_or.reduce(recording.reasons[rows, b])
            half, time = len(rows) // 2, recording.since_target[rows, b]
            found["approach"][b, k] = 2 * (
                settled(time[:half], error[rows[:half], b], protocol.window)
                - settled(time[half:], error[rows[half:], b], protocol.window)
            )
    return found


def _unknown(shape: tuple[int, ...]) -> Array:
    return np.full(shape, np.nan)
