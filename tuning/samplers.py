"""Samplers by name, each trial with a stream of its own."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any

import optuna
from optuna.distributions import BaseDistribution
from optuna.trial import FrozenTrial, TrialState

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.seeding import stream

from . import cmaes_state
from .emfoa_sampler import EmfoaSampler
from .study_file import StudySpec

CONSTRAINTS = "constraints"
"""User attribute of a trial: how far each constraint is violated; <= 0 is fulfilled."""
_STARTUP_TRIALS = 8


def build_sampler(spec: StudySpec) -> StreamedSampler:
    """The sampler of a study.

    Raises:
        StudyError: It needs a package that is not installed, or cannot do what the study asks for.
    """
    _build(spec, 0)  # what is missing shows now
    return StreamedSampler(lambda seed: _build(spec, seed), spec.sampler_seed)


class StreamedSampler(optuna.samplers.BaseSampler):
    """Makes a sampler anew for each trial, seeded by the study's seed and the trial's number.

    Numbers are given out by the storage, so no two workers, and no worker that goes on later, draw from one stream, and
    a study with one worker gives the same trials again.

    Args:
        build: Makes a sampler with a seed; what it knows of earlier trials it reads from the study.
        seed: Of the study.
    """

    def __init__(self, build: Callable[[int], optuna.samplers.BaseSampler], seed: int) -> None:
        self._build, self._seed = build, seed
        self._samplers: dict[int, optuna.samplers.BaseSampler] = {}

    def _of(self, trial: FrozenTrial) -> optuna.samplers.BaseSampler:
        if trial.number not in self._samplers:
            seed = int(stream(self._seed, "sampler", trial.number).integers(2**31))
            self._samplers[trial.number] = self._build(seed)
        return self._samplers[trial.number]

    def before_trial(self, study: optuna.Study, trial: FrozenTrial) -> None:
        """See Optuna."""
        self._of(trial).before_trial(study, trial)

    def infer_relative_search_space(self, study: optuna.Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        """See Optuna."""
        return self._of(trial).infer_relative_search_space(study, trial)

    def sample_relative(
        self, study: optuna.Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """See Optuna."""
        return self._of(trial).sample_relative(study, trial, search_space)

    def sample_independent(
        self, study: optuna.Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        """See Optuna."""
        return self._of(trial).sample_independent(study, trial, param_name, param_distribution)

    def after_trial(
        self, study: optuna.Study, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None
    ) -> None:
        """See Optuna."""
        self._of(trial).after_trial(study, trial, state, values)
        del self._samplers[trial.number]


def _build(spec: StudySpec, seed: int) -> optuna.samplers.BaseSampler:
    constrained = spec.min_coverage is not None or spec.min_fps is not None
    options: dict[str, Any] = {"seed": seed}
    if constrained and not hasattr(optuna.trial.Trial, "set_constraint"):
        options["constraints_func"] = violations  # Optuna < 5
    if spec.sampler == "random":
        return optuna.samplers.RandomSampler(seed=seed)
    if spec.sampler == "tpe":
        with warnings.catch_warnings():  # `group` (for conditional spaces) counts as experimental
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            return optuna.samplers.TPESampler(
                n_startup_trials=min(_STARTUP_TRIALS, spec.trials // 2),
                multivariate=True,
                group=True,
                constant_liar=True,
                **options,
            )
    if spec.sampler == "nsga2":
        return optuna.samplers.NSGAIISampler(population_size=max(8, spec.trials // 5), **options)
    if spec.sampler == "gp":
        return optuna.samplers.GPSampler(n_startup_trials=_STARTUP_TRIALS, **options)
    if len(spec.objectives) > 1:
        raise StudyError(
            f"sampler '{spec.sampler}' takes one objective, the study has {len(spec.objectives)}",
            "use tpe, nsga2, gp or random",
        )
    if spec.sampler == "cmaes":
        if find_spec("cmaes") is None:
            raise StudyError("sampler 'cmaes' needs a package that is not installed", "pip install cmaes")
        cmaes_state.restrict()
        return optuna.samplers.CmaEsSampler(seed=seed, n_startup_trials=_STARTUP_TRIALS)
    return EmfoaSampler(seed=seed, n_trials=spec.trials)


def violations(trial: FrozenTrial) -> Sequence[float]:
    """The constraint values that a finished trial carries, for samplers of Optuna before 5."""
    return [float(value) for value in trial.user_attrs.get(CONSTRAINTS, {}).values()]


def set_constraints(trial: optuna.trial.Trial, values: dict[str, float], *, final: bool) -> None:
    """Attach constraint values to a trial, in whichever way this Optuna knows; it takes only the `final` ones."""
    trial.set_user_attr(CONSTRAINTS, values)
    if final and hasattr(trial, "set_constraint"):
        for name, value in values.items():
            trial.set_constraint(name, value)


def is_feasible(trial: FrozenTrial) -> bool:
    """Whether a finished trial fulfils all constraints."""
    return all(value <= 0 for value in trial.user_attrs.get(CONSTRAINTS, {}).values())
