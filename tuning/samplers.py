"""Samplers and pruners by name.

Each trial draws from a stream of its own, and all trials meet the same growing sets of instances, on which Optuna's
pruners end the worse ones early: asynchronous successive halving (Li et al. 2020) or Wilcoxon's signed-rank test
against the best trial. Optuna prunes no trials of several objectives.
"""

import warnings
from collections.abc import Callable
from typing import Any

import optuna
from optuna.distributions import BaseDistribution
from optuna.trial import FrozenTrial

from dynslam_bench.core.seeding import stream
from dynslam_bench.tuning.study_file import PrunerName, SamplerName, StudySpec

_STARTUP_TRIALS = 8


class StreamedSampler(optuna.samplers.BaseSampler):
    """Makes a sampler for each trial, seeded by the study's seed and the trial's number.

    Numbers are given out by the storage, so no two workers, and no worker that goes on later, draw from one stream, and
    a study with one worker gives the same trials again. `Study.ask` draws all settings of a trial before the next.

    Args:
        spec: The study; what a sampler knows of earlier trials it reads from Optuna's study.
    """

    def __init__(self, spec: StudySpec) -> None:
        self._spec = spec

    def before_trial(self, study: optuna.Study, trial: FrozenTrial) -> None:
        """Make the trial's sampler."""
        seed = int(stream(self._spec.sampler_seed, "sampler", trial.number).integers(2**31))
        with warnings.catch_warnings():  # TPE's `constant_liar` counts as experimental
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            self._sampler = _SAMPLERS[self._spec.sampler](self._spec, seed)
        self._sampler.before_trial(study, trial)

    def infer_relative_search_space(self, study: optuna.Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        """See Optuna."""
        return self._sampler.infer_relative_search_space(study, trial)

    def sample_relative(
        self, study: optuna.Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """See Optuna."""
        return self._sampler.sample_relative(study, trial, search_space)

    def sample_independent(
        self, study: optuna.Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        """See Optuna."""
        return self._sampler.sample_independent(study, trial, param_name, param_distribution)


_SAMPLERS: dict[SamplerName, Callable[[StudySpec, int], optuna.samplers.BaseSampler]] = {
    "random": lambda spec, seed: optuna.samplers.RandomSampler(seed=seed),
    "tpe": lambda spec, seed: optuna.samplers.TPESampler(
        n_startup_trials=min(_STARTUP_TRIALS, spec.trials // 2), constant_liar=True, seed=seed
    ),
    "nsga2": lambda spec, seed: optuna.samplers.NSGAIISampler(population_size=max(8, spec.trials // 5), seed=seed),
    "gp": lambda spec, seed: optuna.samplers.GPSampler(n_startup_trials=_STARTUP_TRIALS, seed=seed),
}


def is_feasible(trial: FrozenTrial) -> bool:
    """Whether a trial fulfils all constraints."""
    return all(value <= 0 for value in trial.constraints.values())


FIRST_STEP = 3
"""Instances that every trial runs on before it may be pruned."""
WILCOXON_LEVEL = 0.1


_PRUNERS: dict[PrunerName, Callable[[], optuna.pruners.BasePruner]] = {
    "halving": lambda: optuna.pruners.SuccessiveHalvingPruner(min_resource=FIRST_STEP, reduction_factor=2),
    "wilcoxon": lambda: optuna.pruners.WilcoxonPruner(p_threshold=WILCOXON_LEVEL, n_startup_steps=FIRST_STEP),
    "none": optuna.pruners.NopPruner,
}


def build_pruner(name: PrunerName) -> optuna.pruners.BasePruner:
    """Optuna's pruner of that name."""
    with warnings.catch_warnings():  # the Wilcoxon pruner counts as experimental
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        return _PRUNERS[name]()
