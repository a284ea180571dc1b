"""Agents that never look: the default, random actions, and a sweep of static settings."""

from itertools import product

import gymnasium as gym
from common import Policy


def default(env: gym.Env) -> Policy:
    """The settings as they are."""
    action = (
        0 if isinstance(env.action_space, gym.spaces.Discrete) else env.unwrapped.neutral_action
    )
    return lambda observation, step: action


def random(env: gym.Env, seed: int = 0) -> Policy:
    """Any action at any frame."""
    env.action_space.seed(seed)
    return lambda observation, step: env.action_space.sample()


def sweep(env: gym.Env) -> dict[str, Policy]:
    """Static settings by their name: the network on every n-th frame, or features, keyframe share and search radius."""
    if isinstance(env.action_space, gym.spaces.Discrete):  # actions 0 to 2 segment, 3 to 5 do not
        wide = {f"every {n}th frame": periodic(n, 0) for n in (1, 2, 3, 4, 6, 8, 12)} | {
            "never": periodic(10**6, 0)
        }
        return wide | {f"every {n}th frame, grown by 5 px": periodic(n, 1) for n in (2, 4)}
    names = "features.n_features", "backend.keyframes.tracked_share", "backend.tracking.radius_px"
    grid = [
        *product((300, 450, 700, 1000), (0.75, 0.5), (15.0,)),
        (500, 0.75, 15.0),
        (500, 0.5, 35.0),
    ]
    actions = {
        values: env.unwrapped.action_of(dict(zip(names, values, strict=True))) for values in grid
    }
    return {
        f"{n} features, share {s}, {r:g} px": constant(action)
        for (n, s, r), action in actions.items()
    }


def periodic(n: int, grown: int) -> Policy:
    return lambda observation, step: grown if step % n == n - 1 else 3 + grown


def constant(action: object) -> Policy:
    return lambda observation, step: action
