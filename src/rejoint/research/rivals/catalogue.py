"""Rival controllers with tuned gains."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.controller import Controller
from rejoint.research.rivals.adaptive import AdaptiveController, AdaptiveGains
from rejoint.research.rivals.scheduled import ScheduledController, ScheduledGains
from rejoint.system.errors import InputError

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
    """by ``rejoint tune NAME`` on the broad ranges, seed 0"""


def _scheduled(name: str, anchored: bool, arm: Arm, gains: Mapping[str, Array]) -> Controller:
    return ScheduledController(arm, name, ScheduledGains(**gains), anchored=anchored)


def _adaptive(arm: Arm, gains: Mapping[str, Array]) -> Controller:
    return AdaptiveController(arm, "adaptive", AdaptiveGains(**gains))


RIVALS: dict[str, Rival] = {
    "tuned-integrator": Rival(
        make=partial(_scheduled, "tuned-integrator", False),
        intervals=_SCHEDULED,
        gains={
            "far_rate": 5.906,
            "near_rate": 1.435,
            "schedule": 0.005833,
            "deadband": 7.293e-05,
            "proportional": 0.01664,
            "damping": 0.01834,
            "prediction": 0.005945,
            "moving": 2.464,
            "speed": 0.9191,
            "lead": 0.3328,
        },
    ),
    "tuned-feedforward": Rival(
        make=partial(_scheduled, "tuned-feedforward", True),
        intervals=_SCHEDULED | {"feedforward": (0.2, 1.8), "ramp": (0.5, 20.0), "carry": (0.2, 1.0)},
        gains={
            "far_rate": 1.634,
            "near_rate": 4.294,
            "schedule": 0.002525,
            "deadband": 5.369e-05,
            "proportional": 0.01778,
            "damping": 0.02281,
            "prediction": 0.004416,
            "moving": 0.09119,
            "speed": 0.09738,
            "lead": 0.3625,
            "feedforward": 1.258,
            "ramp": 2.125,
            "carry": 0.453,
        },
    ),
    "adaptive": Rival(
        make=_adaptive,
        intervals={
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
        gains={
            "softness_rate": 9.218,
            "load_rate": 2.79,
            "offset_rate": 2.73,
            "scale": 0.05636,
            "damping": 0.002689,
            "dead_zone": 0.0002958,
            "proportional": 0.007722,
            "derivative": 0.01169,
            "prior": 1.305,
        },
    ),
}


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
