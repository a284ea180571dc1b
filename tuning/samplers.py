"""Samplers and pruners by name."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

import optuna

from dynslam_bench.core.errors import StudyError

from . import cmaes_state
from .emfoa_sampler import EmfoaSampler
from .study_file import StudySpec

CONSTRAINTS = "constraints"
"""User attribute of a trial: how far each constraint is violated; <= 0 is fulfilled."""
_STARTUP_TRIALS = 8


def build_sampler(spec: StudySpec) -> optuna.samplers.BaseSampler:
    """The sampler of a study.

    Raises:
        StudyError: It needs a package that is not installed, or cannot do what the study asks for.
    """
    constrained = spec.min_coverage is not None or spec.min_fps is not None
    options: dict[str, Any] = {"seed": spec.sampler_seed}
    if constrained and not hasattr(optuna.trial.Trial, "set_constraint"):
        options["constraints_func"] = violations  # Optuna < 5
    if spec.sampler == "random":
        return optuna.samplers.RandomSampler(seed=spec.sampler_seed)
    if spec.sampler == "tpe":
        with warnings.catch_warnings():  # `group` (for conditional spaces) counts as experimental
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            return optuna.samplers.TPESampler(
                n_startup_trials=min(_STARTUP_TRIALS, spec.trials // 2), multivariate=True, group=True,
                constant_liar=True, **options,
            )  # fmt: skip
    if spec.sampler == "nsga2":
        return optuna.samplers.NSGAIISampler(population_size=max(8, spec.trials // 5), **options)
    if spec.sampler == "gp":
        return optuna.samplers.GPSampler(n_startup_trials=_STARTUP_TRIALS, **options)
    if len(spec.objectives) > 1:
        raise StudyError(f"sampler '{spec.sampler}' takes one objective, the study has {len(spec.objectives)}",
                         "use tpe, nsga2, gp or random")  # fmt: skip
    if spec.sampler == "cmaes":
        if find_spec("cmaes") is None:
            raise StudyError("sampler 'cmaes' needs a package that is not installed", "pip install cmaes")
        cmaes_state.restrict()
        return optuna.samplers.CmaEsSampler(seed=spec.sampler_seed, n_startup_trials=_STARTUP_TRIALS)
    return EmfoaSampler(seed=spec.sampler_seed, n_trials=spec.trials)


def build_pruner(spec: StudySpec) -> optuna.pruners.BasePruner:
    """The pruner of a study; several objectives have none of Optuna's."""
    if spec.pruner == "none" or len(spec.objectives) > 1:
        return optuna.pruners.NopPruner()
    if spec.pruner == "median":
        return optuna.pruners.MedianPruner(n_startup_trials=5, n_warmup_steps=1)
    if spec.pruner == "hyperband":
        return optuna.pruners.HyperbandPruner(min_resource=1, max_resource=len(spec.tune) * len(spec.seeds))
    return optuna.pruners.WilcoxonPruner(p_threshold=0.1, n_startup_steps=2)


def violations(trial: optuna.trial.FrozenTrial) -> Sequence[float]:
    """The constraint values that a finished trial carries, for samplers of Optuna before 5."""
    return [float(value) for value in trial.user_attrs.get(CONSTRAINTS, {}).values()]


def set_constraints(trial: optuna.trial.Trial, values: dict[str, float]) -> None:
    """Attach constraint values to a trial, in whichever way this Optuna knows."""
    trial.set_user_attr(CONSTRAINTS, values)
    if hasattr(trial, "set_constraint"):
        for name, value in values.items():
            trial.set_constraint(name, value)


def is_feasible(trial: optuna.trial.FrozenTrial) -> bool:
    """Whether a finished trial fulfils all constraints."""
    return all(value <= 0 for value in trial.user_attrs.get(CONSTRAINTS, {}).values())
