"""Random streams of single arms: the n-th number of a stream is a pure function of its key and n.

A batch draws the same numbers as its arms alone, whatever the number of threads, since no generator
is shared and no draw depends on an earlier one. The mixing function is SplitMix64 (Steele, Lea,
Flood: Fast splittable pseudorandom number generators, OOPSLA 2014).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Keys = NDArray[np.uint64]

_STEP = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_SHIFT_1, _SHIFT_2, _SHIFT_3, _TO_53_BITS = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_UNIT = 2.0**-53


def stream_keys(seed: int, count: int, *, first: int = 0, purpose: int = 0) -> Keys:
    """Keys (count,) of the streams of arms ``first``, ``first + 1``, ... for one purpose."""
    sequences = (np.random.SeedSequence(seed, spawn_key=(first + i, purpose)) for i in range(count))
    return np.array([sequence.generate_state(1, np.uint64)[0] for sequence in sequences], dtype=np.uint64)


@njit(cache=True)
def uniform(key, counter):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Return number ``counter`` of the stream ``key``, uniform in [0, 1)."""
    z = key + np.uint64(counter + 1) * _STEP
    z = (z ^ (z >> _SHIFT_1)) * _MIX_1
    z = (z ^ (z >> _SHIFT_2)) * _MIX_2
    z = z ^ (z >> _SHIFT_3)
    return np.float64(z >> _TO_53_BITS) * _UNIT
