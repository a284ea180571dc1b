"""The table, its surrogate, and its interfaces to OptunaHub and CARP-S."""

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import optuna
import pytest
import slam_hpo
from optuna.testing.pytest_samplers import (
    BasicSamplerTestCase,
    RelativeSamplerTestCase,
    SingleOnlySamplerTestCase,
)
from slam_hpo.moth_flame_sampler import MothFlameSampler
from slam_hpo.problem import Problem

optuna.logging.set_verbosity(optuna.logging.WARNING)
XYZ = slam_hpo.SEQUENCES[0]


@pytest.fixture(params=slam_hpo.SPACES)
def bench(request):
    return slam_hpo.load(request.param)


def test_every_run_is_there_and_the_default_is_first(bench):
    assert np.isfinite(bench.values).all()
    assert (bench.status != "").all()
    assert bench.configuration(0) == slam_hpo.defaults(bench.system)
    assert len(bench.configurations) == len(bench.configurations.drop_duplicates())
    ate, coverage, processor = np.moveaxis(bench.values, -1, 0)
    assert (ate > 0).all()
    assert (coverage >= 0).all()
    assert (coverage <= 1).all()
    assert (processor > 0).all()


def test_a_measured_configuration_is_found(bench):
    last = len(bench.configurations) - 1
    settings = {name: np.float32(value) for name, value in bench.configuration(last).items()}
    found = bench.measured(settings, slam_hpo.SEQUENCES[3], start=4, frames=40)
    assert found[:3] == tuple(bench.values[last, 3, 1, 1])
    assert found.log_ate_std == 0


@pytest.mark.parametrize(
    "change, message",
    [
        ({"features.n_features": 301}, "no run has these settings; the nearest is configuration("),
        ({"features.n_features": 30}, "features.n_features = 30 is outside 300 to 3000"),
        ({"features.n_features": 800.5}, "features.n_features = 800.5 is no whole number"),
        ({"features.n_features": "800"}, "features.n_features = '800' is no whole number"),
        ({"flow.wrong": 1, 2: 3}, "missing or unknown: 2, flow.wrong"),
    ],
)
def test_a_wrong_configuration_is_refused(bench, change, message):
    with pytest.raises(slam_hpo.SlamHpoError) as refused:
        bench.measured(bench.configuration(0) | change, XYZ)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("where", [{"sequence": "kitti/00"}, {"start": 1}, {"frames": 61}])
def test_a_wrong_instance_is_refused_with_those_that_there_are(bench, where):
    name, value = next(iter(where.items()))
    with pytest.raises(
        slam_hpo.SlamHpoError, match=f"{name} {value!r} is not in the benchmark, which has"
    ):
        bench.predicted(bench.configuration(0), **({"sequence": XYZ} | where))


def test_what_is_not_in_the_benchmark_is_named_with_what_is():
    bench = slam_hpo.load("mask-rcnn")
    for call, message in (
        (
            lambda: slam_hpo.load("orb"),
            "system 'orb' is not in the benchmark, which has mask-rcnn, emfoa",
        ),
        (lambda: slam_hpo.load([]), r"system \[\] is not"),
        (
            lambda: slam_hpo.defaults("orb"),
            "system 'orb' is not in the benchmark, which has mask-rcnn, emfoa",
        ),
        (
            lambda: bench.configuration(129),
            "configuration 129 is not in the benchmark, which has 0 to 128",
        ),
        (lambda: bench.noise(61), "frames 61 is not in the benchmark, which has 20, 40, 60"),
        (lambda: bench.noise(60, "rpe"), "metric 'rpe' is not in the benchmark, which has ate_m"),
        (lambda: Problem(seed="x"), "seed 'x' is no whole number >= 0"),
        (lambda: MothFlameSampler(n_trials=2.5), "n_trials 2.5 is no whole number >= 1"),
        (lambda: MothFlameSampler(population=1), "population 1 is no whole number >= 2"),
        (
            lambda: bench.units(5),
            "the settings are 5: give a value for each of features.n_features",
        ),
    ):
        with pytest.raises(slam_hpo.SlamHpoError, match=message):
            call()


@pytest.mark.skipif(find_spec("dynslam_bench") is not None, reason="dynslam-bench is installed")
def test_real_runs_say_what_they_need():
    with pytest.raises(slam_hpo.SlamHpoError, match=r"real runs need dynslam-bench .*pip install"):
        Problem(source="run")


def test_the_surrogate_is_close_to_what_was_measured_and_says_how_sure_it_is(bench):
    measured = np.log(bench.values[:, :, :, -1, 0])
    units = np.stack([bench.units(bench.configuration(index)) for index in range(len(measured))])
    mean, std = (part[:, :, :, -1, 0] for part in bench.surrogate.predict(units))
    assert np.sqrt(np.mean((mean - measured) ** 2)) < measured.std()
    assert (std > 0).all()
    corner = bench.predicted({name: setting.high for name, setting in bench.space.items()}, XYZ)
    assert corner.log_ate_std > std[:, 0, 0].mean()


def test_a_run_that_lost_the_camera_says_so_from_that_length_on():
    bench = slam_hpo.load("mask-rcnn")
    lost = bench.status == "lost"
    coverage = bench.values[..., 1]
    assert lost.any()
    assert (coverage[lost] < 0.9).all()
    assert (lost | (coverage >= 0.5)).all()


def test_the_form_of_hpo_b(bench):
    data = json.loads(json.dumps(bench.hpob()))[bench.system]
    assert len(data) == len(slam_hpo.SEQUENCES) * len(slam_hpo.STARTS)
    one = data[f"{XYZ}, start 0"]
    assert len(one["X"]) == len(one["y"]), "HPO-B maximises"
    assert one["y"][0] == [-bench.values[0, 0, 0, -1, 0]], "HPO-B maximises"


def test_optuna_minimises_the_problem(bench):
    problem = Problem(bench.system)
    assert problem.evaluate(slam_hpo.defaults(bench.system)) == 0
    study = optuna.create_study(
        directions=problem.directions, sampler=optuna.samplers.RandomSampler(seed=0)
    )
    study.optimize(problem, n_trials=20)
    assert all(trial.constraints["coverage"] <= 0.95 for trial in study.trials)
    assert study.best_value == problem.evaluate(study.best_params)


def test_noise_is_drawn_from_its_seed_and_two_metrics_are_two_values():
    noisy = Problem(noise=True, seed=3)
    params = slam_hpo.defaults("mask-rcnn")
    first = [noisy.evaluate(params) for _ in range(3)]
    noisy.reseed(3)
    assert first == [noisy.evaluate(params) for _ in range(3)]
    assert len(set(first)) == 3
    both = Problem(metrics=("ate_m", "processor_s"), noise=True, seed=0)
    spread = np.std([both.evaluate(params) for _ in range(200)], axis=0)
    assert spread[1] < 0.3 * spread[0], "starts differ less in time than in error"
    assert len(both.evaluate(params)) == len(both.directions) == 2
    assert both.metric_names == ["ate_m", "processor_s"]


@pytest.mark.parametrize(
    "wrong",
    [{"split": "train"}, {"metrics": ("rpe",)}, {"metrics": 5}, {"frames": 61}, {"source": "rn"}],
)
def test_a_wrong_problem_is_refused(wrong):
    with pytest.raises(slam_hpo.SlamHpoError, match=r"which has|give a list of"):
        Problem(**wrong)


def test_carps(bench):
    trials = pytest.importorskip("carps.utils.trials")
    from slam_hpo.carps import SlamHpo

    objective = SlamHpo(bench.system)
    config = objective.configspace.get_default_configuration()
    found = objective.evaluate(trials.TrialInfo(config=config, instance=2, seed=1, budget=20))
    expected = bench.predicted(dict(config), slam_hpo.SEQUENCES[2], start=4, frames=20)
    assert found.cost == expected.ate_m
    assert found.status == trials.StatusType.SUCCESS
    for wrong, message in ({"instance": 99}, "instance 99"), ({"budget": 20.9}, "frames 20.9"):
        with pytest.raises(slam_hpo.SlamHpoError, match=f"{message} is not in the benchmark"):
            objective.evaluate(trials.TrialInfo(config=config, **wrong))


def test_neither_torch_nor_opencv_is_imported():
    code = "import slam_hpo, slam_hpo.problem, sys; print({'torch', 'cv2'} & set(sys.modules))"
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout
        == "set()\n"
    )


class TestMothFlameSampler(
    BasicSamplerTestCase, RelativeSamplerTestCase, SingleOnlySamplerTestCase
):
    """Optuna's own tests of samplers."""

    @pytest.fixture(params=[True, False])
    def sampler(self, request):
        return lambda: MothFlameSampler(elite=request.param)


@pytest.mark.parametrize("elite", [True, False])
def test_moths_find_a_bowl_where_random_draws_do_not(elite):
    def bowl(trial):
        return sum((trial.suggest_float(name, -5, 5) - 1) ** 2 for name in "abcd")

    def best(sampler):
        study = optuna.create_study(sampler=sampler)
        study.optimize(bowl, n_trials=100)
        return study.best_value

    moths = np.median([best(MothFlameSampler(elite=elite, seed=seed)) for seed in range(5)])
    assert (
        moths < np.median([best(optuna.samplers.RandomSampler(seed=seed)) for seed in range(5)]) / 2
    )


def test_a_seed_gives_the_same_trials():
    def values(seed):
        study = optuna.create_study(sampler=MothFlameSampler(seed=seed, n_trials=30))
        study.optimize(
            lambda trial: trial.suggest_float("x", 0, 1) + trial.suggest_int("n", 1, 9), n_trials=30
        )
        return [trial.value for trial in study.trials]

    assert values(1) == values(1) != values(2)


def test_optunahub_loads_both_packages():
    import optunahub

    registry = Path(__file__).parents[2] / "optunahub" / "package"
    problem = optunahub.load_local_module(
        "benchmarks/slam_hpo", registry_root=str(registry)
    ).Problem("mask-rcnn")
    sampler = optunahub.load_local_module(
        "samplers/moth_flame", registry_root=str(registry)
    ).MothFlameSampler(seed=0)
    study = optuna.create_study(directions=problem.directions, sampler=sampler)
    study.optimize(problem, n_trials=10)
    assert np.isfinite(study.best_value)
