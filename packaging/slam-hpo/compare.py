"""Compare samplers on the surrogate: regret after every trial, means over studies with 95 % intervals, as Markdown.

    python compare.py SYSTEM

A study minimises the noisy error on the `tune` sequences. Its regret is the error of the configuration that it has
found, without noise, over the best that any study found. The last column has the same on the `test` sequences: the
found configuration's error over the default's, where less than 0 is a gain. Both are geometric means, minus 1.
"""

import sys
import warnings
from collections.abc import Callable

import numpy as np
import optuna
from optuna.samplers import BaseSampler, CmaEsSampler, GPSampler, NSGAIISampler, RandomSampler, TPESampler
from slam_hpo.moth_flame_sampler import MothFlameSampler
from slam_hpo.problem import Problem

STUDIES, TRIALS = 30, 50
AT = (10, 25, 50)
SAMPLERS: dict[str, Callable[[int], BaseSampler]] = {
    "random": lambda seed: RandomSampler(seed=seed),
    "TPE": lambda seed: TPESampler(seed=seed),
    "GP": lambda seed: GPSampler(seed=seed),
    "CMA-ES": lambda seed: CmaEsSampler(seed=seed),
    "NSGA-II": lambda seed: NSGAIISampler(seed=seed, population_size=10),
    "moth-flame": lambda seed: MothFlameSampler(elite=False, seed=seed, n_trials=TRIALS),
    "EMFOA": lambda seed: MothFlameSampler(seed=seed, n_trials=TRIALS),
}


def incumbents(system: str, sampler: BaseSampler, seed: int) -> np.ndarray:
    """Noise-free values on both splits of the best trial so far, after every trial: ``[trials, 2]``."""
    noisy, true, test = Problem(system, noise=True, seed=seed), Problem(system), Problem(system, split="test")
    study = optuna.create_study(sampler=sampler)
    study.optimize(noisy, n_trials=TRIALS)
    rows: list[tuple[float, float]] = []
    best = np.inf
    for trial in study.trials:
        if trial.value is not None and trial.value < best:
            best = trial.value
            row = (float(true.evaluate(trial.params)), float(test.evaluate(trial.params)))
        rows.append(row)
    return np.array(rows)


def interval(values: np.ndarray) -> str:
    """Geometric mean of ratios, given as logarithms, minus 1 with its 95 % bootstrap interval, in percent."""
    draws = np.random.default_rng(0).choice(values, (2000, len(values))).mean(axis=1)
    mean, low, high = 100 * np.expm1([values.mean(), *np.percentile(draws, [2.5, 97.5])])
    return f"{mean:.1f} [{low:.1f}, {high:.1f}]"


def main(system: str) -> None:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
    found = {
        name: np.stack([incumbents(system, build(seed), seed) for seed in range(STUDIES)])
        for name, build in SAMPLERS.items()
    }
    best = min(rows[..., 0].min() for rows in found.values())
    lines = [["sampler", *(f"regret after {after}, %" for after in AT), "test error over the default's, %"]]
    for name, rows in found.items():
        lines.append([name, *(interval(rows[:, after - 1, 0] - best) for after in AT), interval(rows[:, -1, 1])])
    lines.insert(1, ["---"] * len(lines[0]))
    sys.stdout.write("".join(f"| {' | '.join(line)} |\n" for line in lines))


if __name__ == "__main__":
    main(sys.argv[1])
