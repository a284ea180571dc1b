"""What whole studies say where nothing is better and where something is: simulated studies.

    python tests/benchmarks/study_null.py [--studies 60] [--table null planted regret]

Whole studies (trials and judgement) over runs from a noise model: `sd` is the spread of the log ratio
of two runs in one scene (measured 0.24 to 0.31), and beside it each setting differs from the baseline
by 0.15 in log from scene to scene. `null`: no setting is better than another. `planted`: the best
setting has 20 % less error than the baseline; beside it stands how often that setting itself is
proven, known without any trial, so that the rest is the search's own share. `regret`: the true log
ratio of the best trial to the optimum, beside that of fifteen lines of plain Optuna with the same
runs. A run is one of a configuration on one instance, counted once as the run store makes it.
Shares of `null` and `planted` stand beside their exact 95 % interval (Clopper and Pearson).
`verdict_errors.py` measures the verdicts alone, in more worlds.
"""

import math
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.trial import TrialState
from scipy import stats

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from command_line import parser_of
from helpers import simulated

from dynslam_bench.evaluation.verdicts import ComparisonVerdict, verdict_of
from dynslam_bench.tuning import distributions, finish
from dynslam_bench.tuning.objectives import compare

DESIGNS = ((6, 8), (6, 28), (8, 40))
"""Scenes to tune on and scenes that judge, one start each."""
SPREADS = (0.15, 0.28, 0.5)
PLANTED = 0.2


def study_on(tuned: int, judging: int, **changes: object) -> Any:
    """A simulated study on so many scenes, one start each."""
    tune = [f"synthetic/walking_xyz?scene=0-{tuned - 1}&frames=20&offsets=0"]
    held_out = [f"synthetic/walking_xyz?scene=100-{99 + judging}&frames=20&offsets=0"]
    return simulated.make_spec(tune=tune, held_out=held_out, **changes)


def line(*cells: object) -> str:
    """A row of a table."""
    return f"| {' | '.join(map(str, cells))} |"


def share(count: int, studies: int) -> str:
    """How many of so many studies, in percent, with the exact 95 % interval of their share."""
    interval = stats.binomtest(count, studies).proportion_ci(method="exact")
    percent = 100 * count / studies
    return f"{percent:.1f} [{100 * interval.low:.1f}, {100 * interval.high:.1f}]"


def null(studies: int, folder: Path) -> Iterable[str]:
    """Shares of verdicts in studies in which nothing is better than the baseline."""
    verdicts = [verdict.value for verdict in ComparisonVerdict]
    lucky = "the best trial promises a gain of 5 %, %"
    yield line(
        "scenes to tune on, to judge", "sd", lucky, *(f"*{verdict}*, %" for verdict in verdicts)
    )
    total = Counter[str]()
    for tuned, judging in DESIGNS:
        for simulated.STARTS_SD in SPREADS:
            counts = Counter[str]()
            for seed in range(studies):
                tuner = simulated.SimulatedTuner(
                    study_on(tuned, judging, sampler_seed=seed, sampler="tpe"),
                    folder / f"null-{judging}-{simulated.STARTS_SD}-{seed}",
                    seed=seed,
                )
                counts["lucky"] += tuner.run().study.best_value < math.log(0.95)
                counts[finish(tuner).verdict.value] += 1
            shares = [share(counts[name], studies) for name in ("lucky", *verdicts)]
            yield line(f"{tuned}, {judging}", simulated.STARTS_SD, *shares)
            total += counts
    together = len(DESIGNS) * len(SPREADS) * studies
    yield line("all", "all", *(share(total[name], together) for name in ("lucky", *verdicts)))


def planted(settings: Mapping[str, Any]) -> float:
    """The best gain has `PLANTED` less error than the default of 1.5, a third of the range (0.2 to 3) away."""
    away = math.log(1.5 / settings.get("gain", 1.5)) / (math.log(3 / 0.2) / 3)
    return -math.log(1 - PLANTED) * min(2.0, (1 - away) ** 2)


def recovered(studies: int, folder: Path) -> Iterable[str]:
    """Counts of studies with a setting better than the baseline: how many find it, how many prove it."""
    loss = planted({})
    optimum = {"gain": 1.5 * (0.2 / 3) ** (1 / 3)}
    yield line(
        "scenes to tune on, to judge",
        "sd",
        "share of the gain in the best trial, %",
        "*proven*, %",
        "*promising*, %",
        "the best setting itself *proven*, %",
    )
    for tuned, judging in DESIGNS:
        for simulated.STARTS_SD in SPREADS:
            counts = Counter[str]()
            gains = []
            for seed in range(studies):
                tuner = simulated.SimulatedTuner(
                    study_on(tuned, judging, sampler_seed=seed, sampler="tpe", trials=16),
                    folder / f"planted-{judging}-{simulated.STARTS_SD}-{seed}",
                    effect=planted,
                    seed=seed,
                )
                summary = finish(tuner.run())
                gains.append(1 - planted(summary.best.params) / loss)
                counts[summary.verdict] += 1
                held_out = tuner.design.held_out
                known = compare(tuner.outcomes(optimum, held_out), tuner.outcomes({}, held_out))
                counts["known"] += verdict_of(known) is ComparisonVerdict.PROVEN
            names = (ComparisonVerdict.PROVEN, ComparisonVerdict.PROMISING, "known")
            shares = [share(counts[name], studies) for name in names]
            gain = f"{100 * np.mean(gains):.0f}"
            yield line(f"{tuned}, {judging}", simulated.STARTS_SD, gain, *shares)


def regret(studies: int, folder: Path) -> Iterable[str]:
    """Regret of a study with each pruner, beside plain Optuna's on as many runs, and how many trials each made."""

    simulated.STARTS_SD = 0.28
    yield line(
        "pruner",
        "runs",
        "regret",
        "trials",
        *(("plain Optuna, `WilcoxonPruner`", "trials", "plain Optuna, no pruner", "trials")),
    )
    for pruner in ("none", "halving", "wilcoxon"):
        runs = []
        ours = []
        others = {optuna.pruners.WilcoxonPruner: [], optuna.pruners.NopPruner: []}
        for seed in range(studies):
            tuner = simulated.SimulatedTuner(
                study_on(8, 8, pruner=pruner, trials=24, sampler="tpe", sampler_seed=seed),
                folder / f"{pruner}-{seed}",
                effect=simulated.valley,
                seed=seed,
            )
            trials = tuner.run().study.get_trials(deepcopy=False)
            # the baseline's too, as in `plain`
            runs.append(sum(len(trial.user_attrs["instances"]) for trial in trials))
            ours.append((simulated.valley(finish(tuner).best.params), len(trials)))
            for kind, found in others.items():
                found.append(plain(tuner, seed, runs[-1], kind()))
        yield line(
            f"`{pruner}`",
            round(np.mean(runs)),
            *[cell for found in (ours, *others.values()) for cell in summed(found)],
        )


def summed(found: Sequence[tuple[float, int]]) -> tuple[str, int]:
    """Mean regret with its standard error, and mean number of trials."""
    regrets, trials = zip(*found, strict=True)
    return (
        f"{np.mean(regrets):.3f} ± {np.std(regrets, ddof=1) / math.sqrt(len(regrets)):.3f}",
        round(np.mean(trials)),
    )


def plain(tuner: Any, seed: int, most: int, pruner: optuna.pruners.BasePruner) -> tuple[float, int]:
    """Regret of the best trial, and how many there were: Optuna as its manual has it."""

    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed), pruner=pruner)
    study.enqueue_trial({parameter.name: tuner.base[parameter.name] for parameter in tuner.space})
    order = np.random.default_rng(seed)
    runs = 0
    while runs + len(tuner.design.tune) <= most:
        trial = study.ask(distributions(tuner.space))
        logs = []
        state = TrialState.COMPLETE
        for index in order.permutation(len(tuner.design.tune)):
            (run,) = tuner.outcomes(trial.params, [tuner.design.tune[index]]).values()
            logs.append(math.log(run.ate_m))
            trial.report(logs[-1], int(index))
            if trial.should_prune():
                state = TrialState.PRUNED
                break
        study.tell(
            trial, float(np.mean(logs)) if state == TrialState.COMPLETE else None, state=state
        )
        runs += len(logs)
    complete = study.get_trials(states=(TrialState.COMPLETE,))
    best = min((trial for trial in complete if trial.number), key=lambda trial: trial.value)
    return simulated.valley(best.params), len(study.trials)


TABLES = {"null": null, "planted": recovered, "regret": regret}


def main() -> None:
    """Print the tables."""
    parser = parser_of(__doc__, studies=60)
    parser.add_argument("--table", nargs="+", choices=TABLES, default=list(TABLES))
    options = parser.parse_args()
    warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
    with tempfile.TemporaryDirectory() as temporary:
        for name in options.table:
            print(f"`{name}`: {options.studies} studies a line.\n")
            for number, text in enumerate(TABLES[name](options.studies, Path(temporary))):
                print(text, flush=True)
                if number == 0:
                    print("| --- " * (text.count("|") - 1) + "|")
            print()


if __name__ == "__main__":
    main()
