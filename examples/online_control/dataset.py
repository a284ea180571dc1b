"""A Minari data set of static settings, default and rule on training scenes, for learning without an environment.

pip install "minari[create,hdf5]"
python examples/online_control/dataset.py masks-v0 [SCENES]
"""

import sys

import gymnasium as gym
import minari
import static
from common import Memory, play
from rule import rule

from dynslam_bench.envs import control_benchmark


def main(id: str, scenes: str | int = 8, **arguments: object) -> minari.MinariDataset:
    """Play every agent with as many seeds as there are scenes, and store the episodes as ``dynslam/<id>-static-v0``."""
    bench = control_benchmark(id)
    made = gym.make(
        f"dynslam/{id}", split="train", index=list(range(int(scenes))), fixed_info=True, **arguments
    )
    collector = minari.DataCollector(made, record_infos=True)
    env = Memory(collector)  # for the rule
    for name, policy in {
        "default": static.default(env),
        "rule": rule(env),
        **static.sweep(env),
    }.items():
        print(
            name,
            *(f"{play(bench, env, policy, seed=seed).earned:.3f}" for seed in range(int(scenes))),
        )
    return collector.create_dataset(
        dataset_id=f"dynslam/{id}-static-v0", algorithm_name="static settings and a rule"
    )


if __name__ == "__main__":
    main(*sys.argv[1:3])
