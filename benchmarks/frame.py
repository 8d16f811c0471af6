"""What the benchmarks share: cells and rows of their tables, commands in processes of their own."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from rejoint.control.comparison.result import Protocol
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.system.statistics import paired_difference
from rejoint_lab.research.evaluation.evaluate import inside

Array = NDArray[np.float64]
NARROW = int(np.argmin(Protocol().within))
"""Column of the times to stay within 2 mm"""


def cell(values: Array) -> str:
    """Mean / 95th percentile, without what is not known."""
    return f"{np.nanmean(values):.2f} / {np.nanquantile(values, 0.95):.2f}"


def held_columns(found: dict[str, Array], arms: int) -> tuple[Array, Array]:
    """Settled errors (A, K) [m] and times to stay within the bands (A, K, W) [s] of trials on ``arms`` arms."""
    stay = np.stack([found[name].reshape(arms, -1) for name in Protocol().stay_names], axis=-1)
    return found["settled"].reshape(arms, -1), np.where(stay >= Protocol().hold, np.inf, stay)


def corrected(name: str, tried: dict[str, Array], found: list[Calibration]) -> None:
    """Print a row about calibrated arms: true error [mm], targets inside the interval, calibrations used."""
    share, used = np.nanmean(inside(tried)), np.mean([one.used for one in found])
    print(f"{name:28} {cell(1e3 * tried['settled_true'])}   inside {share:.0%}   used {used:.0%}", flush=True)


def holds(name: str, settled: Array, stay: Array, against: tuple[Array, Array] | None) -> None:
    """Print a row about holds: settled errors (A, K) [m], times to stay within the bands (A, K, W) [s].

    ``against`` is what the generic policy does; pairs are the same arm at the same target, intervals resample arms.
    """
    told = ""
    if against is not None:
        arms = np.repeat(np.arange(len(settled)), settled.shape[1])
        apart = paired_difference(settled.ravel(), against[0].ravel(), arms)
        told = f"; against shelf {np.median(stay[..., NARROW]) / np.median(against[1][..., NARROW]):.2f} of its time"
        if apart is not None and apart.low is not None:
            told += f", settled {1e3 * apart.value:+.2f} mm ({1e3 * apart.low:+.2f} to {1e3 * apart.high:+.2f})"
    within = " / ".join(f"{np.median(one):.2f}" for one in np.moveaxis(stay, -1, 0))
    far = " and ".join(f"{100 * np.mean(~(settled < 1e-3 * mm)):.1f} % beyond {mm} mm" for mm in (1, 5))
    print(f"{name:34} settled {cell(1e3 * settled)} mm, {far}, stays within {within} s{told}", flush=True)


@contextmanager
def process(*words: str) -> Iterator[str]:
    """Yield the address that a command of rejoint prints first."""
    command = [sys.executable, "-m", "rejoint", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as one:
        try:
            assert one.stdout is not None
            yield next(word for line in one.stdout for word in line.split() if "://" in word)
        finally:
            one.terminate()
