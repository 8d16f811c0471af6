"""The recipes: ours, from the shelf's policy or from random weights, and the paper's literal one.

They share every line of machinery.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from rejoint.control.feedforward import FeedforwardGains
from rejoint.control.residual import CommandLaw
from rejoint.system.errors import InputError
from rejoint.training.task import TaskSettings


@dataclass(frozen=True, kw_only=True)
class PpoSettings:
    """Settings of proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347)."""

    agents: int = 1024
    """arms that act at the same time (chosen: with 512 and rollouts of twice the length policies are no better)"""
    rollout: int = 16
    """control cycles between two updates"""
    iterations: int = 150
    """updates"""
    epochs: int = 3
    mini_batches: int = 13
    """in each epoch (chosen: as good as five epochs of eight in 120 updates, and less of the time is spent learning)"""
    learning_rate: float = 1e-3
    final_learning_rate: float = 1e-4
    """reached linearly with the last iteration"""
    clip: float = 0.2
    discount: float = 0.98
    gae_lambda: float = 0.95
    gradient_clip: float = 1.0
    value_weight: float = 1.0
    reward_scale: float = 0.1
    """factor on the reward that brings returns, and with them the critic's gradients, to about one"""
    log_std: float = -0.7
    """initial logarithm of the exploration noise"""
    log_std_ceiling: tuple[float, float] = (-0.4, -2.0)
    """its upper bound at the start, and at ``ceiling_falls`` of the training: the policy that is deployed
    has no noise, and must have settled without it"""
    ceiling_falls: float = 0.8
    critic_first: int = 0
    """updates, at first, in which the critic alone learns: one that knows nothing would spoil a good actor"""
    actor_layers: tuple[int, ...] = (128, 64)
    critic_layers: tuple[int, ...] = (128, 64)

    @property
    def transitions(self) -> int:
        """Control cycles of all agents in the whole training."""
        return self.agents * self.rollout * self.iterations


@dataclass(frozen=True, kw_only=True)
class Preset:
    """A complete recipe."""

    name: str
    ranges: Literal["identified", "paper", "paper-healthy"] = "identified"
    """``identified``: the twin's covariance mixed with broad ranges; ``paper``: the paper's P and D of a worn arm;
    ``paper-healthy``: its one pair of P and D of an arm without wear"""
    joint_noise: float = float(np.radians(1.0))
    """[rad] standard deviation of the paper's joint noise; used by the paper's ranges only"""
    task: TaskSettings = field(default_factory=TaskSettings)
    ppo: PpoSettings = field(default_factory=PpoSettings)
    warm: PpoSettings | None = None
    """instead of ``ppo`` where a training on a twin begins at the policy from the shelf; None: it never does"""


FADE = 0.0005
"""[m] distance at which the steps of the law under our policy have faded to half (chosen: the feed-forward controller's
own leaves too little to it, with none arms hunt at a control period of 50 ms)"""

LOAD_PENALTY = 3.0
"""How far the law under our policy spares joints with weight (chosen: with it fewer holds settle above 1 mm)"""

ANYWHERE = 0.5
"""Share of the targets of our trainings that are drawn in all the room that the arm reaches"""

WARM = PpoSettings(
    iterations=49,
    log_std=-1.0,  # with -1.5 and half the learning rate policies settle as near, and come no sooner than the shelf's
    critic_first=3,
)
"""Settings of a training that begins at the policy from the shelf (chosen on arms of family 1 and on that of `make
repair`, see `python -m benchmarks.warmstart` and docs/research.md)"""

SCRATCH = Preset(
    name="scratch",
    task=TaskSettings(
        law=CommandLaw(anchor="goal", learning=FeedforwardGains(fade=FADE), load_penalty=LOAD_PENALTY),
        anywhere=ANYWHERE,
    ),
)
"""Always from random weights"""

DEFAULT = replace(SCRATCH, name="default", warm=WARM)

PAPER = Preset(
    name="paper",
    ranges="paper",
    task=TaskSettings(
        layout="equation-16",
        law=CommandLaw(
            anchor="measured",
            step_gain=1.0,
            authority_floor=float(np.radians(10.0)),  # chosen: with the paper's 5 fewer targets are learned
            authority_slope=0.0,
            authority_limit=float(np.radians(10.0)),
            rest_gain=0.0,
            envelope_margin=float(np.radians(360.0)),
        ),
        reward="equation-25",
        hold_steps=250,  # Table 3: maximum time step
        targets=1,
        min_period=1.0 / 60.0,
        max_period=1.0 / 30.0,
        jitter=0.0,
        start_spread=0.0,
        start_sag=False,
        ends_on_success=True,
        collisions=True,
    ),
    ppo=PpoSettings(
        agents=512,
        rollout=50,  # chosen; with 100 updates it gives Table 3's 5000 time steps
        iterations=100,
        epochs=8,
        mini_batches=8,
        learning_rate=3e-4,  # chosen; the paper gives none
        final_learning_rate=3e-4,
        clip=0.1,
        discount=0.99,
        log_std_ceiling=(-0.4, -0.4),
        actor_layers=(64, 64, 64),
        critic_layers=(64, 64, 64),
    ),
)
"""Park et al. 2024, section III-D and Table 3; what the paper leaves open is marked."""

PRESETS = {preset.name: preset for preset in (DEFAULT, SCRATCH, PAPER)}


def load_preset(name: str) -> Preset:
    """Look up a preset; InputError names the alternatives."""
    if name not in PRESETS:
        raise InputError(f"no preset is called {name!r}; known presets: {', '.join(sorted(PRESETS))}")
    return PRESETS[name]
