"""Optuna's own conformance suite for samplers, and a comparison at equal trials."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import optuna
import pytest
from optuna.samplers import BaseSampler
from optuna.testing import pytest_samplers as suites

from dynslam_bench.tuning.samplers import EmfoaSampler


class TestEmfoaSampler(suites.BasicSamplerTestCase, suites.RelativeSamplerTestCase):
    @pytest.fixture
    def sampler(self) -> Callable[[], BaseSampler]:
        return lambda: EmfoaSampler(population=4)


def sphere(trial: optuna.Trial) -> float:
    values = [trial.suggest_float(f"x{i}", -5.0, 5.0) for i in range(4)]
    return sum((value - 1.3) ** 2 for value in values)


def mixed(trial: optuna.Trial) -> float:
    kind = trial.suggest_categorical("kind", ["a", "b", "c"])
    rate = trial.suggest_float("rate", 1e-4, 1.0, log=True)
    count = trial.suggest_int("count", 1, 20)
    return float((np.log10(rate) + 2) ** 2 + abs(count - 13) / 4 + {"a": 1.0, "b": 0.0, "c": 2.0}[kind])


def values(sampler: BaseSampler, objective: Callable[[optuna.Trial], float], trials: int) -> list[Any]:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=sampler)
    study.optimize(objective, n_trials=trials)
    return [trial.value for trial in study.trials]


@pytest.mark.parametrize("objective", [sphere, mixed])
def test_it_beats_random_search_at_equal_trials(objective: Callable[[optuna.Trial], float]) -> None:
    emfoa = [min(values(EmfoaSampler(seed=seed, n_trials=80), objective, 80)) for seed in range(8)]
    random = [min(values(optuna.samplers.RandomSampler(seed=seed), objective, 80)) for seed in range(8)]
    assert np.median(emfoa) < np.median(random)


def test_the_same_seed_gives_the_same_study() -> None:
    assert values(EmfoaSampler(seed=3, n_trials=40), sphere, 40) == values(
        EmfoaSampler(seed=3, n_trials=40), sphere, 40
    )
