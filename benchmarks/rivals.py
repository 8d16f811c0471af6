"""Training beside Stable-Baselines3's PPO on the same model and networks, in the same run.

On two tasks: our own, and a lean one written for a single arm with MuJoCo's own functions, which does less (no
randomisation, delays, guard, or friction that follows the speed) and is as fast as such an environment gets. On each
with two settings: our mini-batches and epochs, and its own as it comes.
"""

import time
from functools import partial

import mujoco
import numpy as np

from benchmarks.learners import ROLLOUT, begin
from rejoint.arms import mycobot280
from rejoint.training.presets import DEFAULT
from rejoint.training.ranges import BroadRanges
from rejoint.training.task import ReachTask
from rejoint.training.train import know_stiffness
from rejoint.twin.model import TCP_SITE, twin_model
from rejoint.twin.parameters import nominal_parameters
from rejoint.twin.simulation import SUBSTEPS

ENVIRONMENTS, ROUNDS = 16, 3
TRANSITIONS = 104 * ENVIRONMENTS
"""in a rollout (chosen: about two thousand that both sizes of mini-batches divide)"""
OBSERVATION = 50


def environment(seed: int):
    """Build a lean version of the task for Gymnasium."""
    import gymnasium

    class Reach(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-8.0, 8.0, (OBSERVATION,), np.float32)
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (6,), np.float32)

        def __init__(self) -> None:
            self.arm = mycobot280()
            self.model = twin_model(self.arm, nominal_parameters(self.arm), 0.005)
            self.data, self.rng = mujoco.MjData(self.model), np.random.default_rng(seed)
            self.site, self.jacobian = self.model.site(TCP_SITE).id, np.zeros((3, 6))
            self.action = np.zeros(6)

        def reset(self, **_options):
            mujoco.mj_resetData(self.model, self.data)
            self.data.qpos[:] = self.data.ctrl[:] = self.arm.rest
            self.target, self.count = self.arm.targets.sample(self.rng), 0
            mujoco.mj_forward(self.model, self.data)
            return self.observe(), {}

        def observe(self) -> np.ndarray:
            d, j = self.data, self.jacobian
            mujoco.mj_jacSite(self.model, d, j, None, self.site)
            self.error = self.target - d.site_xpos[self.site]
            self.distance = np.sqrt(self.error @ self.error)
            self.step_ = j.T @ np.linalg.solve(j @ j.T + 0.0025 * np.eye(3), self.error)
            parts = (4 * (d.ctrl - d.qpos), 0.5 * d.qvel, 5 * self.step_, np.tanh(57 * self.step_),
                     np.tanh(286 * self.step_), d.qpos, 20 * self.error, self.error / (self.distance + 0.003),
                     [np.log(self.distance + 0.0003), self.count / 120], self.action)  # fmt: skip
            return np.concatenate(parts).astype(np.float32)

        def step(self, action: np.ndarray):
            self.action = action
            self.data.ctrl += 0.1 * np.clip(self.step_, -0.09, 0.09) + 0.05 * action
            mujoco.mj_step(self.model, self.data, SUBSTEPS)
            self.count += 1
            observation = self.observe()
            d = self.distance
            reward = -10 * min(d, 0.1) + 0.4 * np.exp(-d / 0.01) + 0.5 * np.exp(-d / 0.003) + 0.4 * np.exp(-d / 0.001)
            return observation, float(reward), False, self.count >= 120, {}

    return Reach()


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
            infos = [{"TimeLimit.truncated": True, "terminal_observation": t.final_observation[i]} if late else {}
                     for i, late in enumerate(t.truncated)]  # fmt: skip
            return t.observation, t.reward.astype(np.float32), t.truncated, infos

        def close(self) -> None: ...

        def env_is_wrapped(self, *_):
            return [False] * agents

        def get_attr(self, name, indices=None):  # noqa: ARG002
            return [None] * agents

        def set_attr(self, *_) -> None: ...

        def env_method(self, *_): ...

    return Agents()


OURS = {"batch_size": TRANSITIONS // DEFAULT.ppo.mini_batches, "n_epochs": DEFAULT.ppo.epochs}
ITS_OWN = {}
"""Settings of its learning: what is not given is its default, mini-batches of 64 and ten epochs."""


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
    try:
        from stable_baselines3.common.vec_env import DummyVecEnv
    except ImportError as missing:
        print(f"left out: {missing}; `pip install stable-baselines3` brings it")
        return
    tasks = {
        "the same task, 16 arms in one call": lambda: same_task(ENVIRONMENTS),
        "a lean task, 16 environments": lambda: DummyVecEnv([partial(environment, k) for k in range(ENVIRONMENTS)]),
    }
    settings = {"our mini-batches and epochs": OURS, "its own": ITS_OWN}
    rivals = {
        f"{task}, {name}": stable_baselines3(make(), learning)
        for name, learning in settings.items()
        for task, make in tasks.items()
    }
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


if __name__ == "__main__":
    main()
