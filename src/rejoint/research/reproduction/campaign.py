"""All experiments: run, stored, resumed, and written as a page."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from rejoint.pages.html import write_page as fill
from rejoint.research.reproduction.control import TABLE_4
from rejoint.research.reproduction.curves import FIG_12
from rejoint.research.reproduction.experiment import Bench, Experiment, Finished
from rejoint.research.reproduction.gains import FIG_10
from rejoint.research.reproduction.kinematics import TABLE_1
from rejoint.research.reproduction.paths import FIG_11
from rejoint.research.reproduction.recipe import TABLE_3
from rejoint.research.reproduction.trainings import finish_trainings
from rejoint.research.reproduction.wear import FIG_9
from rejoint.system.errors import InputError
from rejoint.system.files import read_json, write_json
from rejoint.system.shell import __version__

EXPERIMENTS: tuple[Experiment, ...] = (TABLE_1, FIG_9, FIG_10, TABLE_3, FIG_11, FIG_12, TABLE_4)


def choose(names: Sequence[str]) -> tuple[Experiment, ...]:
    """Named experiments, default: all; InputError for unknown ones."""
    known = {name for one in EXPERIMENTS for name in (one.name, *one.also)}
    for name in names:
        if name not in known:
            raise InputError(f"no experiment is called {name!r}; known: {', '.join(sorted(known))}")
    return tuple(one for one in EXPERIMENTS if not names or {one.name, *one.also} & set(names))


@dataclass(frozen=True, kw_only=True)
class Claim:
    """Settings that all results in a folder share."""

    seed: int
    quick: bool


OnExperiment = Callable[[Experiment, bool], object]
"""Called before each experiment, with whether it is finished"""


def run_experiments(
    bench: Bench,
    experiments: Sequence[Experiment],
    *,
    again: bool = False,
    on_experiment: OnExperiment,
) -> list[Finished]:
    """Run unfinished experiments and return all findings.

    ``again`` repeats experiments, not trainings or comparisons.
    """
    _claim(bench)
    needed = [one for one in experiments if again or not finished_file(bench, one).exists()]
    names = list(dict.fromkeys(name for one in needed for name in one.trainings))
    finish_trainings(bench, names)
    found = []
    for one in experiments:
        on_experiment(one, one not in needed)
        found.append(_run(bench, one) if one in needed else read_json(finished_file(bench, one), Finished))
    return found


def _claim(bench: Bench) -> None:
    wanted, path = Claim(seed=bench.seed, quick=bench.quick), bench.folder / "reproduction.json"
    if not path.exists():
        write_json(path, wanted)
    elif (found := read_json(path, Claim)) != wanted:
        raise InputError(
            f"{bench.folder} is a {'quick' if found.quick else 'full'} reproduction of seed {found.seed}, expected a "
            f"{'quick' if wanted.quick else 'full'} one of seed {wanted.seed}; give another --run"
        )


def finished_file(bench: Bench, experiment: Experiment) -> Path:
    """File of a finished experiment."""
    return bench.folder / "results" / f"{experiment.name}.json"


def _run(bench: Bench, experiment: Experiment) -> Finished:
    start = time.perf_counter()
    findings = experiment.run(bench)
    finished = Finished(
        experiment=experiment.name,
        seed=bench.seed,
        quick=bench.quick,
        software=__version__,
        seconds=time.perf_counter() - start,
        findings=findings,
    )
    write_json(finished_file(bench, experiment), finished)
    return finished


def write_page(bench: Bench, page: Path) -> Path:
    """Write finished experiments and figures to ``page``."""
    files = {one.name: finished_file(bench, one) for one in EXPERIMENTS}
    found = {name: read_json(file, Finished).findings for name, file in files.items() if file.exists()}
    pictures = page.with_suffix("")
    for drawing in (drawing for one in found.values() for drawing in one.drawings):
        pictures.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(bench.folder / "figures" / f"{drawing.key}.png", pictures / f"{drawing.key}.png")
    return fill(
        page,
        "reproduction.md",
        bench=bench,
        experiments=EXPERIMENTS,
        found=found,
        pictures=pictures.name,
        table=table,
        anchor=_anchor,
    )


def table(headers: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Markdown table, with bars escaped."""
    lines = [headers, ["---"] * len(headers), *rows]
    return ["| " + " | ".join(str(cell).replace("|", "\\|") for cell in line) + " |" for line in lines]


def _anchor(title: str) -> str:
    return "".join(letter for letter in title.lower() if letter.isalnum() or letter in " -").replace(" ", "-")
