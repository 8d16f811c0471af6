"""Adam (Kingma and Ba 2015, arXiv:1412.6980), all parameters in one call.

Bit for bit `torch.optim.Adam`, which also imports torch's compiler: 80 MB and a second.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim.adam import adam

BETA1, BETA2, EPS = 0.9, 0.999, 1e-8
"""The paper's"""


@dataclass(frozen=True, eq=False)
class _Moments:
    step: Tensor
    """number of gradients"""
    exp_avg: Tensor
    exp_avg_sq: Tensor


class Adam:
    """An optimiser for skrl."""

    def __init__(self, parameters: Iterable[Parameter]) -> None:
        self._parameters = list(parameters)
        self._moments: dict[int, _Moments] = {}
        self.learning_rate = 1e-3

    def zero_grad(self) -> None:
        """Clear all gradients."""
        for parameter in self._parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Update the parameters that have a gradient."""
        moved: list[Tensor] = []
        gradients, moments = [], []
        for k, parameter in enumerate(self._parameters):
            if parameter.grad is None:
                continue
            if k not in self._moments:
                self._moments[k] = _Moments(torch.zeros(()), torch.zeros_like(parameter), torch.zeros_like(parameter))
            moved.append(parameter)
            gradients.append(parameter.grad)
            moments.append(self._moments[k])
        adam(
            moved,
            gradients,
            [m.exp_avg for m in moments],
            [m.exp_avg_sq for m in moments],
            [],
            [m.step for m in moments],
            fused=True,
            amsgrad=False,
            beta1=BETA1,
            beta2=BETA2,
            lr=self.learning_rate,
            weight_decay=0.0,
            eps=EPS,
            maximize=False,
        )

    def state_dict(self) -> dict[str, Any]:
        """Checkpoint with the names of torch's optimiser."""
        return {"state": {k: dict(vars(moments)) for k, moments in self._moments.items()}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict`."""
        self._moments = {
            k: _Moments(**{name: value.clone() for name, value in one.items()}) for k, one in state["state"].items()
        }
