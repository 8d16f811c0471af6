"""Training recipes: from the generic policy or from random weights."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from rejoint.control.controllers.feedforward import CommandLaw, FeedforwardGains
from rejoint.system.errors import InputError
from rejoint.training.task import ReachTask, TaskSettings


@dataclass(frozen=True, kw_only=True)
class PpoSettings:
    """Settings of proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347)."""

    agents: int = 1024
    """arms at the same time; chosen"""
    rollout: int = 16
    """control cycles between updates"""
    iterations: int = 150
    """updates"""
    epochs: int = 3
    mini_batches: int = 13
    """per epoch; chosen"""
    learning_rate: float = 1e-3
    final_learning_rate: float = 1e-4
    """at the last iteration, linear"""
    clip: float = 0.2
    discount: float = 0.98
    gae_lambda: float = 0.95
    gradient_clip: float = 1.0
    value_weight: float = 1.0
    reward_scale: float = 0.1
    """to scale returns to about one"""
    log_std: float = -0.7
    """initial log exploration noise"""
    log_std_ceiling: tuple[float, float] = (-0.4, -2.0)
    """its upper bound at the start, and at ``ceiling_falls`` of the training: deployment has no noise"""
    ceiling_falls: float = 0.8
    critic_first: int = 0
    """first updates of the critic alone: an untrained one would spoil a good actor"""
    actor_layers: tuple[int, ...] = (128, 64)
    critic_layers: tuple[int, ...] = (128, 64)


@dataclass(frozen=True, kw_only=True)
class Preset:
    """A recipe."""

    name: str
    make: type[ReachTask] = ReachTask
    """the task's own kind"""
    task: TaskSettings = field(default_factory=TaskSettings)
    ppo: PpoSettings = field(default_factory=PpoSettings)
    warm: PpoSettings | None = None
    """instead of ``ppo`` for a training from the generic policy; None: never"""


FADE = 0.0005
"""[m] at which the law's steps have faded to half; chosen: no arm hunts at 50 ms"""

LOAD_PENALTY = 3.0
"""Penalty of loaded joints in the law; chosen"""

ANYWHERE = 0.5
"""Share of targets drawn in the whole workspace"""

WARM = PpoSettings(
    iterations=49,
    log_std=-1.0,  # with -1.5 and half the learning rate policies settle as near, and come no sooner than the shelf's
    critic_first=3,
)
"""Training from the generic policy; chosen by `python -m benchmarks warmstart`"""

SCRATCH = Preset(
    name="scratch",
    task=TaskSettings(
        law=CommandLaw(anchor="goal", learning=FeedforwardGains(fade=FADE), load_penalty=LOAD_PENALTY),
        anywhere=ANYWHERE,
    ),
)
"""From random weights"""

DEFAULT = replace(SCRATCH, name="default", warm=WARM)

PRESETS = {preset.name: preset for preset in (DEFAULT, SCRATCH)}


def load_preset(name: str) -> Preset:
    """Look up a preset; InputError names the alternatives."""
    if name not in PRESETS:
        raise InputError(f"no preset is called {name!r}; known presets: {', '.join(sorted(PRESETS))}")
    return PRESETS[name]
