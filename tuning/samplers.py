"""Samplers and pruners by name.

Each trial draws from a stream of its own, and all trials meet the same growing sets of instances, on which Optuna's
pruners end the worse ones early: asynchronous successive halving (Li et al. 2020) or Wilcoxon's signed-rank test
against the best trial. Optuna prunes no trials of several objectives.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import optuna
from numpy.typing import NDArray
from optuna._transform import _SearchSpaceTransform
from optuna.distributions import BaseDistribution
from optuna.search_space import IntersectionSearchSpace
from optuna.study import Study, StudyDirection
from optuna.trial import FrozenTrial, TrialState

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.seeding import stream
from dynslam_bench.flow.moth_flame import EMFOA, flames_left, flight, moth_positions, opposites
from dynslam_bench.tuning.study_file import PrunerName, SamplerName, StudySpec

_STARTUP_TRIALS = 8


def build_sampler(spec: StudySpec) -> StreamedSampler:
    """The sampler of a study.

    Raises:
        StudyError: It needs a package that is not installed, or cannot do what the study asks for.
    """
    _build(spec, 0)  # what is missing shows now
    return StreamedSampler(lambda seed: _build(spec, seed), spec.sampler_seed)


class StreamedSampler(optuna.samplers.BaseSampler):
    """Makes a sampler for each trial, seeded by the study's seed and the trial's number.

    Numbers are given out by the storage, so no two workers, and no worker that goes on later, draw from one stream, and
    a study with one worker gives the same trials again. `Study.ask` draws all settings of a trial before the next.

    Args:
        build: Makes a sampler with a seed; what it knows of earlier trials it reads from the study.
        seed: Of the study.
    """

    def __init__(self, build: Callable[[int], optuna.samplers.BaseSampler], seed: int) -> None:
        self._build, self._seed = build, seed

    def before_trial(self, study: optuna.Study, trial: FrozenTrial) -> None:
        """Make the trial's sampler."""
        self._sampler = self._build(int(stream(self._seed, "sampler", trial.number).integers(2**31)))
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
    "emfoa": lambda spec, seed: EmfoaSampler(seed=seed, n_trials=spec.trials),
}


def _build(spec: StudySpec, seed: int) -> optuna.samplers.BaseSampler:
    if spec.sampler == "emfoa" and len(spec.objectives) > 1:
        raise StudyError("sampler 'emfoa' takes one objective", "use tpe, nsga2, gp or random")
    with warnings.catch_warnings():  # TPE's `constant_liar` counts as experimental
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        return _SAMPLERS[spec.sampler](spec, seed)


def is_feasible(trial: FrozenTrial) -> bool:
    """Whether a trial fulfils all constraints."""
    return all(value <= 0 for value in trial.constraints.values())


# The elite moth-flame algorithm as an Optuna sampler: one trial is one flight of one moth.

Array = NDArray[np.float64]
CAUCHY_SHARE = 0.05
"""Scale of the Cauchy steps of Eq. 13, as a share of the unit interval."""


class EmfoaSampler(optuna.samplers.BaseSampler):
    """Moth-flame optimisation with elite opposition, Cauchy steps and the pull of the best flame (Eq. 8-22).

    The best finished trials are the flames. The first population is drawn uniformly, its second half as elite opposites
    of the first (Eq. 19-22); from then on trial number n is the flight of moth n mod N: a logarithmic spiral from its
    last position around its flame (Eq. 8-10), with a Cauchy step in the first half of the budget (Eq. 13-16) and the
    pull of the best flame in the second (Eq. 17-18). The number of flames falls over the budget (Eq. 11).

    Moths move in the unit cube: a number in its (linear or logarithmic) range, a category by its one-hot code. Pruned
    trials count as finished, and as worse than all complete ones.

    Args:
        seed: Of the random numbers.
        n_trials: The budget over which flames are reduced; later trials stay in the last phase.
        population: Moths (and flames).
    """

    def __init__(self, *, seed: int | None = None, n_trials: int = 100, population: int = 8) -> None:
        if n_trials < 1 or population < 2:
            raise ValueError(f"n_trials must be >= 1 and population >= 2, got {n_trials=}, {population=}")
        self._rng = np.random.default_rng(seed)
        self._independent = optuna.samplers.RandomSampler(seed=seed)
        self._n_trials = n_trials
        self._population = population
        self._space = IntersectionSearchSpace(include_pruned=True)

    def reseed_rng(self) -> None:
        """Draw a new seed, for parallel workers."""
        self._rng = np.random.default_rng()
        self._independent.reseed_rng()

    def infer_relative_search_space(self, study: Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        """The parameters that all finished trials share."""
        shared = self._space.calculate(study).items()
        return {name: distribution for name, distribution in shared if not distribution.single()}

    def sample_relative(
        self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """One flight of one moth."""
        if len(study.directions) > 1:
            raise ValueError("EmfoaSampler takes one objective")
        if not search_space:
            return {}
        cube = _SearchSpaceTransform(search_space, transform_0_1=True)
        sign = -1.0 if study.direction == StudyDirection.MAXIMIZE else 1.0
        trials = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED))
        finished = [one for one in trials if one.value is not None and search_space.keys() <= one.params.keys()]
        units = [cube.transform({name: one.params[name] for name in search_space}) for one in finished]
        moths = np.array(units).reshape(-1, len(cube.bounds))
        if len(moths) < self._population:
            return cube.untransform(self._first_population(moths))
        ranks = [(one.state == TrialState.PRUNED, sign * float(one.value or 0.0)) for one in finished]
        flames = moths[sorted(range(len(moths)), key=ranks.__getitem__)[: self._population]]
        index, at = trial.number % self._population, min(trial.number, self._n_trials)
        own = [row for row, one in enumerate(finished) if one.number % self._population == index]
        moth = moths[own[-1] if own else -1]
        around = flames[min(index, flames_left(self._population, at, self._n_trials) - 1)]
        now = flight(at / self._n_trials, EMFOA)
        landed = moth_positions(moth, flames[index], around, flames[0], now, CAUCHY_SHARE, self._rng.random)
        return cube.untransform(np.clip(landed, 0.0, 1.0))

    def sample_independent(
        self, study: Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        """Uniformly, for parameters outside the shared space."""
        return self._independent.sample_independent(study, trial, param_name, param_distribution)

    def _first_population(self, members: Array) -> Array:
        """A member of the first population in the unit cube: uniform, or the elite opposite of an earlier member."""
        unit = self._rng.random(members.shape[1])
        if len(members) >= self._population // 2:
            low, high = members.min(axis=0), members.max(axis=0)  # dynamic bounds, Eq. 20
            unit = opposites(members[0], low, high, low, high, self._rng.random)
        return np.asarray(unit)


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
