"""Learning from repetition: where the same path is run again, what was missed each time is added to where it is aimed.

Each time tells where to aim for nothing to be missed: where it was aimed at, and what was missed there. The mean over
all times would be right, were it not for what a worn arm misses in another way each time, since its joints stick: aimed
at, that comes on top. So only the share that repeats is taken, frequency by frequency (Wiener's filter): what the times
have in common stands against how much they differ. It is in the space of the tool, forwards and backwards in time, so
that nothing is late; it works through any controller, and what was learned is a path.
"""

from __future__ import annotations

import numpy as np

from rejoint.arms import Array
from rejoint.control.moving.path import Path, path_of

DIFFERENT = 0.35e-3
"""[m/sqrt(Hz)] taken for what differs from time to time, before times can be compared (measured on nine worn arms of
families 0 to 2 on two slow paths: 0.2 below 3 Hz, 0.37 at 3 to 4 Hz)"""
BELIEVED = 2.0
"""Times that this counts for (chosen)"""
DOUBT = 2.0
"""By how much what differs counts against what repeats (chosen: a wrong aim costs more than what is left)"""
HIGHEST = 3.0
"""[Hz] up to which an error is learned (chosen: beyond, a worn joint does not do what it is told)"""
MOST = 0.02
"""[m] by which an aim may leave the path (chosen)"""
_STEP = 0.02  # [s] between the points of what is learned
_WIDTH = 0.3  # [Hz] over which shares are alike (chosen: six turns of the slowest standard path)


class Repetition:
    """What was learned of one path, time after time."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._time = np.linspace(0.0, path.duration, max(2, round(path.duration / _STEP) + 1))
        self._spectra: list[Array] = []  # (F, 3) of where to aim, less the path, for each time

    def learn(self, aim: Path, time: Array, error: Array) -> Path:
        """Return what to aim at next time where ``aim`` left errors (T, 3) [m] at ``time`` (T,) [s]."""
        place = self._path.at(self._time)
        missed = np.stack([np.interp(self._time, time, column) for column in error.T], axis=-1)
        self._spectra.append(_spectrum(aim.at(self._time) - place + missed))
        shift = self._shift()
        size = np.linalg.norm(shift, axis=-1, keepdims=True)
        place = place + shift * np.minimum(1.0, MOST / np.maximum(size, MOST))
        return path_of(self._time, place, self._path.turn_at(self._time), self._path.name)

    def _shift(self) -> Array:
        """Return by how much (K, 3) [m] the aim is to leave the path."""
        step, count = self._time[1] - self._time[0], 2 * len(self._time)
        found, times = np.stack(self._spectra), len(self._spectra)
        mean, frequency = found.mean(axis=0), np.fft.rfftfreq(count, step)
        width = _WIDTH / frequency[1]
        believed = 1.5 * DIFFERENT**2 * count / step  # of all three axes, as a power of this spectrum
        differs = _smooth((np.abs(found - mean) ** 2).sum(axis=(0, 2)), width)
        differs = (BELIEVED * believed + differs) / (BELIEVED + times - 1)
        power = np.maximum(_smooth((np.abs(mean) ** 2).sum(axis=-1), width), np.finfo(float).tiny)
        share = np.clip(1.0 - DOUBT * differs / times / power, 0.0, 1.0) / (1.0 + (frequency / HIGHEST) ** 8)
        return np.fft.irfft(mean * share[:, None], count, axis=0)[: len(self._time)]


def _spectrum(values: Array) -> Array:
    """Spectrum (F, 3) of ``values`` (K, 3), which are taken to go back the way they came, so that no end jumps."""
    return np.asarray(np.fft.rfft(np.concatenate([values, values[::-1]]), axis=0))


def _smooth(values: Array, width: float) -> Array:
    """Mean of ``values`` (F,) around each, over about ``width`` of them."""
    reach = int(np.ceil(3.0 * width))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    return np.convolve(np.pad(values, reach, mode="symmetric"), weights / weights.sum(), "valid")
