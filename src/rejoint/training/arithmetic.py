"""Torch's settings during a training, restored afterwards.

They hold for the whole process: run no trainings side by side in threads.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

PRECISION = "medium"
"""Of matrix products in PPO: bfloat16 factors where the processor has them, float32 sums; chosen for speed"""


@contextmanager
def products(precision: str) -> Iterator[None]:
    """Set torch's ``precision`` of float32 matrix products within the block."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(precision)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@contextmanager
def on_threads(count: int) -> Iterator[None]:
    """Compute on ``count`` threads within the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
