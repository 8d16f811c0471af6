"""Training: a policy on randomised copies of a twin."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from rejoint.arms import Arm, load_arm
from rejoint.control.policy import Policy
from rejoint.runs.given import ArmLike, RunLike, TwinLike, as_arm, as_run, as_twin
from rejoint.runs.run import exclusive, mark_quick
from rejoint.runs.stages.known import tuned_gains, twin_under
from rejoint.system.errors import InputError
from rejoint.system.numbers import as_seed
from rejoint.system.progress import Progress, no_progress, paced

if TYPE_CHECKING:
    from rejoint.training.presets import Preset
    from rejoint.training.train import Trainer, TrainingResult
    from rejoint.twin.twin import Twin

QUICK_UPDATES, QUICK_AGENTS = 3, 16
"""Size of a training for a first try (chosen: seconds; its policy is hardly better than what it began with)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainedPolicy(Policy):
    """A policy that was just trained, and how its training went."""

    training: TrainingResult
    """targets reached, errors and time; its files exist if the policy was trained in a run"""


@paced
def train(
    twin: TwinLike | None = None,
    *,
    arm: ArmLike | None = None,
    run: RunLike | None = None,
    preset: str | Preset = "default",
    trainer: Trainer | None = None,
    seed: int | None = None,
    threads: int = 2,
    resume: bool = True,
    quick: bool = False,
    device: str = "cpu",
    on_progress: Progress = no_progress,
) -> TrainedPolicy:
    """Train a control policy on randomised copies of a twin (proximal policy optimisation).

    In a run, a training that was interrupted goes on from its last checkpoint, at most ten updates back, to the same
    end. Ctrl-C is a KeyboardInterrupt, as always.

    Parameters
    ----------
    twin
        twin or its file; without one the run's, and without that any worn arm of this kind is trained for
    arm
        arm, name or file; by default that of the run, or the one of the catalogue that the twin names
    run
        run, or its folder, into which ``policy.onnx`` and ``training/`` are written; either a run or a twin is given
    preset
        recipe: ``default``, ``scratch``, ``paper`` (the literal method), or one of your own. By the default one, a
        training on a twin begins at the policy that comes with the package, where there is one for this arm; by
        ``scratch`` it begins at random weights, as by all others
    trainer
        what trains instead of proximal policy optimisation
    seed
        of the networks, the arms that are drawn, and the exploration; by default that of the run, else 0
    threads
        of the simulation; the policy does not depend on it
    resume
        whether to go on from a checkpoint of this very training in the run
    quick
        train for seconds only, for a first try: the policy is hardly better than what it began with
    device
        what simulates the twins: ``cpu``, ``cuda`` or ``cuda:1``. Where there is no such GPU, a warning says so, and
        the processors do. A policy from a GPU differs in its last digits
    on_progress
        called with the share that is done and how the training stands

    Returns
    -------
    TrainedPolicy
        the policy, and as ``training`` how it went

    Raises
    ------
    InputError
        if both a run and a twin are given, or neither twin, run nor arm
    ContractError
        if the twin is of another arm

    Examples
    --------
    >>> policy = rejoint.train("twin.toml")
    >>> policy.save("policy.onnx")
    >>> rejoint.train(run="runs/mine")
    """
    if run is not None:
        if twin is not None:
            raise InputError("training: a run has its own twin; give either a run or a twin")
        found = as_run(run).seeded(seed)
        with exclusive(found):
            mark_quick(found, quick=quick)
            told, tuned, known = found.diagnosis, tuned_gains(found), found.twin
            gains = tuned.under if tuned is not None else None if told is None else told.servo_gains
            if tuned is not None and known is not None:
                known = twin_under(known, tuned.found, tuned.under)
            task = _Task(found.arm, known, preset, found.seed, threads, resume, quick, device, gains)
            return task.train(found.path, trainer, on_progress)
    known = None if twin is None else as_twin(twin)
    if known is None and arm is None:
        raise InputError("training: neither a twin, a run nor an arm is given")
    chosen = as_arm(arm) if arm is not None else load_arm(known.arm)  # type: ignore[union-attr]
    if known is not None:
        known.require(chosen)
    with tempfile.TemporaryDirectory(prefix="rejoint-training-") as folder:
        task = _Task(chosen, known, preset, as_seed(seed), threads, False, quick, device)
        return task.train(Path(folder), trainer, on_progress)


@dataclass(frozen=True)
class _Task:
    """What is to be trained."""

    arm: Arm
    twin: Twin | None
    preset: str | Preset
    seed: int
    threads: int
    resume: bool
    quick: bool
    device: str
    servo_gains: dict[str, tuple[int, ...]] | None = None
    """that will be in force: the best that a search found, else those of the diagnosis"""

    def train(self, folder: Path, trainer: Trainer | None, on_progress: Progress) -> TrainedPolicy:
        """Train by PPO or another trainer, and take up the policy that is then in the folder."""
        if trainer is None:
            from rejoint.training.train import TrainingOptions
            from rejoint.training.train import train as learn
            from rejoint.twin.chain.warpbatch import device_at_hand

            options = TrainingOptions(
                preset=self.preset, seed=self.seed, threads=self.threads, resume=self.resume,
                iterations=QUICK_UPDATES if self.quick else None, agents=QUICK_AGENTS if self.quick else None,
                servo_gains=self.servo_gains, device=device_at_hand(self.device),
            )  # fmt: skip
            result = learn(self.arm, self.twin, out=folder, options=options, on_progress=on_progress)
        else:
            result = trainer(self.arm, self.twin, folder, on_progress)
        policy = Policy.load(result.policy)
        return TrainedPolicy(**{f.name: getattr(policy, f.name) for f in fields(Policy)}, training=result)
