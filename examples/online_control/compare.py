"""All agents on the held-out scenes of a benchmark: what can be learnt, what each agent earns, how the learners learn.

    pip install stable-baselines3
    python examples/online_control/compare.py masks-v0 [--steps 5000] [--seeds 5] [--scenes 6]
    [--data-root FOLDER]

Differences are paired by scene; their intervals are of 95 %, from a bootstrap over the scenes.
Recordings are played if they lie in the folder; a network for them is named as a setting:
``--masks onnx:yolov8n-seg.onnx``.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import evolution
import gymnasium as gym
import numpy as np
import static
from common import Memory, Policy, Score, play
from rule import rule
from splice import spliced

from dynslam_bench.core import DynslamError
from dynslam_bench.envs import CONTROL_BENCHMARKS, ControlBenchmark, control_benchmark

Agent = Callable[[gym.Env], Policy]


def main(
    id: str,
    steps: int = 5000,
    seeds: int = 5,
    scenes: int = 6,
    test: int | None = None,
    data_root: str | None = None,
    masks: str | None = None,
    **arguments: Any,
) -> None:
    """Print the tables.

    Args:
        id: Of the benchmark.
        steps: Steps of training of a learner.
        seeds: Learners of each kind.
        scenes: Training scenes.
        test: Held-out scenes; all by default.
        data_root: Folder of the recordings; None leaves them out.
        masks: Source of masks in recordings.
        **arguments: Of `ControlBenchmark.make`.
    """
    # held-out scenes one by one; training scenes one by one, and all in one environment
    bench = control_benchmark(id)
    test_count = len(bench.test) if test is None else test
    tests = [Memory(bench.make("test", n, **arguments)) for n in range(test_count)]
    trains = [Memory(bench.make("train", n, **arguments)) for n in range(scenes)]
    train = Memory(bench.make("train", range(scenes), **arguments))

    def play_all(agent: Agent, envs: Sequence[gym.Env]) -> list[Score]:
        return [play(bench, env, agent(env)) for env in envs]

    # static settings on all scenes: the best one is chosen by its return on the training scenes
    statics: dict[str, Agent] = {name: partial(sweep_agent, name) for name in static.sweep(train)}
    sweep = {name: play_all(agent, tests) for name, agent in statics.items()}
    tuned = {
        name: np.mean([score.earned for score in play_all(agent, trains)])
        for name, agent in statics.items()
    }
    best = max(statics, key=tuned.__getitem__)
    agents: dict[str, list[Agent]] = {
        "default": [static.default],
        "random": [static.random],
        f"best static: {best}": [statics[best]],
        "rule by hand": [rule],
    }
    rows = {
        name: average([play_all(agent, tests) for agent in of_name])
        for name, of_name in agents.items()
    }

    # what hindsight reaches: the best static settings of each scene, and of each stretch of it
    best_of_scene = best_by_scene(*sweep.values())
    splices = [spliced(bench, env, static.sweep(env).values()) for env in tests]
    rows["best static of each scene"] = best_of_scene
    rows["hindsight splice"] = best_by_scene(best_of_scene, splices)
    print(f"{len(tests)} held-out scenes, {scenes} training scenes, {steps} steps a learner.\n")
    print_table(rows, sweep, list(rows))

    # learners of several seeds, then what they have learnt on the held-out scenes
    curves = {}
    learners = {"evolution strategy": learn_evolution, "PPO": learn_ppo}
    began = time.perf_counter()
    for name, learn in learners.items():
        learnt = [learn(bench, train, steps, seed) for seed in range(seeds)]
        agents[name] = [agent for agent, _ in learnt]
        curves |= {(name, seed): curve for seed, (_, curve) in enumerate(learnt)}
    learnt_s = time.perf_counter() - began
    names = list(dict.fromkeys(name for name, _ in curves))
    scores = {name: [play_all(agent, tests) for agent in agents[name]] for name in names}
    print(f"\nLearners, means of {seeds} seeds.\n")
    print_table(rows | {name: average(runs) for name, runs in scores.items()}, sweep, names)
    print_curves(curves, scores)
    if data_root is not None:
        settings = {} if masks is None else {"segmentation.source": masks}
        print_recordings(bench, agents, data_root, settings)
    print(f"\n{2 * seeds * steps / learnt_s:.0f} steps a second while learning.")


def sweep_agent(name: str, env: gym.Env) -> Policy:
    return static.sweep(env)[name]


def learn_evolution(
    bench: ControlBenchmark, env: gym.Env, steps: int, seed: int
) -> tuple[Agent, list]:
    weights, curve = evolution.evolve(bench, env, steps, seed)
    return lambda env: evolution.linear(env, weights), curve


def learn_ppo(bench: ControlBenchmark, env: gym.Env, steps: int, seed: int) -> tuple[Agent, list]:
    import ppo

    policy, curve = ppo.train(env, steps, seed)
    return lambda env: policy, curve


def best_by_scene(*several: Sequence[Score]) -> list[Score]:
    """Of several agents' scores, the one that earned most in each scene."""
    return [max(scores, key=lambda score: score.earned) for scores in zip(*several, strict=True)]


def average(runs: Sequence[Sequence[Score]]) -> list[Score]:
    """The mean over seeds of each scene's score."""
    values = np.mean([[(s.earned, s.error, s.cost) for s in run] for run in runs], axis=0)
    return [Score(*map(float, row)) for row in values]


def percent(rows: np.ndarray, column: int, base: Callable[[np.ndarray], float]) -> str:
    """By how many percent a column's mean differs from a base, with the interval of a bootstrap over the scenes.

    Args:
        rows: Losses, errors and costs ``[scenes, 3]`` of an agent.
        column: Which of them.
        base: From the numbers of the drawn scenes to what the mean is compared with.
    """
    # the scenes themselves, then 1000 draws of as many with replacement
    count = len(rows)
    drawn = [np.arange(count), *np.random.default_rng(0).integers(count, size=(1000, count))]
    with np.errstate(all="ignore"):  # a base of 0 gives inf
        changes = [100 * (rows[scenes, column].mean() / base(scenes) - 1) for scenes in drawn]
        low, high = np.percentile(changes, [2.5, 97.5])
    return f"{changes[0]:+.0f} [{low:+.0f}, {high:+.0f}]"


def front(statics: np.ndarray, scenes: np.ndarray) -> np.ndarray:
    """Mean costs and errors of the static settings that no other one beats in both, by rising cost."""
    # [settings, 2], by cost, then by error
    means = statics[:, scenes, 1:].mean(axis=1)[:, ::-1]
    means = means[np.lexsort(means.T[::-1])]
    # those with a smaller error than all that cost less
    least_error = np.minimum.accumulate(means[:, 1])
    return means[np.r_[True, means[1:, 1] < least_error[:-1]]]


def print_table(
    rows: dict[str, list[Score]], sweep: dict[str, list[Score]], shown: list[str]
) -> None:
    """A row an agent: mean loss (minus the return), error and cost, and what static settings have instead.

    The error is compared with that of static settings at the agent's cost, the cost with theirs at
    the agent's error: between the static settings that no other one beats in both, linearly.
    """
    tables = {name: losses(scores) for name, scores in rows.items()}
    statics = np.array([losses(scores) for scores in sweep.values()])
    best = next(table for name, table in tables.items() if name.startswith("best static:"))
    print(
        "| agent | loss, mm | error, mm | cost | loss against default, % | loss against best static, % ",
        end="",
    )
    print("| error at equal cost, % | cost at equal error, % |\n| --- |" + " ---: |" * 7)
    for name in shown:
        table = tables[name]
        loss, error, cost = table.mean(axis=0)

        def error_there(scenes: np.ndarray, table=table) -> float:
            return float(np.interp(table[scenes, 2].mean(), *front(statics, scenes).T))

        def cost_there(scenes: np.ndarray, table=table) -> float:
            return float(np.interp(table[scenes, 1].mean(), *front(statics, scenes)[::-1, ::-1].T))

        changes = [
            percent(table, 0, lambda scenes: tables["default"][scenes, 0].mean()),
            percent(table, 0, lambda scenes: best[scenes, 0].mean()),
            percent(table, 1, error_there),
            percent(table, 2, cost_there),
        ]
        print(
            f"| {name} | {1e3 * loss:.0f} | {1e3 * error:.0f} | {cost:.1f} | {' | '.join(changes)} |",
            flush=True,
        )


def losses(scores: Sequence[Score]) -> np.ndarray:
    """Losses, errors and costs ``[scenes, 3]``."""
    return np.array([(-score.earned, score.error, score.cost) for score in scores])


def print_recordings(
    bench: ControlBenchmark, agents: dict[str, list[Agent]], folder: str, settings: dict[str, Any]
) -> None:
    """A row an agent and recording; a recording that is not there is left out with the reason."""
    print(
        "\n| recording | agent | loss, mm | error, mm | cost |\n| --- | --- | ---: | ---: | ---: |"
    )
    for number, name in enumerate(bench.recordings):
        try:
            changed = {**bench.settings, **settings}
            env = Memory(bench.make("recordings", number, data_root=folder, settings=changed))
            for agent, seeds in agents.items():
                (mean,) = average([[play(bench, env, each(env))] for each in seeds])
                loss = -1e3 * mean.earned
                error = 1e3 * mean.error
                print(f"| {name} | {agent} | {loss:.0f} | {error:.0f} | {mean.cost:.1f} |")
        except DynslamError as error:
            print(f"| {name} | left out: {error} | | | |")


def print_curves(
    curves: dict[tuple[str, int], list[tuple[int, float]]], scores: dict[str, list[list[Score]]]
) -> None:
    """A row a learner: mean loss of its training episodes from the first steps to the last, then on held-out scenes."""
    print(
        "\n| learner | seed | loss of training episodes, mm, by steps | held out |\n| --- | ---: | --- | ---: |"
    )
    for (name, seed), curve in curves.items():
        parts = ", ".join(f"{steps}: {-1e3 * earned:.0f}" for steps, earned in curve)
        held_out = -1e3 * np.mean([score.earned for score in scores[name][seed]])
        print(f"| {name} | {seed} | {parts} | {held_out:.0f} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("id", choices=list(CONTROL_BENCHMARKS))
    for name, value in (("steps", 5000), ("seeds", 5), ("scenes", 6)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--test", type=int, help="held-out scenes; all by default")
    parser.add_argument("--data-root", help="folder of the recordings")
    parser.add_argument("--masks", help="source of masks in recordings")
    main(**vars(parser.parse_args()))
