"""One controller on all arms of one variant, as one batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.comparison.compare import PROGRESS_CYCLES
from rejoint.control.comparison.protocols import measure_crossings, measure_holds, schedule
from rejoint.control.comparison.result import Protocol
from rejoint.control.controller import Controller
from rejoint.control.goal import Ways
from rejoint.control.loop import run
from rejoint.control.recording import Cycle
from rejoint.control.reference import TargetSequence
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.research.evaluation.family import ArmFamily, Variant, family_targets, open_family, targets_anywhere
from rejoint.research.evaluation.outcome import Outcome
from rejoint.robots.emulated import EmulatedRobot
from rejoint.robots.lab.plant.wear import load_wear
from rejoint.system.progress import Progress, no_progress, part
from rejoint.twin.file import read_twin, write_twin
from rejoint.twin.twin import Twin


def own_twin(arm: Arm, wear_seed: int, folder: RunFolder, seed: int, on_progress: Progress = no_progress) -> Twin:
    """Return the twin in ``folder``; if missing, diagnose and identify ``worn?seed=WEAR_SEED`` first.

    ``seed`` is that of its motions.
    """
    from rejoint.diagnosis.diagnosis import diagnose
    from rejoint.twin.identify import identify

    if not folder.twin.exists():
        robot = EmulatedRobot(arm, [load_wear(f"worn?seed={wear_seed}", arm)], seed=wear_seed)
        _, logs = diagnose(robot, None, seed=seed, on_progress=part(on_progress, 0.0, 0.5))
        write_twin(folder.twin, identify(arm, [logs.excitation], on_progress=part(on_progress, 0.5, 1.0)))
    return read_twin(folder.twin, arm)


OnTargets = Callable[[int], object]
"""Called now and then with the number of targets that are done."""


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
    ways: Ways | None = None
    """of the first K targets; None for the nearest postures"""
    wear_seed: Array
    """(A,)"""


def try_controller(
    arm: Arm,
    variant: Variant,
    controller: Callable[[Arm], Controller],
    settings: TrialSettings,
    on_targets: OnTargets,
    twins: Sequence[Twin] = (),
) -> Outcome:
    """Try a controller on all arms of a variant; ``twins`` choose postures of targets anywhere."""
    family, ways = settings.family, None
    targets = family_targets(arm, family, max(family.targets, family.crossings))
    if variant.anywhere:
        targets[:, : family.targets], ways = targets_anywhere(arm, family, twins)
    bench = TrialArms(
        open=lambda: open_family(arm, variant, family, settings.threads),
        targets=targets,
        ways=ways,
        wear_seed=np.array([family.wear_seed(i) for i in range(family.arms)], dtype=float),
    )
    return try_on(arm, bench, controller, settings, on_targets)


def try_on(
    arm: Arm, bench: TrialArms, controller: Callable[[Arm], Controller], settings: TrialSettings, on_targets: OnTargets
) -> Outcome:
    """Hold every arm at its targets, then run the crossing protocol."""
    family, targets, robot = settings.family, bench.targets, bench.open()
    cycles = 0

    def watch(cycle: Cycle) -> None:
        nonlocal cycles
        cycles += 1
        if cycles % PROGRESS_CYCLES == 0:
            on_targets(int(cycle.target_index.sum()))

    held = targets[:, : family.targets]
    plan = schedule("hold", settings.protocol, keep_going=True)
    recording = run(robot, controller(arm), TargetSequence(arm, held, ways=bench.ways), plan, on_cycle=watch)
    holds = measure_holds(arm, recording, held, settings.protocol)
    names = ("crossed", "crossing_error", "crossing_true", "crossing_time")
    crossings = {name: _unknown((len(targets), family.crossings)) for name in names}
    if settings.crossing:
        robot = bench.open()
        points = targets[:, : family.crossings]
        plan = schedule("crossing", settings.protocol, keep_going=True)
        crossings = measure_crossings(
            arm,
            run(robot, controller(arm), points, plan, on_cycle=watch),
            points,
            settings.protocol,
        )
    stay = np.stack([holds[name] for name in settings.protocol.stay_names], axis=-1)
    return Outcome(
        wear_seed=bench.wear_seed,
        target=held,
        settled=holds["settled"],
        settled_true=holds["settled_true"],
        oscillation=holds["oscillation"],
        stay=np.where(stay >= settings.protocol.hold, np.inf, stay),
        tripped=recording.tripped.astype(float),
        **crossings,
    )


def _unknown(shape: tuple[int, ...]) -> Array:
    return np.full(shape, np.nan)
