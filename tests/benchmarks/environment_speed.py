"""Steps a second of a cheap tracker in 1, 2 and 4 environments, with and without memory-mapped frames.

Run from the checkout: ``python tests/benchmarks/environment_speed.py [--sequence ID]``. Each
environment runs in a process of its own. Repeats alternate between the two; the ratio is the median
of the pairs.
"""

import statistics
import time
from functools import partial

import gymnasium as gym
from command_line import parser_of

from dynslam_bench.envs import SlamEnv

SETTINGS = {"preprocessing.width": 320, "preprocessing.height": 240, "features.n_features": 500}


def steps_a_second(sequence: str, count: int, steps: int, memory_map: bool) -> float:
    """Steps of all environments a second of wall time, after ten steps of warm-up."""
    envs = gym.vector.AsyncVectorEnv(
        [
            partial(
                SlamEnv,
                sequence,
                "orb-slam2",
                settings=SETTINGS,
                cache=False,
                memory_map=memory_map,
            )
        ]
        * count
    )
    try:
        envs.reset(seed=0)
        for _ in range(10):
            envs.step(envs.action_space.sample())
        start = time.perf_counter()
        for _ in range(steps):
            envs.step(envs.action_space.sample())
        return count * steps / (time.perf_counter() - start)
    finally:
        envs.close()


def main() -> None:
    """Print the table."""
    arguments = parser_of(
        None, sequence="synthetic/walking_xyz?scene=100", steps=200, repeats=3
    ).parse_args()
    measure = partial(steps_a_second, arguments.sequence)
    print(
        "| environments | decoded at each step | memory-mapped | ratio |\n| --- | --- | --- | --- |"
    )
    for count in (1, 2, 4):
        pairs = [
            tuple(measure(count, arguments.steps, mapped) for mapped in (False, True))
            for _ in range(arguments.repeats)
        ]
        before, after = (statistics.median(column) for column in zip(*pairs, strict=True))
        print(
            f"| {count} | {before:.0f} | {after:.0f} | {statistics.median(b / a for a, b in pairs):.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
