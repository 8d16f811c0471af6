"""Training: a policy on randomised copies of a twin."""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rejoint.arms import load_arm
from rejoint.control.controllers.policy import Policy
from rejoint.control.recording import Observer, pacing
from rejoint.runs.run import exclusive, mark_quick
from rejoint.session.context import tuned_gains, twin_under
from rejoint.session.inputs import ArmLike, RunLike, TwinLike, as_arm, as_run, as_twin
from rejoint.system.errors import InputError
from rejoint.system.numbers import as_seed

if TYPE_CHECKING:
    from rejoint.training.task import Preset
    from rejoint.training.train import Trainer, TrainingResult

QUICK: dict[str, Any] = {"iterations": 3, "agents": 16}
"""Size of a quick training; chosen"""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class TrainedPolicy(Policy):
    """A trained policy and its training."""

    training: TrainingResult
    """its files exist only in a run"""


@dataclass(frozen=True, kw_only=True)
class TrainSettings:
    """Options of a training."""

    generic: bool = False
    """without the run's twin, for any worn arm"""
    seed: int | None = None
    """of all random numbers; default: that of the run, else 0"""
    threads: int = 2
    """of the simulation; no effect on the policy"""
    trainer: Trainer | None = None
    """replaces proximal policy optimisation"""


def train(
    twin: TwinLike | None = None,
    *,
    arm: ArmLike | None = None,
    run: RunLike | None = None,
    preset: str | Preset = "default",
    quick: bool = False,
    settings: TrainSettings | None = None,
    observer: Observer | None = None,
) -> TrainedPolicy:
    """Train a control policy on randomised copies of a twin (proximal policy optimisation).

    The same seed gives the same policy.

    Parameters
    ----------
    twin
        twin or its file; default: the run's; without either: any worn arm of this kind
    arm
        arm, name or file; default: that of run or twin
    run
        run, or its folder, for ``policy.onnx``; or a twin
    preset
        ``default`` (on a twin: from the arm's generic policy), ``scratch``, or your own
    quick
        train for seconds; no result
    settings
        seed, threads
    observer
        receives progress

    Returns
    -------
    TrainedPolicy
        the policy and its ``training``

    Raises
    ------
    InputError
        for run and twin, none of twin, run and arm, or a run without a twin
    ContractError
        if the twin is of another arm

    Examples
    --------
    >>> policy = rejoint.train("twin.toml")
    >>> policy.save("policy.onnx")
    >>> rejoint.train(run="runs/mine")
    """
    how, gains = settings or TrainSettings(), None
    with pacing(observer) as update, ExitStack() as stack:
        if run is not None:
            if twin is not None:
                raise InputError("training: a run has its own twin; give either a run or a twin")
            found = as_run(run).seeded(how.seed)
            stack.enter_context(exclusive(found))
            told, tuned, known = found.diagnosis, tuned_gains(found), found.twin
            if known is None and not how.generic:
                raise InputError(
                    f"{found.path} has no twin.toml; run `rejoint identify {found.path}` first, or ask for a "
                    "policy for any worn arm of this kind with --generic"
                )
            mark_quick(found, quick=quick)
            gains = tuned.under if tuned is not None else None if told is None else told.servo_gains
            if tuned is not None and known is not None:
                known = twin_under(known, tuned.found, tuned.under)
            chosen, folder, seed = found.arm, found.path, found.seed
        else:
            known = None if twin is None else as_twin(twin)
            if known is None and arm is None:
                raise InputError("training: neither a twin, a run nor an arm is given")
            chosen = as_arm(arm) if arm is not None else load_arm(known.arm)  # type: ignore[union-attr]
            if known is not None:
                known.require(chosen)
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rejoint-training-")))
            seed = as_seed(how.seed)
        if how.trainer is None:
            from rejoint.training.train import TrainingOptions
            from rejoint.training.train import train as learn

            about: dict[str, Any] = {"seed": seed, "servo_gains": gains} | (QUICK if quick else {})
            options = TrainingOptions(preset=preset, threads=how.threads, **about)
            result = learn(chosen, known, out=folder, options=options, on_progress=update)
        else:
            result = how.trainer(chosen, known, folder, update)
        return TrainedPolicy(**vars(Policy.load(result.policy)), training=result)
