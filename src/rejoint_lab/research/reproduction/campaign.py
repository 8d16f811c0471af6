"""All experiments: run, resumed, and written as a page."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from msgspec.structs import replace

from rejoint.pages.html import write_page as fill
from rejoint.system.errors import InputError
from rejoint.system.files import read_json, write_json
from rejoint.system.shell import __version__
from rejoint.system.tomltable import read_toml
from rejoint.training.presets import PAPER
from rejoint_lab.research.reproduction.bench import Bench, Experiment, Finished
from rejoint_lab.research.reproduction.trainings import finish_trainings

PAGE = "reproduction.md"
EXPERIMENTS = tuple(
    replace(one, name=name)
    for name, one in read_toml(
        Path(__file__).with_name("experiments.toml"), dict[str, Experiment], "install rejoint again"
    ).items()
)


def choose(names: Sequence[str]) -> tuple[Experiment, ...]:
    """Named experiments, default: all; InputError for unknown ones."""
    known = {name for one in EXPERIMENTS for name in (one.name, one.also) if name}
    for name in names:
        if name not in known:
            raise InputError(f"no experiment is called {name!r}; known: {', '.join(sorted(known))}")
    return tuple(one for one in EXPERIMENTS if not names or {one.name, one.also} & set(names))


@dataclass(frozen=True, kw_only=True)
class Claim:
    """Settings that all results in a folder share."""

    seed: int
    quick: bool


def run_experiments(
    bench: Bench, experiments: Sequence[Experiment], on_experiment: Callable[[Experiment], object]
) -> list[Finished]:
    """Run experiments, called to ``on_experiment``, on what is kept of trainings and trials, and what is missing."""
    wanted, path = Claim(seed=bench.seed, quick=bench.quick), bench.folder / "reproduction.json"
    if path.exists() and (there := read_json(path, Claim)) != wanted:
        raise InputError(
            f"{bench.folder} is a reproduction of {asdict(there)}, not of {asdict(wanted)}; give another --run"
        )
    write_json(path, wanted)
    finish_trainings(bench, list(dict.fromkeys(name for one in experiments for name in one.trainings)))
    found = []
    for one in experiments:
        on_experiment(one)
        found.append(one.finish(one.run(bench), __version__))
        write_json(_file(bench, one), found[-1])
    return found


def _file(bench: Bench, experiment: Experiment) -> Path:
    return bench.folder / "results" / f"{experiment.name}.json"


def write_page(bench: Bench) -> Path:
    """Write all finished experiments to ``reproduction.md`` in the folder, beside the figures."""
    files = {one.name: _file(bench, one) for one in EXPERIMENTS}
    return fill(
        bench.folder / PAGE,
        "reproduction.md",
        bench=bench,
        recipe=PAPER,
        experiments=EXPERIMENTS,
        found={name: read_json(file, Finished) for name, file in files.items() if file.exists()},
        table=_table,
        anchor=lambda title: "".join(c for c in title.lower() if c.isalnum() or c in " -").replace(" ", "-"),
    )


def _table(headers: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Markdown table, with bars escaped."""
    lines = [headers, ["---"] * len(headers), *rows]
    return ["| " + " | ".join(str(cell).replace("|", "\\|") for cell in line) + " |" for line in lines]
