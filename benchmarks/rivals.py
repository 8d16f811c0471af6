"""Training beside Stable-Baselines3's PPO on the same model and networks, in the same run.

With two settings of its own: our mini-batches and epochs, and those that it comes with.
"""

import time
from importlib.util import find_spec

import numpy as np

from benchmarks.training import ROLLOUT, begin
from rejoint.arms import mycobot280
from rejoint.training.presets import DEFAULT
from rejoint.training.ranges import BroadRanges
from rejoint.training.task import ReachTask
from rejoint.training.train import know_stiffness

ENVIRONMENTS, ROUNDS = 16, 3
TRANSITIONS = 104 * ENVIRONMENTS
"""in a rollout (chosen: about two thousand that both sizes of mini-batches divide)"""


def same_task(agents: int):
    """Wrap the task itself, several agents in one call, as Stable-Baselines3 wants its environments."""
    import gymnasium
    from stable_baselines3.common.vec_env import VecEnv

    arm = mycobot280()
    task = ReachTask(arm, BroadRanges(arm=arm), agents, know_stiffness(DEFAULT, arm, None).task, seed=0)
    spaces = (gymnasium.spaces.Box(-8.0, 8.0, (task.observer.size,)), gymnasium.spaces.Box(-9.0, 9.0, (arm.joints,)))

    class Agents(VecEnv):
        def __init__(self) -> None:
            super().__init__(agents, *spaces)

        def reset(self):
            return task.reset()[0]

        def step_async(self, actions) -> None:
            self.transition = task.step(actions)

        def step_wait(self):
            t = self.transition
            infos = [
                {"TimeLimit.truncated": True, "terminal_observation": t.final_observation[i]} if late else {}
                for i, late in enumerate(t.truncated)
            ]
            return t.observation, t.reward.astype(np.float32), t.truncated, infos

        def close(self) -> None: ...

        def env_is_wrapped(self, *_):
            return [False] * agents

        def get_attr(self, name, indices=None):  # noqa: ARG002
            return [None] * agents

        def set_attr(self, *_) -> None: ...

        def env_method(self, *_): ...

    return Agents()


SETTINGS = {
    "our mini-batches and epochs": {
        "batch_size": TRANSITIONS // DEFAULT.ppo.mini_batches,
        "n_epochs": DEFAULT.ppo.epochs,
    },
    "its own": {},
}
"""Of its learning: what is not given is its default, mini-batches of 64 and ten epochs."""


def stable_baselines3(environments, learning):
    """Start Stable-Baselines3's PPO with settings of its ``learning`` and do its first update."""
    import torch
    from stable_baselines3 import PPO

    s = DEFAULT.ppo
    learner = PPO(
        "MlpPolicy",
        environments,
        n_steps=TRANSITIONS // environments.num_envs,
        **learning,
        policy_kwargs={
            "net_arch": {"pi": list(s.actor_layers), "vf": list(s.critic_layers)},
            "activation_fn": torch.nn.ELU,
        },
        device="cpu",
    )
    learner.learn(TRANSITIONS)
    return learner


def main() -> None:
    if find_spec("stable_baselines3") is None:
        print("left out: `pip install stable-baselines3` brings what it compares with")
        return
    rivals = {name: stable_baselines3(same_task(ENVIRONMENTS), learning) for name, learning in SETTINGS.items()}
    ours, mine, theirs = begin(), [], {name: [] for name in rivals}
    for _ in range(ROUNDS):  # in turns, so that other load hits all alike
        for name, rival in rivals.items():
            start = time.perf_counter()
            rival.learn(TRANSITIONS)
            theirs[name].append(TRANSITIONS / (time.perf_counter() - start))
        start = time.perf_counter()
        for _ in range(3):
            ours.iterate()
        mine.append(3 * ours.agents * ROLLOUT / (time.perf_counter() - start))
    speed = float(np.median(mine))
    print(f"ours: {speed:.0f} transitions per second")
    for name, speeds in theirs.items():
        other = float(np.median(speeds))
        print(f"Stable-Baselines3, {name}: {other:.0f}; ours is {speed / other:.1f} x as fast")
