"""Train a policy for an arm: ``policy.onnx`` and its curves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from torch import Tensor

from rejoint.arms import Arm
from rejoint.arms.inertia import bare
from rejoint.arms.workspace import length_size
from rejoint.control.controllers.observation import layout_slots
from rejoint.control.controllers.policy import PolicyContract, law_digests
from rejoint.logs.runfolder import RunFolder
from rejoint.logs.runlog import write_parquet
from rejoint.system.progress import Progress, no_progress
from rejoint.system.shell import __version__
from rejoint.training.export import export_policy, shelf_start
from rejoint.training.learner import CurvePoint, Learner
from rejoint.training.presets import Preset, load_preset
from rejoint.training.ranges import BroadRanges, Ranges, identified_ranges
from rejoint.twin.parameters import nominal_parameters
from rejoint.twin.twin import Twin

WORKERS = 2
"""Rollout workers; independent of the number of threads"""

DECAY_START = 0.7
"""[s] of the law where motors cross backlash slowly; chosen: such a joint swings once"""


@dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """Options of a training beside the recipe."""

    preset: str | Preset = "default"
    seed: int = 0
    agents: int | None = None
    """default: the preset's"""
    threads: int = 2
    """of the simulation; no effect on the policy"""
    iterations: int | None = None
    """updates; default: the preset's"""
    snapshot_every: int | None = None
    """updates between kept policies, the untrained one first; None: none"""
    servo_gains: dict[str, tuple[int, ...]] | None = None
    """of the identified servos, for the contract"""
    ranges: Ranges | None = None
    """arms to train on; default: by the twin, else broad ones"""
    start: Tensor | None = None
    """weights of the actor; default: those of the generic policy with a twin, else random"""

    @property
    def recipe(self) -> Preset:
        """The preset with these numbers of agents and iterations."""
        preset = self.preset if isinstance(self.preset, Preset) else load_preset(self.preset)
        sizes = {"agents": self.agents, "iterations": self.iterations}
        given: dict[str, Any] = {name: size for name, size in sizes.items() if size is not None}
        warm = preset.warm and replace(preset.warm, **given)
        return replace(preset, ppo=replace(preset.ppo, **given), warm=warm)


@dataclass(frozen=True, kw_only=True)
class TrainingResult:
    """Result of a training."""

    policy: Path
    curves: Path
    """Parquet, one row per update, the fields of `CurvePoint`"""
    preset: str
    seed: int
    steps: int
    """transitions"""
    success_rate: float
    """at the end, with exploration noise"""
    error_mm: float
    """the same: median at the end of a target"""
    reward: float
    wall_s: float


Trainer = Callable[[Arm, Twin | None, Path, Progress], TrainingResult]
"""Trains a policy and writes what `rejoint.logs.runfolder.RunFolder` names for it into a folder"""


def train(
    arm: Arm,
    twin: Twin | None,
    *,
    out: Path,
    options: TrainingOptions | None = None,
    on_progress: Progress = no_progress,
) -> TrainingResult:
    """Train a policy and write ``policy.onnx`` and the folder ``training`` into ``out``.

    Without a ``twin`` it uses the broad ranges alone.
    """
    options = TrainingOptions() if options is None else options
    recipe, files = know_stiffness(options.recipe, arm, twin), RunFolder(out)
    start = options.start if options.start is not None or twin is None else shelf_start(arm, recipe)
    if start is not None and recipe.warm is not None:
        recipe = replace(recipe, ppo=recipe.warm)
    learner = make_learner(arm, twin, recipe, options, start)
    total = recipe.ppo.iterations
    contract = replace(policy_contract(arm, twin, recipe, options.seed), servo_gains=options.servo_gains)
    while learner.iteration < total:
        if options.snapshot_every and learner.iteration % options.snapshot_every == 0:
            export_policy(files.snapshot(learner.iteration), learner.actor.net, contract)
        point = learner.iterate()
        on_progress(learner.iteration / total, describe(point))
    write_curves(files.curves, learner.curve)
    export_policy(files.policy, learner.actor.net, contract)
    return training_result(files, recipe.name, options.seed, learner.curve)


def training_ranges(arm: Arm, twin: Twin | None) -> Ranges:
    """Arms to train on: around a twin, else broad ones."""
    return BroadRanges(arm=arm) if twin is None else identified_ranges(arm, twin)


def write_curves(path: Path, curve: Sequence[CurvePoint]) -> None:
    """Write training curves as Parquet."""
    table = pa.Table.from_pylist([asdict(point) for point in curve])
    write_parquet(path, table)


def make_learner(
    arm: Arm, twin: Twin | None, recipe: Preset, options: TrainingOptions, start: Tensor | None = None
) -> Learner:
    """Set up the learner."""
    ranges, workers = options.ranges or training_ranges(arm, twin), min(WORKERS, recipe.ppo.agents)
    seed, threads = workers * options.seed, max(options.threads // workers, 1)
    tasks = [
        recipe.make(arm, ranges, len(part), recipe.task, seed=seed + k, threads=threads)
        for k, part in enumerate(np.array_split(np.arange(recipe.ppo.agents), workers))
    ]
    return Learner(tasks, recipe.ppo, seed=options.seed, threads=min(options.threads, workers), start=start)


def know_stiffness(recipe: Preset, arm: Arm, twin: Twin | None) -> Preset:
    """Set the servos' stiffness in a law with gravity compensation: the twin's, else the prior's.

    With possible backlash, the gains of unloaded joints also decay. All gains decrease with the length beyond a myCobot
    280's, and targets last longer.
    """
    law = recipe.task.law
    if law.anchor != "goal" or law.stiffness:
        return recipe
    stiffness = nominal_parameters(arm).stiffness if twin is None else twin.parameters.stiffness
    size = max(length_size(bare(arm)), 1.0)
    law = replace(
        law,
        stiffness=tuple(np.round(stiffness, 6).tolist()),
        learning=replace(law.learning, rate=law.learning.rate / size),
        authority_floor=law.authority_floor / size,
        authority_slope=law.authority_slope / size,
        authority_limit=law.authority_limit / size,
    )
    if twin is not None and BroadRanges(arm=arm).reaching(twin).backlash[1] > 0.0:
        law = replace(law, decay_start=DECAY_START)
    return replace(recipe, task=replace(recipe.task, law=law, hold_steps=round(recipe.task.hold_steps * size**0.5)))


def policy_contract(arm: Arm, twin: Twin | None, recipe: Preset, seed: int, name: str | None = None) -> PolicyContract:
    """Make the contract of a policy; ``name`` of the recipe if not the preset's."""
    return PolicyContract(
        arm=arm.name,
        arm_digests=law_digests(arm),
        joint_names=arm.joint_names,
        lower=tuple(arm.lower.tolist()),
        upper=tuple(arm.upper.tolist()),
        layout=recipe.task.layout,
        observation=layout_slots(recipe.task.layout, arm.joints),
        law=recipe.task.law,
        min_period=recipe.task.min_period,
        max_period=recipe.task.max_period,
        probe=(),
        twin_digest="" if twin is None else twin.digest(),
        preset=name or recipe.name,
        seed=seed,
        software=__version__,
    )


def describe(point: CurvePoint) -> str:
    """Describe the state of a training."""
    return f"success {100 * point.success_rate:.0f} %, error {point.error_mm:.2f} mm, reward {point.reward:.2f}"


def training_result(files: RunFolder, recipe: str, seed: int, curve: Sequence[CurvePoint]) -> TrainingResult:
    """Sum up a training by its last updates."""
    recent = curve[-5:]  # chosen: the targets that end within a few updates are enough for a percent
    names = ("success_rate", "error_mm", "reward")
    means = {name: float(np.mean([getattr(point, name) for point in recent])) for name in names}
    last = curve[-1]
    return TrainingResult(
        policy=files.policy, curves=files.curves, preset=recipe, seed=seed, steps=last.step, wall_s=last.wall_s, **means
    )
