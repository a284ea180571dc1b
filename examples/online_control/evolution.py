"""An evolution strategy (weighted recombination, one step size) tunes a linear policy; numpy alone.

The policy sees five numbers: 1, the mask's share, the frames since the network ran, the camera's
speed, the brightness.
"""

import gymnasium as gym
import numpy as np
from common import FIELDS, Policy, play

from dynslam_bench.envs import ControlBenchmark

SEEN = 5
MOTION = slice(FIELDS["motion_x"], FIELDS["motion_x"] + 6)


def seen(observation: np.ndarray) -> np.ndarray:
    speed = np.abs(observation[MOTION]).max()
    values = [
        observation[FIELDS[name]] for name in ("mask_fraction", "since_network", "brightness")
    ]
    return np.array([1.0, *values, speed])


def linear(env: gym.Env, weights: np.ndarray) -> Policy:
    """Segment if the weighted sum is positive; or the neutral action changed by a sum for each setting."""
    if isinstance(env.action_space, gym.spaces.Discrete):
        return lambda observation, step: 0 if weights @ seen(observation) > 0 else 3
    rows = weights.reshape(-1, SEEN)
    neutral = env.unwrapped.neutral_action
    return lambda observation, step: np.clip(neutral + rows @ seen(observation), -1, 1).astype(
        np.float32
    )


def evolve(
    benchmark: ControlBenchmark, env: gym.Env, steps: int, seed: int, population: int = 8
) -> tuple[np.ndarray, list[tuple[int, float]]]:
    """The weights after so many steps, and the learning curve: steps and the generation's mean return.

    All candidates of a generation play the same scene.
    """
    rng = np.random.default_rng(seed)
    rows = 1 if isinstance(env.action_space, gym.spaces.Discrete) else env.action_space.shape[0]
    centre = np.zeros(rows * SEEN)
    sigma = 0.5
    share = np.log(population / 2 + 0.5) - np.log(np.arange(1, population // 2 + 1))
    share /= share.sum()
    used = 0
    generation = 0
    curve = []
    while used < steps:
        candidates = centre + sigma * rng.normal(size=(population, len(centre)))
        played = [
            play(benchmark, env, linear(env, weights), 1000 * seed + generation)
            for weights in candidates
        ]
        returns = [score.earned for score in played]
        used += population * (env.unwrapped.episode.next_index - 1)
        centre = share @ candidates[np.argsort(returns)[::-1][: len(share)]]
        sigma = 0.9 * sigma
        generation = generation + 1
        curve.append((used, float(np.mean(returns))))
    return centre, curve
