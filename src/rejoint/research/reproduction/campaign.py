"""Run experiments one after the other, keep what is finished, go on after an interruption."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from rejoint.research.reproduction.experiment import Bench, Experiment, Finished
from rejoint.research.reproduction.trainings import finish_trainings, spread_trainings
from rejoint.system.elsewhere import Elsewhere
from rejoint.system.errors import InputError
from rejoint.system.files import read_json, write_json
from rejoint.system.progress import no_progress
from rejoint.system.version import __version__


@dataclass(frozen=True, kw_only=True)
class Claim:
    """What a folder is for; everything in it agrees in this."""

    seed: int
    quick: bool


OnExperiment = Callable[[Experiment, bool], object]
"""Called before each experiment with whether it is finished already."""


def run_experiments(
    bench: Bench, experiments: Sequence[Experiment], *, again: bool = False, on_experiment: OnExperiment,
    elsewhere: Elsewhere | None = None,
) -> list[Finished]:  # fmt: skip
    """Run what is not finished yet and return the findings of all ``experiments``.

    Trainings that several need are done first, side by side. With ``again`` an experiment is run anew; trainings and
    comparisons that it is made from are kept. With ``elsewhere`` trainings, and then experiments, are done there.
    """
    _claim(bench)
    needed = [one for one in experiments if again or not finished_file(bench, one).exists()]
    names = list(dict.fromkeys(name for one in needed for name in one.trainings))
    left = set(needed)
    if elsewhere is None:
        finish_trainings(bench, names)
    else:
        spread_trainings(bench, names, elsewhere)
        work, count = partial(_run, replace(bench, on_progress=no_progress)), len(needed)
        elsewhere.each(
            work, needed, lambda done: bench.on_progress(done / count, f"{done} of {count} experiments"),
            cpus_each=bench.threads,
        )  # fmt: skip
        left = set()
    found = []
    for one in experiments:
        on_experiment(one, one not in needed)
        found.append(_run(bench, one) if one in left else read_json(finished_file(bench, one), Finished))
    return found


def _claim(bench: Bench) -> None:
    """Note what the folder is for; InputError if it is for something else."""
    wanted, path = Claim(seed=bench.seed, quick=bench.quick), bench.folder / "reproduction.json"
    if not path.exists():
        write_json(path, wanted)
    elif (found := read_json(path, Claim)) != wanted:
        raise InputError(
            f"{bench.folder} is a {'quick' if found.quick else 'full'} reproduction of seed {found.seed}, expected a "
            f"{'quick' if wanted.quick else 'full'} one of seed {wanted.seed}; give another --run"
        )


def finished_file(bench: Bench, experiment: Experiment) -> Path:
    """Where a finished experiment is kept."""
    return bench.folder / "results" / f"{experiment.name}.json"


def _run(bench: Bench, experiment: Experiment) -> Finished:
    start = time.perf_counter()
    findings = experiment.run(bench)
    finished = Finished(
        experiment=experiment.name, seed=bench.seed, quick=bench.quick, software=__version__,
        seconds=time.perf_counter() - start, findings=findings,
    )  # fmt: skip
    write_json(finished_file(bench, experiment), finished)
    return finished
