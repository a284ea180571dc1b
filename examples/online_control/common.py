"""Parts that the agents share: the environment with a memory, and the score of an episode."""

from collections.abc import Callable
from dataclasses import dataclass

import gymnasium as gym
import numpy as np

from dynslam_bench.envs import STATS_LAYOUT, ControlBenchmark

Policy = Callable[[np.ndarray, int], object]
"""From the observation and the number of the step to the action."""
FIELDS = {
    name: index for index, name in enumerate([*(name for name, _ in STATS_LAYOUT), "since_network"])
}
"""Where each entry of the observation stands."""


class Memory(gym.ObservationWrapper):
    """Appends n / (n + 10) of the frames n since the network last ran, which no single frame tells."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        space = env.observation_space
        low = np.append(space.low, np.float32(0))
        high = np.append(space.high, np.float32(1))
        self.observation_space = gym.spaces.Box(low, high)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        # frames since the last one that was segmented; all where there is none
        latest_first = self.unwrapped.episode.outcomes[::-1]
        segmented = (n for n, frame in enumerate(latest_first) if frame.stats.get("segmented"))
        since = next(segmented, len(latest_first))
        return np.append(observation, np.float32(since / (since + 10)))


@dataclass(frozen=True)
class Score:
    """An episode: rewards, their part without the cost (metres, as loss), and the cost in its unit."""

    earned: float
    error: float
    cost: float


def score(benchmark: ControlBenchmark, env: gym.Env) -> Score:
    """The score of the frames so far but the first, which no action has changed."""
    frames = env.unwrapped.episode.outcomes[1:]
    reward = benchmark.reward
    earned = sum(frame.reward for frame in frames)
    charge = sum(reward.charge(frame) for frame in frames)
    return Score(earned, -earned - charge, sum(reward.cost_of(frame) for frame in frames))


def play(benchmark: ControlBenchmark, env: gym.Env, policy: Policy, seed: int = 0) -> Score:
    """Play one episode with a policy."""
    observation, _ = env.reset(seed=seed)
    step = 0
    over = False
    while not over:
        observation, _, terminated, truncated, _ = env.step(policy(observation, step))
        step = step + 1
        over = terminated or truncated
    return score(benchmark, env)
