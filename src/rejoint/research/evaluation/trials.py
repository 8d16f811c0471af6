"""One controller on many arms side by side, and what is kept of it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from rejoint.arms import Arm, Array
from rejoint.control.comparison.compare import PROGRESS_CYCLES
from rejoint.control.comparison.protocols import KINDS, Columns, measure, schedule
from rejoint.control.comparison.result import METRICS, Protocol
from rejoint.control.controller import Controller
from rejoint.control.goal import Ways
from rejoint.control.loop import run
from rejoint.control.recording import Cycle
from rejoint.control.reference import TargetSequence
from rejoint.control.robot import Robot
from rejoint.logs.runfolder import RunFolder
from rejoint.logs.runlog import read_parquet
from rejoint.research.evaluation.family import ArmFamily, Variant, family_targets, open_family, targets_anywhere
from rejoint.robots.emulated import EmulatedRobot
from rejoint.robots.lab.plant.wear import load_wear
from rejoint.system.errors import FileError
from rejoint.system.files import write_whole
from rejoint.system.progress import Progress, no_progress, part
from rejoint.system.shell import __version__
from rejoint.twin.file import read_twin, write_twin
from rejoint.twin.twin import Twin

OnTargets = Callable[[int], object]
"""Called now and then with the number of targets that are done."""
_IDENTITY = b"rejoint.research.evaluation"


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


@dataclass(frozen=True, kw_only=True)
class TrialSettings:
    """How arms are tried."""

    family: ArmFamily
    protocol: Protocol
    threads: int = 1


@dataclass(frozen=True, kw_only=True, eq=False)
class TrialArms:
    """Arms and their targets."""

    open: Callable[[], Robot]
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
) -> Columns:
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
) -> Columns:
    """Hold every arm at its targets, then run the crossing protocol; returns results (A, max(K, C)).

    Beside `METRICS`: seed of the ``arm``, number and place (``x``, ``y``, ``z``) of the ``target``, and the flags with
    which the guard ``tripped``.
    """
    family, protocol, cycles = settings.family, settings.protocol, 0
    shape = bench.targets.shape[:2]

    def watch(cycle: Cycle) -> None:
        nonlocal cycles
        cycles += 1
        if cycles % PROGRESS_CYCLES == 0:
            on_targets(int(cycle.target_index.sum()))

    found: Columns = {name: np.full(shape, np.nan) for name in (*METRICS, *protocol.stay_names, "tripped")}
    found |= dict(zip("xyz", np.moveaxis(bench.targets, -1, 0), strict=True))
    found["arm"] = np.broadcast_to(bench.wear_seed[:, None], shape)
    found["target"] = np.broadcast_to(np.arange(shape[1], dtype=float), shape)
    for kind in reversed(KINDS):
        count = family.targets if kind == "hold" else family.crossings
        if not count:
            continue
        points, ways = bench.targets[:, :count], bench.ways if kind == "hold" else None
        plan, sequence = schedule(kind, protocol, keep_going=True), TargetSequence(arm, points, ways=ways)
        recording = run(bench.open(), controller(arm), sequence, plan, on_cycle=watch)
        places = tuple((b, 0) for b in range(len(points)))
        for name, values in measure(arm, recording, points, protocol, ("", kind, places, 0)).columns.items():
            found[name][:, :count] = values
        if kind == "hold":
            found["tripped"][:, :count] = recording.tripped[:, None]
    return found


def keep(path: Path, identity: Mapping[str, Any], find: Callable[[], Columns]) -> Columns:
    """Return the results of this ``identity`` in ``path``, a tidy table; else ``find`` and write them."""
    wanted = json.dumps(dict(identity) | {"software": __version__})
    try:
        table = read_parquet(path, "delete it")
        found_identity, *shape = json.loads((table.schema.metadata or {})[_IDENTITY])
        if found_identity == wanted:
            return {name: table[name].to_numpy().reshape(shape) for name in table.column_names}
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError, RecursionError, FileError):
        pass  # damaged or missing
    found = find()
    shape = next(iter(found.values())).shape
    table = pa.table({name: values.ravel() for name, values in found.items()})
    table = table.replace_schema_metadata({_IDENTITY: json.dumps([wanted, *shape]).encode()})
    write_whole(path, lambda temporary: pq.write_table(table, temporary, compression="zstd", write_page_checksum=True))
    return found
