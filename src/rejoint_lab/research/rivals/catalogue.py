"""Rival controllers with tuned gains."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.controller import Controller
from rejoint.system.errors import InputError
from rejoint.system.files import read_json
from rejoint_lab.research.rivals.adaptive import AdaptiveController, AdaptiveGains
from rejoint_lab.research.rivals.scheduled import ScheduledController, ScheduledGains

Interval = tuple[float, float]

_SCHEDULED: dict[str, Interval] = {
    "far_rate": (0.5, 30.0),
    "near_rate": (0.3, 20.0),
    "schedule": (0.5e-3, 20e-3),
    "deadband": (1e-5, 1e-3),
    "proportional": (1e-3, 1.0),
    "damping": (1e-4, 0.3),
    "prediction": (1e-3, 0.1),
    "moving": (0.01, 3.0),
    "speed": (0.05, 5.0),
    "lead": (np.radians(4.0), np.radians(40.0)),
}
"""Bounds; chosen"""


@dataclass(frozen=True, kw_only=True)
class Rival:
    """A controller with tunable gains."""

    make: Callable[[Arm, Mapping[str, Array]], Controller]
    """from gains by name, numbers or (B, 1)"""
    intervals: Mapping[str, Interval]
    """bounds of the search"""
    gains: Mapping[str, float]


def _scheduled(name: str, anchored: bool, arm: Arm, gains: Mapping[str, Array]) -> Controller:
    return ScheduledController(arm, name, ScheduledGains(**gains), anchored=anchored)


def _adaptive(arm: Arm, gains: Mapping[str, Array]) -> Controller:
    return AdaptiveController(arm, "adaptive", AdaptiveGains(**gains))


_INTERVALS: dict[str, dict[str, Interval]] = {
    "tuned-integrator": _SCHEDULED,
    "tuned-feedforward": _SCHEDULED | {"feedforward": (0.2, 1.8), "ramp": (0.5, 20.0), "carry": (0.2, 1.0)},
    "adaptive": {
        "softness_rate": (0.3, 100.0),
        "load_rate": (0.3, 100.0),
        "offset_rate": (0.1, 10.0),
        "scale": (np.radians(0.5), np.radians(30.0)),
        "damping": (1e-4, 1.0),
        "dead_zone": (np.radians(0.01), np.radians(1.0)),
        "proportional": (1e-3, 1.0),
        "derivative": (1e-4, 0.1),
        "prior": (0.2, 1.8),
    },
}
GAINS = read_json(Path(__file__).with_name("gains.json"), dict[str, dict[str, float]])
"""By ``rejoint research tune`` on the broad ranges, seed 0"""

_MAKERS: dict[str, Callable[[Arm, Mapping[str, Array]], Controller]] = {
    "tuned-integrator": partial(_scheduled, "tuned-integrator", False),
    "tuned-feedforward": partial(_scheduled, "tuned-feedforward", True),
    "adaptive": _adaptive,
}
RIVALS = {name: Rival(make=make, intervals=_INTERVALS[name], gains=GAINS[name]) for name, make in _MAKERS.items()}


def find_rival(name: str) -> Rival:
    """Look up a rival; InputError lists them."""
    if name not in RIVALS:
        raise InputError(f"no rival is called {name!r}; known rivals: {', '.join(RIVALS)}")
    return RIVALS[name]


def make_rival(name: str, arm: Arm, gains: Mapping[str, float] | None = None) -> Controller:
    """Build a rival, default: tuned; InputError for other names."""
    rival = find_rival(name)
    gains = rival.gains if gains is None else gains
    if set(gains) != set(rival.intervals):
        raise InputError(f"{name}: gains {sorted(gains)}, expected {sorted(rival.intervals)}")
    return rival.make(arm, {key: np.asarray(value) for key, value in gains.items()})
