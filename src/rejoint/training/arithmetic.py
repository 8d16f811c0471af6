"""How torch computes while a training runs: settings that outlive the call that makes them, and so are put back.

The precision is that of the whole process: trainings in one process must follow one another, not run side by side in
threads, and nothing else may multiply meanwhile that needs more.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

PRECISION = "medium"
"""Of matrix products while PPO trains: factors in bfloat16 where the processor multiplies it (AMX, AVX512-BF16), sums
in float32 (chosen: a training is faster and ends no worse). Everywhere else torch keeps its own, full float32"""


@contextmanager
def products(precision: str) -> Iterator[None]:
    """Multiply float32 matrices with a ``precision`` of torch, and as before afterwards."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(precision)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@contextmanager
def on_threads(count: int) -> Iterator[None]:
    """Compute on ``count`` threads, and on as many as before afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
