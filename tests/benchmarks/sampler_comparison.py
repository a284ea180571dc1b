"""Optuna's samplers and ours at equal trials, on functions with known optima: a Markdown table.

    python tests/benchmarks/sampler_comparison.py [--trials 40] [--seeds 10] [--samplers random tpe ...]

Each cell is the median over the seeds of the best value found (0 is the optimum) in five dimensions, with the share of
seeds in which the sampler beat the random one. A study's objective is noisier and has integers and choices; this table
only says how the samplers search.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import optuna

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # the checkout that this script lies in

from dynslam_bench.tuning import StudySpec
from dynslam_bench.tuning.samplers import build_sampler

DIMENSIONS = 5
SHIFT = np.array([0.21, -0.13, 0.33, -0.37, 0.09])
"""Where the optima lie, as a share of the box: not in its middle, which some searches favour."""


def sphere(x: np.ndarray) -> float:
    return float((x**2).sum())


def rosenbrock(x: np.ndarray) -> float:
    return float((100 * (x[1:] - x[:-1] ** 2 - 2 * x[:-1]) ** 2 + x[:-1] ** 2).sum())


def rastrigin(x: np.ndarray) -> float:
    return float((x**2 - 10 * np.cos(2 * np.pi * x) + 10).sum())


def ackley(x: np.ndarray) -> float:
    narrow, wave = np.exp(-0.2 * np.sqrt((x**2).mean())), np.exp(np.cos(2 * np.pi * x).mean())
    return float(20 + np.e - 20 * narrow - wave)


FUNCTIONS: dict[str, tuple[Callable[[np.ndarray], float], float]] = {
    "sphere": (sphere, 5.0),
    "Rosenbrock": (rosenbrock, 2.0),
    "Rastrigin": (rastrigin, 5.12),
    "Ackley": (ackley, 32.0),
}


def best_value(sampler: str, function: str, seed: int, trials: int) -> float:
    """The best value of one study."""
    evaluate, half = FUNCTIONS[function]

    def objective(trial: optuna.Trial) -> float:
        x = np.array([trial.suggest_float(f"x{i}", -half, half) for i in range(DIMENSIONS)])
        return evaluate(x - half * SHIFT)

    spec = StudySpec(name="x", tune=("synthetic/walking_xyz",), sampler=sampler, sampler_seed=seed, trials=trials)
    study = optuna.create_study(sampler=build_sampler(spec))
    study.optimize(objective, n_trials=trials)
    return float(study.best_value)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--samplers", nargs="+", default=["random", "tpe", "nsga2", "gp", "emfoa"])
    options = parser.parse_args()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
    print(f"| {options.trials} trials | " + " | ".join(FUNCTIONS) + " |")
    print("| --- " * (len(FUNCTIONS) + 1) + "|")
    found = {
        function: [best_value("random", function, seed, options.trials) for seed in range(options.seeds)]
        for function in FUNCTIONS
    }
    for sampler in options.samplers:
        cells = []
        for function, random in found.items():
            values = [best_value(sampler, function, seed, options.trials) for seed in range(options.seeds)]
            wins = np.mean(np.array(values) < np.array(random))
            cells.append(f"{np.median(values):.3g}" + ("" if sampler == "random" else f" ({wins:.0%})"))
        print(f"| {sampler} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
