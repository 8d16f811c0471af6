"""Trainings of the experiments.

``worn-0`` is Table 3's training on the paper's P and D, ``healthy-0`` on a normal arm's; the number adds to the seed.
``limit-5`` takes the printed largest action, ``noise-5`` also the joint noise, ``literal`` also the last action.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace

import numpy as np

from rejoint.system.errors import RejointError
from rejoint.system.progress import no_progress
from rejoint.training.presets import PAPER, Preset
from rejoint.training.train import TrainingOptions, train
from rejoint_lab.research.reproduction.bench import Bench

SEEDS = 3
"""Trainings of each kind; chosen"""
WORN = tuple(f"worn-{i}" for i in range(SEEDS))
HEALTHY = tuple(f"healthy-{i}" for i in range(SEEDS))
LITERALLY = ("limit-5", "noise-5", "literal")

LITERAL = float(np.radians(5.0))
"""[rad] sigma of equation 19, and joint change per frame; Park et al. 2024, section IV-D"""


def recipe(name: str) -> tuple[Preset, int]:
    """Preset and seed increment of a training."""
    kind, _, number = name.rpartition("-")
    if kind == "worn":
        return PAPER, int(number)
    if kind == "healthy":
        return replace(PAPER, name="paper-healthy", ranges="paper-healthy"), int(number)
    law = replace(PAPER.task.law, authority_floor=LITERAL, authority_limit=LITERAL)
    layout = "equation-16-action" if name == "literal" else PAPER.task.layout
    noise = PAPER.joint_noise if name == "limit-5" else LITERAL
    task = replace(PAPER.task, law=law, layout=layout)
    return replace(PAPER, name=f"paper-{name}", task=task, joint_noise=noise), 0


def finish_trainings(bench: Bench, names: Sequence[str]) -> None:
    """Run unfinished trainings in ``bench.threads`` processes."""
    missing = [name for name in names if not bench.training(name).policy.exists()]
    if not missing:
        return
    quiet, count = replace(bench, on_progress=no_progress), len(missing)  # a callback cannot go to another process
    context = multiprocessing.get_context("spawn")  # a fork would copy the state of torch and MuJoCo
    with ProcessPoolExecutor(min(bench.threads, count), mp_context=context, initializer=_begin_worker) as pool:
        waiting = [pool.submit(_train, quiet, name) for name in missing]
        try:
            for number, future in enumerate(as_completed(waiting), start=1):
                if problem := future.result():
                    raise RejointError(problem)
                bench.on_progress(number / count, f"{number} of {count} trainings")
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in multiprocessing.active_children():  # their checkpoints are at most a few updates old
                worker.terminate()
            raise


def _begin_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that started this one


def _train(bench: Bench, name: str) -> str:
    """Train, and return the problem; errors with fields cannot go to another process."""
    preset, offset = recipe(name)
    options = TrainingOptions(
        preset=preset,
        seed=bench.seed + offset,
        agents=bench.scale.agents,
        threads=1,
        iterations=bench.scale.updates,
        snapshot_every=bench.scale.snapshot_every,
        resume=True,
    )
    try:
        train(bench.arm, None, out=bench.training(name).path, options=options)
    except RejointError as error:
        return str(error)
    return ""
