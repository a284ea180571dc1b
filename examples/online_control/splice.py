"""Score that hindsight reaches: of a few static settings, the best one for every stretch of the episode.

At every stretch a copy of the episode tries each of the settings, and the one that earns most is
taken. This is no agent, because it knows the rewards before it acts, and no upper bound, because it
looks one stretch ahead alone.
"""

from collections.abc import Iterable

import gymnasium as gym
from common import Policy, Score, score

from dynslam_bench.envs import ControlBenchmark


def spliced(
    benchmark: ControlBenchmark, env: gym.Env, policies: Iterable[Policy], stretch: int = 30
) -> Score:
    """The episode that is spliced from the policies' best stretches."""
    inner = env.unwrapped
    policies = list(policies)
    env.reset(seed=0)
    while not inner.episode.over:
        start = inner.clone_state()
        ends = []
        for policy in policies:
            ends.append(run(env, policy, stretch))
            inner.restore_state(start)
        run(env, policies[max(range(len(ends)), key=ends.__getitem__)], stretch)
    return score(benchmark, env)


def run(env: gym.Env, policy: Policy, frames: int) -> float:
    """Play some frames with a policy that does not look; returns what they earn."""
    inner = env.unwrapped
    earned = 0.0
    for _ in range(frames):
        if inner.episode.over:
            break
        earned += float(env.step(policy(None, inner.episode.next_index - 1))[1])
    return earned
