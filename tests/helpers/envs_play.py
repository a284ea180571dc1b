"""How the tests of environments play episodes."""

import warnings
from typing import Any

import gymnasium as gym
import pytest
from gymnasium.utils.env_checker import check_env

QUIET = {"noise.enabled": False}


def play(
    env: gym.Env, seed: int | None = 0, **reset: Any
) -> tuple[list[float], list[dict], list[tuple[bool, bool]]]:
    """Rewards, infos and ends of an episode that leaves the settings alone."""
    rewards = []
    infos = [env.reset(seed=seed, **reset)[1]]
    ends = []
    while not ends or not any(ends[-1]):
        _, reward, terminated, truncated, info = env.step(env.unwrapped.neutral_action)
        rewards.append(float(reward))
        infos.append(info)
        ends.append((terminated, truncated))
    return rewards, infos, ends


def stepped(env: gym.Env, steps: int, seed: int = 3) -> gym.Env:
    """The environment after so many steps."""
    env.reset(seed=seed)
    for _ in range(steps):
        env.step(env.unwrapped.neutral_action)
    return env


def rest(env: gym.Env, action: Any = None) -> tuple[list[float], bytes, bytes]:
    """Rewards of the steps that are left, the online poses and the last observation."""
    inner = env.unwrapped
    rewards = []
    while not inner.episode.over:
        observation, reward, *_ = env.step(inner.neutral_action if action is None else action)
        rewards.append(float(reward))
    return rewards, inner.online_trajectory().T_world_cam.tobytes(), observation.tobytes()


def checked(env: gym.Env) -> None:
    """Gymnasium's checker has nothing to say."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    env.close()


def checked_by_stable_baselines3(env: gym.Env) -> None:
    """Its checker has nothing to say."""
    checks = pytest.importorskip(
        "stable_baselines3.common.env_checker", reason="the extra [rl] is not installed"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checks.check_env(env)
