"""Our Adam is torch's own, to the bit, without torch's compiler."""

import pytest
import torch
from torch.nn import Parameter

from commandline import python
from rejoint.training.ppo import Adam


def parameters():
    torch.manual_seed(3)
    return [Parameter(torch.randn(shape)) for shape in ((7, 5), (5,), (3, 33))]


def improve(optimizer, ours, set_rate, steps, first=0):
    """Take steps along the same gradients; the first parameter has none in the first three."""
    for step in range(first, first + steps):
        optimizer.zero_grad()
        assert all(parameter.grad is None for parameter in ours)
        random = torch.Generator().manual_seed(step)
        for parameter in ours[1 if step < 3 else 0 :]:
            parameter.grad = torch.randn(parameter.shape, generator=random)
        set_rate(1e-2 / (1 + step))
        optimizer.step()


@pytest.fixture
def expected():
    theirs = parameters()
    optimizer = torch.optim.Adam(theirs, fused=True)
    improve(optimizer, theirs, lambda rate: optimizer.param_groups[0].update(lr=rate), 8)
    return theirs


def test_it_is_torchs_own_to_the_bit(expected):
    ours = parameters()
    optimizer = Adam(ours)
    improve(optimizer, ours, lambda rate: setattr(optimizer, "learning_rate", rate), 8)
    assert all(torch.equal(a, b) for a, b in zip(ours, expected, strict=True))


def test_a_learner_does_without_torchs_compiler():
    code = (
        "import sys\n"
        "from rejoint.arms import mycobot280\n"
        "from rejoint.training.learner import Learner\n"
        "from rejoint.training.presets import PpoSettings\n"
        "from rejoint.training.ranges import BroadRanges\n"
        "from rejoint.training.task import ReachTask, TaskSettings\n"
        "arm = mycobot280()\n"
        "task = ReachTask(arm, BroadRanges(arm=arm), 4, TaskSettings(hold_steps=8), seed=0)\n"
        "small = PpoSettings(rollout=2, mini_batches=1, epochs=1, actor_layers=(4,), critic_layers=(4,))\n"
        "Learner([task], small, seed=0).iterate()\n"
        "assert 'torch' in sys.modules\n"
        "assert not {'torch._dynamo', 'sympy'} & set(sys.modules)\n"
    )
    python("-c", code)
