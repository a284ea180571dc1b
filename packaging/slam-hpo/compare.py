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
"""Studies of each arm, one a seed."""
TRIALS = 50
"""Budget of a study, in trials of full length."""
AT = (10, 25, 50)
"""Budgets at which the table has the regret."""
FULL = max(FRAMES)
"""Frames of a trial of full length."""
SAMPLERS: dict[str, Callable[[int], BaseSampler]] = {
    "random": lambda seed: RandomSampler(seed=seed),
    "TPE": lambda seed: TPESampler(seed=seed),
    "GP": lambda seed: GPSampler(seed=seed),
    "CMA-ES": lambda seed: CmaEsSampler(seed=seed),
    "NSGA-II": lambda seed: NSGAIISampler(seed=seed, population_size=10),
    "moth-flame": lambda seed: MothFlameSampler(elite=False, seed=seed, n_trials=TRIALS),
    "EMFOA": lambda seed: MothFlameSampler(seed=seed, n_trials=TRIALS),
}
# What is compared: samplers without a pruner, and pruners with one sampler.
ARMS: dict[str, tuple[Callable[[int], BaseSampler], BasePruner]] = {
    **{name: (build, NopPruner()) for name, build in SAMPLERS.items()},
    "TPE, median pruner": (SAMPLERS["TPE"], MedianPruner()),
    "TPE, Hyperband": (SAMPLERS["TPE"], HyperbandPruner(min(FRAMES), FULL)),
}


def incumbents(system: str, sampler: BaseSampler, pruner: BasePruner, seed: int) -> np.ndarray:
    """Noise-free values on both splits of the best full trial, by the budget spent so far: ``[TRIALS, 2]``.

    Before the first full trial it is the default configuration, whose values are 0.
    """
    # noisy values on growing numbers of frames for the study; values without noise for the regret
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
        # longer and longer runs, a run being the beginning of the next, until pruned
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
                budget = -(-spent // FULL)  # in full trials, rounded up
                rows[budget - 1 :] = true.evaluate(trial.params), test.evaluate(trial.params)
    return rows


def mean_interval(values: np.ndarray) -> np.ndarray:
    """Geometric mean of ratios ``[studies, ...]``, given as logarithms, minus 1 and its 95 % bootstrap interval, %."""
    # 2000 draws of as many studies, with replacement
    drawn = np.random.default_rng(0).integers(len(values), size=(2000, len(values)))
    means = values[drawn].mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5], axis=0)
    return np.asarray(100 * np.expm1([values.mean(axis=0), low, high]))


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
    # [studies, TRIALS, 2] by arm: logarithms of errors over the default's, on both splits
    values = {
        name: np.stack([incumbents(system, build(seed), pruner, seed) for seed in range(STUDIES)])
        for name, (build, pruner) in ARMS.items()
    }
    best = min(rows[..., 0].min() for rows in values.values())
    regret = {name: rows[..., 0] - best for name, rows in values.items()}

    headings = [f"regret after {after}, %" for after in AT]
    lines = [["sampler", *headings, "over random's, %", "test over default's, %"]]
    lines.append(["---"] * len(lines[0]))
    random = values["random"]
    for name, rows in values.items():
        regrets = [cell(regret[name][:, after - 1]) for after in AT]
        over_random = cell(rows[:, -1, 0] - random[:, -1, 0])
        lines.append([name, *regrets, over_random, cell(rows[:, -1, 1])])
    sys.stdout.write("".join(f"| {' | '.join(line)} |\n" for line in lines))
    if curves:
        draw(regret, curves)


if __name__ == "__main__":
    main(*sys.argv[1:])
