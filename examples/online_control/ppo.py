"""PPO of stable-baselines3 with its own settings but for short horizons, larger steps and rewards of about one."""

import gymnasium as gym
import numpy as np
import torch
from common import Policy
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor


def train(env: gym.Env, steps: int, seed: int) -> tuple[Policy, list[tuple[int, float]]]:
    """The policy after so many steps, and the learning curve: steps and the mean return of the episodes between.

    Discrete actions are drawn; of continuous ones the mean is taken.
    """
    monitor = Monitor(env)
    scaled = gym.wrappers.TransformReward(monitor, lambda reward: 100.0 * reward)
    torch.set_num_threads(1)
    size = min(256, steps)
    sizes = {"n_steps": size, "batch_size": min(64, size)}
    agent = PPO(
        "MlpPolicy", scaled, **sizes, gamma=0.9, learning_rate=1e-3, seed=seed, device="cpu"
    )
    agent.learn(steps)
    returns = monitor.get_episode_rewards()
    lengths = np.cumsum(monitor.get_episode_lengths())
    parts = np.array_split(np.arange(len(returns)), min(8, len(returns)))
    curve = [
        (int(lengths[part[-1]]), float(np.mean([returns[n] for n in part])))
        for part in parts
        if len(part)
    ]
    means = isinstance(env.action_space, gym.spaces.Box)
    return lambda observation, step: agent.predict(observation, deterministic=means)[0], curve
