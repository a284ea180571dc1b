"""What studies say where nothing is better and where something is: simulated studies.

    python tests/benchmarks/study_null.py [--studies 100] [--table null choice planted regret]

Whole studies (trials, choice, held-out check) over runs from a noise model: `sd` is the spread of
the log ratio of two runs in one scene (measured 0.24 to 0.31), and beside it each setting differs
from the baseline by 0.15 in log from scene to scene. `null`: no setting is better than another.
`choice`: the same without a search, which takes no part in the choice: two such settings on the
scenes of the choice. `planted`: the best setting has 30 % less error than the baseline, and a study
has at most 40 trial runs. Beside it stands how often the best setting itself is proven, known
without any trial: by the study's rule, and by the best possible rule with as few false claims (a
z-test of known variance over all scenes that no trial saw). Studies that are not proven are
extended once by six scenes. `regret`: the true log ratio of the best trial to the optimum, beside
that of fifteen lines of plain Optuna with the same runs and the same bound at the end. A run is one
of a configuration on one instance, counted once as the run store makes it.
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

from dynslam_bench.tuning import Verdict, distributions, finish
from dynslam_bench.tuning.judgement import compared
from dynslam_bench.tuning.study_file import scenes

SCENES = (6, 11, 12, 24)
SPREADS = (0.15, 0.5)
PLANTED = 0.3
MOST_RUNS = 40


def study_on(scenes: int, offsets: str = "0-1", **changes: object) -> Any:
    """A simulated study on so many scenes."""
    return simulated.make_spec(
        tune=[f"synthetic/walking_xyz?scene=0-{scenes - 1}&frames=20&offsets={offsets}"], **changes
    )


def line(*cells: object) -> str:
    return (
        "| "
        + " | ".join(
            f"{100 * cell:.0f} %" if isinstance(cell, float) else str(cell) for cell in cells
        )
        + " |"
    )


def null(studies: int, folder: Path) -> Iterable[str]:
    """Of so many studies in which nothing is better, the shares that say what."""

    verdicts = [verdict.value for verdict in Verdict if verdict != Verdict.NOT_JUDGED]
    yield line(
        "scenes",
        "sd",
        "the best trial promises 5 %",
        "chosen",
        *(f"*{verdict}*" for verdict in verdicts),
    )
    for count in SCENES:
        for simulated.STARTS_SD in SPREADS:
            counts = Counter[str]()
            for seed in range(count * 1000 + int(100 * simulated.STARTS_SD) * 100000, 10**9)[
                :studies
            ]:
                tuner = simulated.SimulatedTuner(
                    study_on(count, sampler_seed=seed, sampler="tpe"),
                    folder / f"{count}-{simulated.STARTS_SD}-{seed}",
                    seed=seed,
                )
                counts["lucky"] += tuner.run().study.best_value < math.log(0.95)
                summary = finish(tuner)
                counts["chosen"] += summary.best is not None and summary.best.chosen
                counts[summary.verdict.value] += 1
            yield line(
                count,
                str(simulated.STARTS_SD),
                *[counts[name] / studies for name in ("lucky", "chosen", *verdicts)],
            )


def choice(studies: int, folder: Path) -> Iterable[str]:
    """Of so many choices among two settings that are no better, the share where one is chosen."""

    tuner = simulated.SimulatedTuner(study_on(6), folder / "choice")
    confirm = tuner.design.confirm
    yield line("scenes of the choice", "sd", "chosen")
    for simulated.STARTS_SD in SPREADS:
        chosen = 0
        for tuner.noise_seed in range(studies):
            baseline, *candidates = (
                tuner.outcomes({"gain": gain}, confirm) for gain in (1.5, 1.0, 2.0)
            )
            chosen += any(compared(one, baseline, candidates=2).bound < 1 for one in candidates)
        yield line(len(confirm) // 2, str(simulated.STARTS_SD), f"{100 * chosen / studies:.1f} %")


def planted(settings: Mapping[str, Any]) -> float:
    """The best gain has 30 % less error than the default of 1.5, and lies a third of the range (0.2 to 3) away."""
    away = math.log(1.5 / settings.get("gain", 1.5)) / (math.log(3 / 0.2) / 3)
    return -math.log(1 - PLANTED) * min(2.0, (1 - away) ** 2)


def recovered(studies: int, folder: Path) -> Iterable[str]:
    """Of so many studies in which a setting has 30 % less error than the baseline, how many find and prove it."""

    loss = planted({})
    optimum = {"gain": 1.5 * (0.2 / 3) ** (1 / 3)}
    yield line(
        "sd", "share of the gain in `best.toml`", "chosen", "*proven*", "*promising*", "*proven* after six more scenes",
        "*does not matter here*", "known setting, this rule", "known setting, best test",
    )  # fmt: skip
    for simulated.STARTS_SD in (0.15, 0.28, 0.5):
        counts = Counter[str]()
        gains = []
        for seed in range(studies):
            spec = study_on(6, "0", sampler_seed=seed, sampler="tpe", trials=14)
            name = f"planted-{simulated.STARTS_SD}-{seed}"
            tuner = simulated.SimulatedTuner(spec, folder / name, effect=planted, seed=seed)
            tuner.reference()
            first = tuner.runs
            while tuner.runs - first + len(tuner.design.tune) <= MOST_RUNS:
                trial = tuner.ask()
                tuner.tell(trial, tuner.evaluate(trial))
            summary = finish(tuner)
            design = tuner.design
            gains.append(1 - planted(summary.best.params) / loss)
            counts[summary.verdict] += 1
            counts["chosen"] += summary.best.chosen
            known = [
                compared(tuner.outcomes(optimum, split), tuner.outcomes({}, split))
                for split in (design.confirm, design.held_out)
            ]
            counts["known"] += known[0].bound < 1 and known[1].shows_gain
            if summary.verdict != Verdict.PROVEN:
                tuner.extend(scenes=6)
                summary = finish(tuner)
            counts["extended"] += summary.verdict == Verdict.PROVEN
        names = (
            "chosen",
            Verdict.PROVEN,
            Verdict.PROMISING,
            "extended",
            Verdict.NO_MATTER,
            "known",
        )
        yield line(
            str(simulated.STARTS_SD),
            float(np.mean(gains)),
            *[counts[name] / studies for name in names],
            best_power(design, loss),
        )


def best_power(design: Any, gain: float) -> float:
    """How often a z-test of known variances tells a gain from nothing, with a false claim in 1600 (2.5 % x 2.5 %)."""

    information = 0.0
    for split in (design.confirm, design.held_out):
        groups = scenes(split)
        starts = stats.norm.rvs(size=(20_000, len(split) // len(groups)), random_state=0)
        start_variance = np.median(starts, axis=1).var() * simulated.STARTS_SD**2
        information += len(groups) / (start_variance + simulated.SCENES_SD**2)
    return float(stats.norm.sf(stats.norm.isf(0.025 * 0.025) - gain * math.sqrt(information)))


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
                study_on(8, pruner=pruner, trials=24, sampler="tpe", sampler_seed=seed),
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
    """Regret of the best of two trials by the same bound, and how many there were: Optuna as its manual has it."""

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
    best = sorted((trial for trial in complete if trial.number), key=lambda trial: trial.value)[:2]
    baseline = tuner.outcomes({}, tuner.design.confirm)

    def bound(trial: optuna.trial.FrozenTrial) -> float:
        return compared(
            tuner.outcomes(trial.params, tuner.design.confirm), baseline, candidates=2
        ).bound

    return simulated.valley(min(best, key=bound).params), len(study.trials)


TABLES = {"null": null, "choice": choice, "planted": recovered, "regret": regret}


def main() -> None:
    """Print the tables."""
    parser = parser_of(__doc__, studies=100)
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
