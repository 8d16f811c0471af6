"""All experiments, in the order of the paper."""

from __future__ import annotations

from collections.abc import Sequence

from rejoint.research.reproduction.control import TABLE_4
from rejoint.research.reproduction.curves import FIG_12
from rejoint.research.reproduction.experiment import Experiment
from rejoint.research.reproduction.gains import FIG_10
from rejoint.research.reproduction.kinematics import TABLE_1
from rejoint.research.reproduction.paths import FIG_11
from rejoint.research.reproduction.recipe import TABLE_3
from rejoint.research.reproduction.wear import FIG_9
from rejoint.system.errors import InputError

EXPERIMENTS: tuple[Experiment, ...] = (TABLE_1, FIG_9, FIG_10, TABLE_3, FIG_11, FIG_12, TABLE_4)


def choose(names: Sequence[str]) -> tuple[Experiment, ...]:
    """Return the experiments of those names, in the order of the paper; all without names. InputError names them."""
    known = {name for one in EXPERIMENTS for name in (one.name, *one.also)}
    for name in names:
        if name not in known:
            raise InputError(f"no experiment is called {name!r}; known: {', '.join(sorted(known))}")
    return tuple(one for one in EXPERIMENTS if not names or {one.name, *one.also} & set(names))
