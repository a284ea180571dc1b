"""The package for OptunaHub, loaded from a copy of its folder: a problem of real runs, and EMFOA as a sampler."""

import shutil
from pathlib import Path

import numpy as np
import optuna
import pytest
from optuna.testing.pytest_samplers import (
    BasicSamplerTestCase,
    RelativeSamplerTestCase,
    SingleOnlySamplerTestCase,
)

optunahub = pytest.importorskip("optunahub")

REGISTRY = Path(__file__).parents[2] / "packaging" / "optunahub" / "package"
NAME = "benchmarks/dynslam"


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """The package, loaded from a copy that has nothing beside it."""
    copy = tmp_path_factory.mktemp("registry")
    shutil.copytree(REGISTRY / NAME, copy / NAME, symlinks=True)
    assert [path for path in copy.rglob("*") if path.is_symlink()] == []
    return optunahub.load_local_module(NAME, registry_root=str(copy))


class TestMothFlameSampler(
    BasicSamplerTestCase, RelativeSamplerTestCase, SingleOnlySamplerTestCase
):
    """Optuna's own tests of samplers."""

    @pytest.fixture(params=[True, False])
    def sampler(self, package, request):
        return lambda: package.MothFlameSampler(elite=request.param)


@pytest.mark.parametrize("elite", [True, False])
def test_moths_find_a_bowl_where_random_draws_do_not(package, elite):
    def bowl(trial):
        return sum((trial.suggest_float(name, -5, 5) - 1) ** 2 for name in "abcd")

    def best(sampler):
        study = optuna.create_study(sampler=sampler)
        study.optimize(bowl, n_trials=100)
        return study.best_value

    seeds = range(5)
    moths = np.median([best(package.MothFlameSampler(elite=elite, seed=seed)) for seed in seeds])
    draws = np.median([best(optuna.samplers.RandomSampler(seed=seed)) for seed in seeds])
    assert moths < draws / 2


def test_a_seed_gives_the_same_trials(package):
    def values(seed):
        study = optuna.create_study(sampler=package.MothFlameSampler(seed=seed, n_trials=30))
        study.optimize(
            lambda trial: trial.suggest_float("x", 0, 1) + trial.suggest_int("n", 1, 9), n_trials=30
        )
        return [trial.value for trial in study.trials]

    assert values(1) == values(1) != values(2)


@pytest.mark.parametrize(
    "wrong, words",
    [
        ({"n_trials": 2.5}, "n_trials 2.5 is no whole number >= 1"),
        ({"population": 1}, "population 1 is no whole number >= 2"),
        ({"seed": "x"}, "seed 'x' is no whole number >= 0"),
    ],
)
def test_a_wrong_argument_is_refused(package, wrong, words):
    with pytest.raises(ValueError, match=words):
        package.MothFlameSampler(**wrong)


def test_there_are_two_splits(package, tmp_path):
    with pytest.raises(ValueError, match="split 'test' is none of tune, held_out"):
        package.Problem(split="test", results=tmp_path)


@pytest.mark.slow
def test_a_sampler_of_optuna_minimises_real_runs(package, tmp_path):
    spec = package.problem.FEATURES.model_copy(
        update={"tune": ("synthetic/walking_xyz?scene=0&frames=12",)}
    )
    problem = package.Problem(spec, results=tmp_path)
    assert list(problem.search_space) == ["features.n_features", "features.fast_threshold"]
    default = {"features.n_features": 1000, "features.fast_threshold": 20}
    # the baseline itself: 0 but for the choice of its start
    assert problem.evaluate(default) == pytest.approx(0.0, abs=1e-9)
    study = optuna.create_study(
        directions=problem.directions, sampler=package.MothFlameSampler(population=2, seed=0)
    )
    study.optimize(problem, n_trials=3)
    assert np.isfinite(study.best_value)
    assert all("coverage" in trial.constraints for trial in study.trials)
