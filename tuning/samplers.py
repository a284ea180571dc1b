"""Samplers by name, each trial with a stream of its own."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np
import optuna
from numpy.typing import NDArray
from optuna.distributions import BaseDistribution, CategoricalDistribution
from optuna.search_space import IntersectionSearchSpace
from optuna.study import Study
from optuna.study._study_direction import StudyDirection
from optuna.trial import FrozenTrial, TrialState

from dynslam_bench.core.errors import StudyError
from dynslam_bench.core.seeding import stream
from dynslam_bench.flow.moth_flame import EMFOA, flames_left, flight, moth_positions, opposites
from dynslam_bench.tuning import storage as cmaes_state
from dynslam_bench.tuning.study_file import StudySpec

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

    Numbers move in the unit interval of their (linear or logarithmic) range; categories are taken from the flame, or
    drawn anew with the probability that a spiral leaves the interval. Pruned trials with a value count as finished.

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
        found = self._space.calculate(study)
        return {name: each for name, each in found.items() if not each.single()}

    def sample_relative(
        self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """One flight of one moth."""
        if study._is_multi_objective():
            raise ValueError("EmfoaSampler takes one objective")
        if not search_space:
            return {}
        finished = [each for each in _finished(study) if search_space.keys() <= each.params.keys()]
        if len(finished) < self._population:
            return self._found(finished, search_space)
        names = sorted(search_space)
        moths = np.array([[_to_unit(each.params[n], search_space[n]) for n in names] for each in finished])
        order = np.argsort([each[0] for each in _ranked(study, finished)], kind="stable")
        flames = moths[order[: self._population]]
        index = trial.number % self._population
        position = moths[[i for i, each in enumerate(finished) if each.number % self._population == index][-1:] or [-1]]
        population_positions = self._fly(position[0], flames, index, min(trial.number, self._n_trials))
        best = [finished[i] for i in order[: self._population]]
        return {
            name: self._land(value, search_space[name], best[min(index, len(best) - 1)].params[name])
            for name, value in zip(names, population_positions, strict=True)
        }

    def sample_independent(
        self, study: Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        """Uniformly, for parameters outside the shared space."""
        return self._independent.sample_independent(study, trial, param_name, param_distribution)

    def _found(self, finished: list[FrozenTrial], space: dict[str, BaseDistribution]) -> dict[str, Any]:
        """A member of the first population: uniform, or the elite opposite of an earlier member."""
        names = sorted(space)
        unit = self._rng.random(len(names))
        if len(finished) >= self._population // 2:
            members = np.array([[_to_unit(each.params[n], space[n]) for n in names] for each in finished])
            low, high = members.min(axis=0), members.max(axis=0)  # dynamic bounds, Eq. 20
            unit = opposites(np, members[len(finished) % len(members)], low, high, low, high, self._rng.random)
        return {name: _from_unit(value, space[name]) for name, value in zip(names, unit, strict=True)}

    def _fly(self, moth: Array, flames: Array, index: int, trial: int) -> Array:
        """Where the moth of that index lands in a trial of the budget; `flames` best first."""
        left = flames_left(self._population, trial, self._n_trials)
        around, now = flames[min(index, left - 1)], flight(trial / self._n_trials, EMFOA)
        return np.asarray(
            moth_positions(np, moth, flames[index], around, flames[0], now, CAUCHY_SHARE, self._rng.random)
        )

    def _land(self, value: float, distribution: BaseDistribution, flame: Any) -> Any:
        if isinstance(distribution, CategoricalDistribution):
            if 0.0 <= value <= 1.0 and self._rng.random() > 0.1:
                return flame
            return distribution.choices[int(self._rng.integers(len(distribution.choices)))]
        return _from_unit(float(np.clip(value, 0.0, 1.0)), distribution)


def _finished(study: Study) -> list[FrozenTrial]:
    states = (TrialState.COMPLETE, TrialState.PRUNED)
    trials = study._get_trials(deepcopy=False, states=states, use_cache=True)
    return [each for each in trials if _value(each) is not None]


def _ranked(study: Study, trials: Sequence[FrozenTrial]) -> list[tuple[float, int]]:
    sign = 1.0 if study.direction == StudyDirection.MINIMIZE else -1.0
    ranked = []
    for each in trials:
        value = _value(each)
        assert value is not None
        ranked.append((sign * value, each.number))
    return ranked


def _value(trial: FrozenTrial) -> float | None:
    if trial.state == TrialState.COMPLETE:
        return trial.value
    last = trial.intermediate_values[max(trial.intermediate_values)] if trial.intermediate_values else None
    return None if last is None or np.isnan(last) else last


def _scaled_bounds(distribution: Any) -> tuple[float, float]:
    """Ends of a numerical range, half a step wider for stepped ones, so that both ends are drawn as often."""
    low, high = float(distribution.low), float(distribution.high)
    if distribution.log:
        half = 0.5 if isinstance(distribution.low, int) else 0.0
        return float(np.log(low - half)), float(np.log(high + half))
    half = 0.0 if distribution.step is None else distribution.step / 2
    return low - half, high + half


def _to_unit(value: Any, distribution: BaseDistribution) -> float:
    if isinstance(distribution, CategoricalDistribution):
        return (distribution.to_internal_repr(value) + 0.5) / len(distribution.choices)
    low, high = _scaled_bounds(distribution)
    scaled = np.log(value) if distribution.log else float(value)  # type: ignore[attr-defined]
    return float((scaled - low) / (high - low))


def _from_unit(unit: float, distribution: BaseDistribution) -> Any:
    if isinstance(distribution, CategoricalDistribution):
        return distribution.choices[min(int(unit * len(distribution.choices)), len(distribution.choices) - 1)]
    low, high = _scaled_bounds(distribution)
    value = low + unit * (high - low)
    if distribution.log:  # type: ignore[attr-defined]
        value = float(np.exp(value))
    if isinstance(distribution, optuna.distributions.IntDistribution):
        step = distribution.step
        value = distribution.low + step * round((value - distribution.low) / step)
        return int(np.clip(value, distribution.low, distribution.high))
    assert isinstance(distribution, optuna.distributions.FloatDistribution)
    if distribution.step is not None:
        value = distribution.low + distribution.step * round((value - distribution.low) / distribution.step)
    return float(np.clip(value, distribution.low, distribution.high))
