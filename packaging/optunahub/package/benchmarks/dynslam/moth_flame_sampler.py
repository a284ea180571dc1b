"""Moth-flame optimisation as a sampler of Optuna: plain (Mirjalili 2015) and elite (EMFOA-OFT-SLAM, Eq. 8-22)."""

from __future__ import annotations

from numbers import Integral
from typing import Any

import numpy as np
import optunahub
from numpy.typing import NDArray
from optuna._transform import _SearchSpaceTransform
from optuna.distributions import BaseDistribution
from optuna.study import Study, StudyDirection
from optuna.trial import FrozenTrial, TrialState

from dynslam_bench.flow.moth_flame import (
    EMFOA,
    MFO,
    flames_left,
    flight,
    moth_positions,
    opposites,
)

CAUCHY_SHARE = 0.05
"""Scale of the Cauchy steps of Eq. 13, as a share of the unit interval."""


class MothFlameSampler(optunahub.samplers.SimpleBaseSampler):
    """Trial n is the flight of moth n mod N around its flame, which is one of the best finished trials.

    The first population is drawn uniformly; of EMFOA, its second half are opposites of the first
    (Eq. 19-22). Then a moth flies a logarithmic spiral from its last position around its flame (Eq.
    8-10); of EMFOA with a Cauchy step in the first half of the budget (Eq. 13-16), and the pull of
    the best flame in the second (Eq. 17-18). The number of flames falls over the budget (Eq. 11).
    Moths move in the unit cube. Pruned trials are worse than complete.

    Args:
        elite: EMFOA; plain moth-flame optimisation otherwise.
        seed: Of the random numbers.
        n_trials: The budget over which flames are reduced; later trials stay in the last phase.
        population: Moths, and flames.

    Raises:
        ValueError: `seed`, `n_trials` or `population` is no whole number, or below 0, 1 or 2; when
            sampling, the study has several objectives.
    """

    def __init__(
        self,
        *,
        elite: bool = True,
        seed: int | None = None,
        n_trials: int = 100,
        population: int = 8,
    ) -> None:
        for name, value, least in (
            ("seed", seed or 0, 0),
            ("n_trials", n_trials, 1),
            ("population", population, 2),
        ):
            if not isinstance(value, Integral) or value < least:
                raise ValueError(f"{name} {value!r} is no whole number >= {least}")
        super().__init__(seed=seed)
        self._rules = EMFOA if elite else MFO
        self._rng = np.random.default_rng(seed)
        self._n_trials = n_trials
        self._population = population

    def reseed_rng(self) -> None:
        """Draw a new seed, for parallel workers."""
        super().reseed_rng()
        self._rng = np.random.default_rng()

    def sample_relative(
        self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """One flight of one moth."""
        _check_single(study)
        if not search_space:
            return {}

        # finished trials as moths, points of the unit cube [trials, settings]
        cube = _SearchSpaceTransform(search_space, transform_0_1=True)
        trials = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED))
        finished = [
            one
            for one in trials
            if one.value is not None and search_space.keys() <= one.params.keys()
        ]
        units = [
            cube.transform({name: one.params[name] for name in search_space}) for one in finished
        ]
        moths = np.array(units).reshape(-1, len(cube.bounds))
        if len(moths) < self._population:
            return cube.untransform(self._first_population(moths))

        # the flames: the best of them, the best first
        sign = -1.0 if study.direction == StudyDirection.MAXIMIZE else 1.0
        ranks = [
            (one.state == TrialState.PRUNED, sign * float(one.value or 0.0)) for one in finished
        ]
        order = sorted(range(len(moths)), key=ranks.__getitem__)
        flames = moths[order[: self._population]]

        # this trial's moth at its last position, and the flame that it flies around (Eq. 11)
        index = trial.number % self._population
        at = min(trial.number, self._n_trials)
        own = [row for row, one in enumerate(finished) if one.number % self._population == index]
        moth = moths[own[-1] if own else -1]
        around = flames[min(index, flames_left(self._population, at, self._n_trials) - 1)]

        # its flight (Eq. 8-18), clipped to the cube
        now = flight(at / self._n_trials, self._rules)
        landed = moth_positions(
            moth, flames[index], around, flames[0], now, CAUCHY_SHARE, self._rng.random
        )
        return cube.untransform(np.clip(landed, 0.0, 1.0))

    def sample_independent(
        self,
        study: Study,
        trial: FrozenTrial,
        param_name: str,
        param_distribution: BaseDistribution,
    ) -> Any:
        """Uniformly, for parameters that not all trials share."""
        _check_single(study)
        return super().sample_independent(study, trial, param_name, param_distribution)

    def _first_population(self, members: NDArray[np.float64]) -> NDArray[np.float64]:
        """The next member: drawn, or, of EMFOA's second half, the opposite of one of the first half.

        Args:
            members: ``[n, settings]``, those that there are, in the unit cube.
        """
        unit = self._rng.random(members.shape[1])
        half = self._population // 2
        if self._rules.opposition and len(members) >= half:
            drawn = members[:half]
            # dynamic bounds, Eq. 20
            least = drawn.min(axis=0)
            greatest = drawn.max(axis=0)
            member = members[len(members) - half]
            unit = opposites(member, least, greatest, 0.0, 1.0, self._rng.random)
        return np.asarray(unit)


def _check_single(study: Study) -> None:
    """Refuse a study of several objectives."""
    if len(study.directions) > 1:
        raise ValueError("MothFlameSampler takes one objective")
