"""An evolution strategy (weighted recombination, one step size) tunes a linear policy; numpy alone.

The policy sees five numbers: 1, the mask's share, the frames since the network ran, the camera's
speed, the brightness.
"""

import gymnasium as gym
import numpy as np
from common import FIELDS, Policy, play

from dynslam_bench.envs import ControlBenchmark

INPUTS = 5
"""Numbers that the policy sees."""
MOTION = slice(FIELDS["motion_x"], FIELDS["motion_x"] + 6)
"""Where the camera's motion stands in the observation."""


def inputs(observation: np.ndarray) -> np.ndarray:
    """The numbers ``[5]`` that the policy sees of an observation."""
    speed = np.abs(observation[MOTION]).max()
    values = [
        observation[FIELDS[name]] for name in ("mask_fraction", "since_network", "brightness")
    ]
    return np.array([1.0, *values, speed])


def linear(env: gym.Env, weights: np.ndarray) -> Policy:
    """Segment if the weighted sum is positive; or the neutral action changed by a sum for each setting."""
    if isinstance(env.action_space, gym.spaces.Discrete):
        return lambda observation, step: 0 if weights @ inputs(observation) > 0 else 3
    rows = weights.reshape(-1, INPUTS)
    neutral = env.unwrapped.neutral_action

    def act(observation: np.ndarray, step: int) -> np.ndarray:
        return np.clip(neutral + rows @ inputs(observation), -1, 1).astype(np.float32)

    return act


def evolve(
    benchmark: ControlBenchmark, env: gym.Env, steps: int, seed: int, population: int = 8
) -> tuple[np.ndarray, list[tuple[int, float]]]:
    """The weights after so many steps, and the learning curve: steps and the generation's mean return.

    All candidates of a generation play the same scene.
    """
    rng = np.random.default_rng(seed)
    rows = 1 if isinstance(env.action_space, gym.spaces.Discrete) else env.action_space.shape[0]
    centre = np.zeros(rows * INPUTS)
    sigma = 0.5
    # weights of the better half in the recombination, falling with the rank
    share = np.log(population / 2 + 0.5) - np.log(np.arange(1, population // 2 + 1))
    share /= share.sum()
    used = 0
    generation = 0
    curve = []
    while used < steps:
        # mutate, play, recombine
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
