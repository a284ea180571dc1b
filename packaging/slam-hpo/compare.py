"""Compare samplers and pruners on the surrogate: regret over the budget, means over studies with 95 % intervals.

    python compare.py SYSTEM [CURVES.html]

prints a Markdown table, and draws the regret over the whole budget if a file is named. A study
minimises the noisy error on the `tune` sequences with a budget of frames, counted in trials of full
length; pruned trials are shorter. Its regret is the error of the configuration that it has found,
without noise, over the best that any study found. Then follow its error over that of the random
search with the same seed, and its error on the `test` sequences over the default's; less than 0 is
a gain. All are geometric means, minus 1; intervals are those of the seeds alone.
"""

import sys
import warnings
from collections.abc import Callable

import numpy as np
import optuna
from optuna.pruners import BasePruner, HyperbandPruner, MedianPruner, NopPruner
from optuna.samplers import (
    BaseSampler,
    CmaEsSampler,
    GPSampler,
    NSGAIISampler,
    RandomSampler,
    TPESampler,
)
from slam_hpo import FRAMES
from slam_hpo.moth_flame_sampler import MothFlameSampler
from slam_hpo.problem import Problem

STUDIES = 30
TRIALS = 50
AT = (10, 25, 50)
FULL = max(FRAMES)
SAMPLERS: dict[str, Callable[[int], BaseSampler]] = {
    "random": lambda seed: RandomSampler(seed=seed),
    "TPE": lambda seed: TPESampler(seed=seed),
    "GP": lambda seed: GPSampler(seed=seed),
    "CMA-ES": lambda seed: CmaEsSampler(seed=seed),
    "NSGA-II": lambda seed: NSGAIISampler(seed=seed, population_size=10),
    "moth-flame": lambda seed: MothFlameSampler(elite=False, seed=seed, n_trials=TRIALS),
    "EMFOA": lambda seed: MothFlameSampler(seed=seed, n_trials=TRIALS),
}
ARMS: dict[str, tuple[Callable[[int], BaseSampler], BasePruner]] = {
    **{name: (build, NopPruner()) for name, build in SAMPLERS.items()},
    "TPE, median pruner": (SAMPLERS["TPE"], MedianPruner()),
    "TPE, Hyperband": (SAMPLERS["TPE"], HyperbandPruner(min(FRAMES), FULL)),
}


def incumbents(system: str, sampler: BaseSampler, pruner: BasePruner, seed: int) -> np.ndarray:
    """Noise-free values on both splits of the best full trial, by the budget spent so far: ``[TRIALS, 2]``.

    Before the first full trial it is the default configuration, whose values are 0.
    """
    rungs = FRAMES[-1:] if isinstance(pruner, NopPruner) else FRAMES
    noisy = {frames: Problem(system, frames=frames, noise=True, seed=seed) for frames in rungs}
    true = Problem(system)
    test = Problem(system, split="test")
    study = optuna.create_study(sampler=sampler, pruner=pruner)
    rows = np.zeros((TRIALS, 2))
    best = np.inf
    spent = 0
    while spent < TRIALS * FULL:
        trial = study.ask(true.search_space)
        start = spent
        for frames, problem in noisy.items():
            value = float(problem.evaluate(trial.params))
            spent = start + frames
            trial.report(value, frames)
            if frames < FULL and trial.should_prune():
                study.tell(trial, state=optuna.trial.TrialState.PRUNED)
                break
        else:
            study.tell(trial, value)
            if value < best and spent <= TRIALS * FULL:
                best = value
                rows[-(-spent // FULL) - 1 :] = (
                    true.evaluate(trial.params),
                    test.evaluate(trial.params),
                )
    return rows


def mean_interval(values: np.ndarray) -> np.ndarray:
    """Geometric mean of ratios ``[studies, ...]``, given as logarithms, minus 1 and its 95 % bootstrap interval, %."""
    draws = values[np.random.default_rng(0).integers(len(values), size=(2000, len(values)))].mean(
        axis=1
    )
    return np.asarray(
        100 * np.expm1([values.mean(axis=0), *np.percentile(draws, [2.5, 97.5], axis=0)])
    )


def cell(values: np.ndarray) -> str:
    """The mean and its interval as text."""
    mean, low, high = mean_interval(values)
    return f"{mean:.1f} [{low:.1f}, {high:.1f}]"


def draw(regret: dict[str, np.ndarray], path: str) -> None:
    """Draw the mean regret of every arm over the budget, with its interval, as a page."""
    import plotly.graph_objects as go
    from plotly.colors import qualitative

    figure = go.Figure()
    x = np.arange(1, TRIALS + 1)
    for colour, (name, values) in zip(qualitative.Safe, regret.items(), strict=False):
        mean, low, high = mean_interval(values)
        band = dict(legendgroup=name, line_color=colour, mode="lines")
        figure.add_scatter(
            x=[*x, *x[::-1]],
            y=[*high, *low[::-1]],
            fill="toself",
            opacity=0.25,
            **band,
            showlegend=False,
        )
        figure.add_scatter(x=x, y=mean, name=name, **band)
    figure.update_layout(
        xaxis_title="budget in full trials", yaxis_title="regret, %", yaxis_type="log"
    )
    figure.write_html(path)


def main(system: str, curves: str | None = None) -> None:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    warnings.simplefilter("ignore")  # experimental samplers; CMA-ES has no use for the constraint
    found = {
        name: np.stack([incumbents(system, build(seed), pruner, seed) for seed in range(STUDIES)])
        for name, (build, pruner) in ARMS.items()
    }
    best = min(rows[..., 0].min() for rows in found.values())
    regret = {name: rows[..., 0] - best for name, rows in found.items()}
    lines = [
        [
            "sampler",
            *(f"regret after {after}, %" for after in AT),
            "over random's, %",
            "test over default's, %",
        ]
    ]
    for name, rows in found.items():
        regrets = [cell(regret[name][:, after - 1]) for after in AT]
        lines.append(
            [name, *regrets, cell(rows[:, -1, 0] - found["random"][:, -1, 0]), cell(rows[:, -1, 1])]
        )
    lines.insert(1, ["---"] * len(lines[0]))
    sys.stdout.write("".join(f"| {' | '.join(line)} |\n" for line in lines))
    if curves:
        draw(regret, curves)


if __name__ == "__main__":
    main(*sys.argv[1:])
