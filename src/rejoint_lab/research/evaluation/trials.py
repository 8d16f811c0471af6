"""One controller on many arms side by side, and what is kept of it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from rejoint.arms import Arm, Array, Displacement
from rejoint.arms.rotations import Orientation
from rejoint.control.comparison.protocols import metrics_of, schedule
from rejoint.control.comparison.result import METRICS, MODELLED, Columns, Kind
from rejoint.control.correction import Modelled
from rejoint.control.goal import Ways
from rejoint.control.loop import run
from rejoint.control.reference import TargetSequence
from rejoint.control.robot import ControlInput, Controller, Mask, Robot
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.logs.runfolder import RunFolder
from rejoint.logs.runlog import read_parquet
from rejoint.system.errors import FileError
from rejoint.system.files import write_whole
from rejoint.system.progress import Progress, no_progress, part
from rejoint.system.shell import __version__
from rejoint.twin.twin import Twin, read_twin, write_twin
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear
from rejoint_lab.research.evaluation.family import ArmFamily, Variant, family_targets, open_family, targets_anywhere

_IDENTITY = b"rejoint.research.evaluation"


def own_twin(arm: Arm, wear_seed: int, folder: RunFolder, seed: int, on_progress: Progress = no_progress) -> Twin:
    """Return the twin in ``folder``; if missing, diagnose and identify ``worn?seed=WEAR_SEED`` first.

    ``seed`` is that of its motions.
    """
    from rejoint.diagnosis.excitation import record
    from rejoint.twin.identify import identify

    if not folder.twin.exists():
        robot = EmulatedRobot(arm, [load_wear(f"worn?seed={wear_seed}", arm)], seed=wear_seed)
        logs = record(robot, seed=seed, on_progress=part(on_progress, 0.0, 0.5))[0]
        write_twin(folder.twin, identify(arm, [logs.excitation, logs.targets], on_progress=part(on_progress, 0.5, 1.0)))
    return read_twin(folder.twin, arm)


def own_twins(
    arm: Arm, seeds: Sequence[int], folder: Path, seed: int, on_progress: Progress = no_progress
) -> list[Twin]:
    """Return a twin of each worn arm, fitted to an excitation of its own, kept in ``folder``."""
    ends = np.linspace(0.0, 1.0, len(seeds) + 1)
    return [  # one plan of excitation, of ``seed``: a few are not safe and are refused
        own_twin(arm, one, RunFolder(folder / "arms" / str(one)), seed, part(on_progress, *ends[i : i + 2]))
        for i, one in enumerate(seeds)
    ]


@dataclass(frozen=True, kw_only=True, eq=False)
class TrialArms:
    """Arms and their targets."""

    open: Callable[[], Robot]
    """puts all arms at rest, as a new batch"""
    targets: Array
    """(A, max(K, C), 3) [m]"""
    ways: Ways | None = None
    """of the first K targets; None for the nearest postures"""
    wear_seeds: Sequence[int]
    """(A,)"""
    calibrations: Sequence[Calibration] = ()
    """of each arm, where they are used: they correct the targets and model the true errors"""


OnTargets = Callable[[int], object]
"""Receives the number of targets that are done, now and then"""


def nothing(done: int) -> None:
    """Ignore the number of targets that are done."""


def try_controller(
    arm: Arm,
    variant: Variant,
    controller: Callable[[Arm], Controller],
    family: ArmFamily,
    on_targets: OnTargets = nothing,
    twins: Sequence[Twin] = (),
) -> Columns:
    """Try a controller on all arms of a variant; ``twins`` choose postures of targets anywhere."""
    targets, ways = family_targets(arm, family, max(family.targets, family.crossings)), None
    if variant.anywhere:
        targets[:, : family.targets], ways = targets_anywhere(arm, family, twins)
    opened = partial(open_family, arm, variant, family)
    arms = TrialArms(open=opened, targets=targets, ways=ways, wear_seeds=family.wear_seeds)
    return try_on(arm, arms, controller, family, on_targets)


def try_on(
    arm: Arm,
    arms: TrialArms,
    controller: Callable[[Arm], Controller],
    family: ArmFamily,
    on_targets: OnTargets = nothing,
) -> Columns:
    """Hold every arm at its targets, then run the crossing protocol; returns results (A, max(K, C)).

    Beside `METRICS`: seed of the ``arm``, number and place (``x``, ``y``, ``z``) of the ``target``, and the flags with
    which the guard ``tripped``; with calibrations, whether they are ``used``.
    """
    protocol, shape = family.protocol, arms.targets.shape[:2]
    found: Columns = {name: np.full(shape, np.nan) for name in (*METRICS, *protocol.stay_names, "tripped")}
    found |= dict(zip("xyz", np.moveaxis(arms.targets, -1, 0), strict=True))
    found["arm"] = np.repeat(np.array(arms.wear_seeds, dtype=float)[:, None], shape[1], axis=1)
    found["target"] = np.broadcast_to(np.arange(shape[1], dtype=float), shape)
    correction = OwnCorrections(arms.calibrations) if arms.calibrations else None
    if arms.calibrations:
        found["used"] = np.repeat([[float(one.used)] for one in arms.calibrations], shape[1], axis=1)
    counts: dict[Kind, int] = {"hold": family.targets, "crossing": family.crossings}
    for kind, count in counts.items():
        if not count:
            continue
        points, ways = arms.targets[:, :count], arms.ways if kind == "hold" else None
        sequence = TargetSequence(arm, points, ways=ways, correction=correction)
        plan = schedule(kind, protocol, keep_going=True)
        recording = run(
            arms.open(), controller(arm), sequence, plan, on_cycle=lambda c: on_targets(c.target_index.sum())
        )
        if kind == "hold":
            found["tripped"][:, :count] = recording.tripped[:, None]
        columns = metrics_of(arm, recording, points, protocol, (kind,))
        if arms.calibrations and kind == "hold":
            blind = replace(recording, true_tcp=np.full_like(recording.true_tcp, np.nan))
            said = metrics_of(arm, blind, points, protocol, (kind,), arms.calibrations)
            columns |= {name: said[name] for name in MODELLED}
        for name, values in columns.items():
            found[name][:, :count] = values
    return found


class OwnCorrections(Modelled):
    """Corrects the targets of each arm by its own calibration."""

    def __init__(self, found: Sequence[Calibration]) -> None:
        self._each = [Modelled(one.arm, one.displacement if one.used else Displacement.none(one.arm)) for one in found]

    def aim(
        self, target: Array, start: Array, where: Mask, near: Array | None = None, turn: Orientation | None = None
    ) -> tuple[Array, Orientation | None]:
        """Corrected targets (B, 3) [m]; points have no orientation."""
        rows = (target, start, where) if near is None else (target, start, where, near)
        each = zip(self._each, *(row[:, None] for row in rows), strict=True)
        return np.concatenate([one.aim(*own)[0] for one, *own in each]), turn

    def again(self, target: Array, inputs: ControlInput) -> Array | None:
        """Correct settled arms once more."""
        fresh, state = inputs.target.copy(), inputs.state
        for i, one in enumerate(self._each):
            own = replace(state, time=state.time[i : i + 1], position=state.position[i : i + 1])
            found = one.again(target[i : i + 1], replace(inputs, state=own, target=inputs.target[i : i + 1]))
            fresh[i] = fresh[i] if found is None else found[0]
        return None if (fresh == inputs.target).all() else fresh


def keep(path: Path, identity: str, find: Callable[[], Columns]) -> Columns:
    """Return the results of this ``identity`` in ``path``, a tidy table; else ``find`` and write them."""
    wanted = f"rejoint {__version__}: {identity}"
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
