"""Elimination of failing and of significantly worse controllers.

After each block: three misses in a row, or a paired t-test on logarithms of settled errors (Maron and Moore, Hoeffding
races, NIPS 1993; Bonferroni's level).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from rejoint.arms import Array
from rejoint.control.comparison.result import WAS_WORSE
from rejoint.control.guard import Reason
from rejoint.control.recording import Recording
from rejoint.control.robot import ControlInput, Controller, Mask
from rejoint.system.errors import InputError

MISSES = 3
"""Misses in a row (chosen)"""


@dataclass(frozen=True, kw_only=True)
class Elimination:
    """Rules of elimination."""

    block: int = 5
    """targets per test (chosen)"""
    level: float = 0.1
    """of all tests together (chosen)"""
    nearest: float = 5e-5
    """[m] least error (chosen)"""

    def __post_init__(self) -> None:
        if self.block < 2 or not 0.0 < self.level < 1.0:
            raise InputError(f"elimination: expected blocks of at least 2 targets and a level below 1, got {self}")


def missed_in_a_row(crossed: Array) -> bool:
    """Whether `MISSES` targets in a row of ``crossed`` (N,) were missed; NaN: not driven."""
    known = crossed[np.isfinite(crossed)]
    misses = np.convolve(known == 0.0, np.ones(MISSES), "valid") if len(known) >= MISSES else np.zeros(0)
    return bool((misses == MISSES).any())


def worse(settled: Mapping[str, Array], rules: Elimination, tests: int) -> dict[str, str]:
    """Significantly worse controllers with reasons, by settled errors (N,) [m]."""
    from scipy import stats  # here, since it takes a second to load

    logs = {name: np.log(np.maximum(errors, rules.nearest)) for name, errors in settled.items()}
    together = np.isfinite(list(logs.values())).all(axis=0)
    if together.sum() < 2:
        return {}
    best = min(logs, key=lambda name: logs[name][together].mean())
    out = {}
    for name, values in logs.items():
        both = np.isfinite(values) & np.isfinite(logs[best])
        difference = values[both] - logs[best][both]
        if name == best or not difference.any():
            continue
        found = stats.ttest_1samp(difference, 0.0, alternative="greater")
        if found.pvalue < rules.level / tests:
            factor = float(np.exp(difference.mean()))
            out[name] = f"{WAS_WORSE}{best} (settles {factor:.1f} times as far off at {len(difference)} targets)"
    return out


class Watched:
    """Ends a trial at a command that is not a number."""

    def __init__(self, controller: Controller) -> None:
        self._controller, self.name = controller, controller.name
        self.failed = False
        self.servo_gains = getattr(controller, "servo_gains", None)

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Pass a new target on."""
        self._controller.reset(inputs, where)

    def command(self, inputs: ControlInput) -> Array:
        """Commands (1, n) [rad]."""
        wanted = self._controller.command(inputs)
        known = np.isfinite(inputs.state.position).all() and np.isfinite(inputs.sent).all()
        if known and not np.isfinite(wanted).all():
            self.failed = True
            return np.array(inputs.sent)
        return wanted

    def give_up(self, _inputs: ControlInput) -> Mask:
        """Whether the trial ends, (1,)."""
        return np.array([self.failed])

    def mark(self, recording: Recording) -> Recording:
        """Flag the failure."""
        if not self.failed:
            return recording
        flag = np.uint16(Reason.NOT_FINITE.value)
        reasons = recording.reasons.copy()
        reasons[-1] |= flag
        return replace(recording, reasons=reasons, tripped=recording.tripped | flag)
