"""The trainings that the experiments share: by name, side by side, each resumable.

``worn-0`` is Table 3's training on the paper's P and D of a worn arm; ``healthy-0`` the same without them, on
the one pair of a normal arm; the number is added to the seed. The others go back to what the paper prints, step by
step: ``limit-5`` takes its largest action, ``noise-5`` its joint noise as well, ``literal`` its change of joint
angles for the last action.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import replace
from functools import lru_cache, partial
from multiprocessing.queues import Queue
from queue import Empty

import numpy as np

from rejoint.research.reproduction.experiment import SEEDS, Bench
from rejoint.system.elsewhere import Elsewhere
from rejoint.system.errors import RejointError
from rejoint.system.progress import Progress, no_progress
from rejoint.training.presets import PAPER, Preset
from rejoint.training.train import TrainingOptions, train

WORN = tuple(f"worn-{i}" for i in range(SEEDS))
HEALTHY = tuple(f"healthy-{i}" for i in range(SEEDS))
LIMITED, NOISY, LITERAL = "limit-5", "noise-5", "literal"
LITERALLY = (LIMITED, NOISY, LITERAL)

LITERAL_NOISE = float(np.radians(5.0))
"""[rad] sigma of equation 19"""
LITERAL_LIMIT = float(np.radians(5.0))
"""[rad] largest joint change in a frame; Park et al. 2024, section IV-D: 0.50 to 5.00 degrees"""

_POLL = 0.5  # [s]


def recipe(name: str) -> tuple[Preset, int]:
    """Preset and what is added to the seed, for the training called ``name``."""
    kind, _, number = name.rpartition("-")
    if kind == "worn":
        return PAPER, int(number)
    if kind == "healthy":
        return replace(PAPER, name="paper-healthy", ranges="paper-healthy"), int(number)
    law = replace(PAPER.task.law, authority_floor=LITERAL_LIMIT, authority_limit=LITERAL_LIMIT)
    limited = replace(PAPER, name="paper-limit-5", task=replace(PAPER.task, law=law))
    noisy = replace(limited, name="paper-noise-5", joint_noise=LITERAL_NOISE)
    literal = replace(noisy, name="paper-literal", task=replace(noisy.task, layout="equation-16-action"))
    return {LIMITED: limited, NOISY: noisy, LITERAL: literal}[name], 0


def finish_trainings(bench: Bench, names: Sequence[str]) -> None:
    """Run those trainings that are not finished, ``bench.threads`` at a time, each in a process of its own.

    One learner gains little from a second core, two trainings side by side gain all of it.
    """
    missing = [name for name in names if not bench.training(name).policy.exists()]
    if not missing:
        return
    context = multiprocessing.get_context("spawn")  # a fork would copy the state of torch and MuJoCo
    news: Queue[_News] = context.Queue()
    workers = min(bench.threads, len(missing))
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_begin_worker, initargs=(news,)) as pool:
        quiet = replace(bench, on_progress=no_progress)  # a callback cannot go to another process
        waiting = {pool.submit(_work, quiet, name) for name in missing}
        try:
            _wait(bench, waiting, news, dict.fromkeys(missing, 0.0))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in multiprocessing.active_children():  # their checkpoints are at most a few updates old
                worker.terminate()
            raise


def spread_trainings(bench: Bench, names: Sequence[str], elsewhere: Elsewhere) -> None:
    """Run those trainings that are not finished ``elsewhere``, where the folder of the bench is as here."""
    missing = [name for name in names if not bench.training(name).policy.exists()]
    work = partial(_train, replace(bench, on_progress=no_progress))
    elsewhere.each(
        work, missing, lambda done: bench.on_progress(done / len(missing), f"{done} of {len(missing)} trainings")
    )  # fmt: skip


def _wait(bench: Bench, waiting: set[Future[str]], news: Queue[_News], done: dict[str, float]) -> None:
    """Tell how it goes until all are done; RejointError with what went wrong in one."""
    while waiting:
        _report(bench, news, done)
        finished = {future for future in waiting if future.done()}
        for future in finished:
            problem = future.result()
            if problem:
                raise RejointError(problem)
        waiting -= finished


_News = tuple[str, float, str]
"""Name of a training, its share that is done, how it stands"""


@lru_cache(maxsize=1)
def _channel() -> list[Queue[_News]]:
    """Where this process reports to; filled once by `_begin_worker`."""
    return []


def _begin_worker(news: Queue[_News]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that started this one
    _channel().append(news)


def _work(bench: Bench, name: str) -> str:
    """Run one training; returns what went wrong, if anything: not every error can travel between processes."""
    news = _channel()[0]
    try:
        _train(bench, name, lambda share, text: news.put((name, share, text)))
    except RejointError as error:
        return str(error)
    return ""


def _train(bench: Bench, name: str, on_progress: Progress = no_progress) -> None:
    preset, offset = recipe(name)
    options = TrainingOptions(
        preset=preset, seed=bench.seed + offset, agents=bench.scale.agents, threads=1,
        iterations=bench.scale.updates, snapshot_every=bench.scale.snapshot_every, resume=True,
    )  # fmt: skip
    train(bench.arm, None, out=bench.training(name).path, options=options, on_progress=on_progress)


def _report(bench: Bench, news: Queue[_News], done: dict[str, float]) -> None:
    try:
        name, share, text = news.get(timeout=_POLL)
    except Empty:
        return
    done[name] = share
    bench.on_progress(sum(done.values()) / len(done), f"training {name}: {text}")
