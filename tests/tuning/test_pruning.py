"""Pruning and workers: who is pruned, true values, no claims by luck. Runs are drawn, see `simulated`."""

from __future__ import annotations

import math
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import optuna
import pytest
from optuna.trial import FrozenTrial, TrialState
from simulated import SimulatedTuner, make_spec, nothing, valley

from dynslam_bench.tuning import ProblemInstance, Verdict, finish, parse_instances
from dynslam_bench.tuning.objectives import ACCURACY
from dynslam_bench.tuning.storage import worker_name
from dynslam_bench.tuning.study import CRASHED_WORKER, StudyEvent


def ran_on(trial: FrozenTrial) -> list[ProblemInstance]:
    return [parse_instances(text)[0] for text, *_ in trial.user_attrs["instances"]]


@pytest.mark.parametrize("pruner", ["halving", "wilcoxon"])
def test_values_are_of_the_instances_that_ran(pruner: str, tmp_path: Path) -> None:
    tuner = SimulatedTuner(make_spec(pruner=pruner, trials=16), tmp_path, effect=valley)
    trials = tuner.run().study.get_trials()
    states = [trial.state for trial in trials]
    assert states[0] == TrialState.COMPLETE and TrialState.PRUNED in states
    for trial in trials:
        instances = ran_on(trial)
        value = ACCURACY.value(tuner.outcomes(tuner.configuration_of(trial).settings, instances), tuner.reference())
        if trial.state == TrialState.COMPLETE:
            assert instances == list(tuner.design.tune), "a value is one of all instances"
            assert trial.values[0] == pytest.approx(value, abs=1e-12)
        else:
            assert trial.state == TrialState.PRUNED and 3 <= len(instances) < len(tuner.design.tune)
            assert len(trial.intermediate_values) == len(instances)
            if pruner == "halving":
                assert trial.value == pytest.approx(value, abs=1e-12) and len(instances) in (3, 6, 12)


def test_trials_of_several_objectives_run_on_all_instances(tmp_path: Path) -> None:
    tuner = SimulatedTuner(make_spec(objectives=["accuracy", "speed"]), tmp_path, effect=valley).run()
    assert {len(ran_on(trial)) for trial in tuner.study.get_trials()} == {len(tuner.design.tune)}


def test_pruning_takes_half_the_runs_at_the_same_regret(tmp_path: Path) -> None:
    runs: dict[str, int] = {"none": 0, "halving": 0}
    regret: dict[str, list[float]] = {"none": [], "halving": []}
    for pruner in runs:
        for seed in range(3):
            spec = make_spec(pruner=pruner, trials=24, sampler_seed=seed)
            tuner = SimulatedTuner(spec, tmp_path / f"{pruner}{seed}", effect=valley, seed=seed)
            regret[pruner].append(valley(tuner.run().study.best_trial.params))
            runs[pruner] += tuner.runs
    assert runs["halving"] <= 0.5 * runs["none"]
    assert np.mean(regret["halving"]) <= np.mean(regret["none"]) + 0.01


def test_nothing_is_claimed_where_nothing_is_better(tmp_path: Path) -> None:
    """Twelve studies; tests/benchmarks/study_null.py has more. The trials alone would claim a gain in most of them."""
    chosen = claims = lucky = no_matter = 0
    for seed in range(12):
        tuner = SimulatedTuner(make_spec(sampler_seed=seed), tmp_path / str(seed), effect=nothing, seed=seed)
        lucky += tuner.run().study.best_value < math.log(0.95)
        summary = finish(tuner)
        chosen += summary.candidates[0].chosen
        claims += summary.verdict == Verdict.PROVEN
        no_matter += summary.verdict == Verdict.NO_MATTER
    assert claims == 0 and no_matter >= 9
    assert chosen <= 2, "5 % of 12, and its chance"
    assert lucky >= 5, "what the trials alone say"


def test_an_injected_regression_is_found_and_judged(tmp_path: Path) -> None:
    spec = make_spec(space={"include": ["gain"], "fixed": {}}, trials=20, top=1)
    tuner = SimulatedTuner(spec, tmp_path, effect=lambda settings: 4 * valley(settings), seed=3)
    tuner.run()
    summary = finish(tuner)
    held = summary.candidates[0].held_out
    assert summary.verdict == Verdict.PROVEN and held is not None and held.high < 1
    injected = 4 * valley({"gain": 1.5})
    assert -math.log(held.ratio) > 0.8 * injected - 0.2, "most of the injected loss, within the noise"


def test_eight_workers_and_a_resume_repeat_no_trial(tmp_path: Path) -> None:
    spec = make_spec(trials=40, sampler="tpe")

    def work(count: int) -> int:
        tuner = SimulatedTuner(spec.model_copy(update={"trials": count}), tmp_path, effect=valley, in_memory=False)
        return len(tuner.run().study.get_trials())

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, [32] * 8))
    assert work(40) == 40, "one of them goes on later"
    tuner = SimulatedTuner(spec, tmp_path, in_memory=False)
    drawn = [tuple(sorted(trial.params.items())) for trial in tuner.study.get_trials()]
    assert len(set(drawn)) == len(drawn) == 40
    assert drawn[0] == (("gain", 1.5), ("wobble", 2)), "the default, once"
    journal = optuna.storages.journal.JournalFileBackend(str(tuner.folder / "journal.log"))
    study = optuna.load_study(study_name="simulated", storage=optuna.storages.JournalStorage(journal))
    assert study.best_value == tuner.study.best_value and study.metric_names == ["accuracy"]
    assert any(trial.intermediate_values for trial in study.trials), "for Optuna's dashboard"


@pytest.fixture
def dead() -> str:
    """The name of a worker that has ended."""
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    return f"{worker_name().rpartition(':')[0]}:{ended.pid}"


def test_a_trial_of_a_dead_worker_is_repeated(tmp_path: Path, dead: str) -> None:
    tuner, other = (SimulatedTuner(make_spec(trials=6), tmp_path, in_memory=False) for _ in range(2))

    def dies_later(event: StudyEvent) -> None:
        if event.kind == "finished" and event.number == 2:
            other.study.ask().set_user_attr("worker", dead)

    reasons = [trial.user_attrs.get("reason") for trial in tuner.run(on_event=dies_later).study.get_trials()]
    assert (len(reasons), reasons.count(CRASHED_WORKER)) == (7, 1)


def test_two_workers_may_fail_the_same_trial_at_the_same_time(tmp_path: Path, dead: str) -> None:
    tuner, other = (SimulatedTuner(make_spec(trials=3), tmp_path, in_memory=False) for _ in range(2))
    lost = other.study.ask()
    lost.set_user_attr("worker", dead)
    get_trials = tuner.study.get_trials

    def then_the_other_is_quicker(*args: Any, **named: Any) -> list[FrozenTrial]:
        trials = get_trials(*args, **named)
        with suppress(ValueError):  # it has done so before
            other.study.tell(lost, state=TrialState.FAIL)
        return trials

    with patch.object(tuner.study, "get_trials", then_the_other_is_quicker):
        tuner.run()
    assert [trial.state for trial in tuner.study.get_trials()].count(TrialState.FAIL) == 1


def test_one_worker_makes_the_same_trials_again(tmp_path: Path) -> None:
    def drawn(name: str, seed: int) -> list[dict[str, object]]:
        tuner = SimulatedTuner(make_spec(sampler="tpe", sampler_seed=seed), tmp_path / name, effect=valley)
        tuner.study.enqueue_trial({"gain": 1.0, "wobble": 0})
        return [trial.params for trial in tuner.run().study.get_trials()]

    first = drawn("a", 1)
    assert first == drawn("b", 1) != drawn("c", 2)
    assert first[:2] == [{"gain": 1.5, "wobble": 2}, {"gain": 1.0, "wobble": 0}], "the default stays the first"
