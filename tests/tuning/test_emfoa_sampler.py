"""Optuna's own conformance suite for samplers, and a comparison at equal trials."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import optuna
import pytest
from optuna.samplers import BaseSampler

from dynslam_bench.tuning.samplers import EmfoaSampler

suites = pytest.importorskip("optuna.testing.pytest_samplers", reason="Optuna < 5 ships no sampler suite")


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


@pytest.mark.parametrize("objective", [sphere, mixed])
def test_it_beats_random_search_at_equal_trials(objective: Callable[[optuna.Trial], float]) -> None:
    optuna.logging.set_verbosity(optuna.logging.WARNING)

    def best(make: Callable[[int], Any]) -> float:
        found = []
        for seed in range(8):
            study = optuna.create_study(sampler=make(seed))
            study.optimize(objective, n_trials=80)
            found.append(study.best_value)
        return float(np.median(found))

    emfoa = best(lambda seed: EmfoaSampler(seed=seed, n_trials=80))
    assert emfoa < best(lambda seed: optuna.samplers.RandomSampler(seed=seed))


def test_the_same_seed_gives_the_same_study() -> None:
    def run() -> list[float]:
        study = optuna.create_study(sampler=EmfoaSampler(seed=3, n_trials=40))
        study.optimize(sphere, n_trials=40)
        return [trial.value for trial in study.trials]

    assert run() == run()
