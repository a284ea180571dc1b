"""The race: who drops out, that values told are true, and that luck wins nothing. Runs are drawn, see `simulated`."""

from __future__ import annotations

import math
import socket
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
from optuna.trial import FrozenTrial, TrialState, create_trial
from simulated import SimulatedTuner, make_spec, nothing, valley

from dynslam_bench.core.errors import StudyError
from dynslam_bench.tuning import finish
from dynslam_bench.tuning import pruning as race
from dynslam_bench.tuning.objectives import ACCURACY
from dynslam_bench.tuning.trials import errors_of
from dynslam_bench.tuning.tuner import CRASHED_WORKER, StudyEvent


def test_steps_grow_and_cost_the_same() -> None:
    assert race.steps("halving", 24) == [3, 6, 12, 24]
    assert race.steps("halving", 16) == [3, 6, 12, 16]
    assert race.steps("rejection", 6) == [3, 4, 5, 6] == race.steps("wilcoxon", 6)
    assert race.steps("none", 24) == [24] and race.steps("halving", 2) == [2]


def test_the_better_half_goes_on_and_nobody_whom_none_beats_is_dropped() -> None:
    values = [[0.3], [0.1], [0.2], [0.4]]
    dropped = [race.is_dropped(mine, [v for v in values if v is not mine], 4, 0.5) for mine in values]
    assert dropped == [True, False, False, True]
    assert not race.is_dropped([9.0], [], 1, 0.1)
    assert not race.is_dropped([0.5, 0.1], [[0.1, 0.5], [0.2, 0.4]], 3, 0.1), "on the front of two objectives"
    assert race.is_dropped([0.5, 0.6], [[0.1, 0.5], [0.2, 0.4]], 3, 0.1)


def test_a_lucky_beginning_gives_no_immunity() -> None:
    def trial(number: int, *course: float) -> optuna.trial.FrozenTrial:
        found = create_trial(state=TrialState.RUNNING, intermediate_values=dict(zip((3, 6), course, strict=False)))
        found.number = number
        return found

    trials = [trial(0, -0.9, 0.3), trial(1, -0.1, -0.1), trial(2, -0.2, -0.2), trial(3, 0.5)]
    assert not race.leaves(trials, 0, [3, 6, 12], 0), "the best at the first step"
    assert race.leaves(trials, 0, [3, 6, 12], 1), "and the worst at the second"
    assert race.leaves(trials, 3, [3, 6, 12], 0)


@pytest.mark.parametrize(("rule", "objectives"), [
    ("halving", ["accuracy"]), ("rejection", ["accuracy"]), ("wilcoxon", ["accuracy"]),
    ("halving", ["accuracy", "speed"]),
])  # fmt: skip
def test_told_values_are_true(rule: str, objectives: list[str], tmp_path: Path) -> None:
    tuner = SimulatedTuner(make_spec(pruner=rule, objectives=objectives, trials=16), tmp_path, effect=valley)
    trials = tuner.run().get_trials()
    states = [trial.state for trial in trials]
    assert states[0] == TrialState.COMPLETE and TrialState.PRUNED in states
    for trial in trials:
        instances = list(errors_of(trial))
        value = ACCURACY.value(tuner.evaluate(tuner.settings_of(trial), instances), tuner.reference())
        if trial.state == TrialState.COMPLETE:
            assert instances == list(tuner.design.race), "a value is one of all instances"
            assert trial.values[0] == pytest.approx(value, abs=1e-12)
        else:
            assert trial.state == TrialState.PRUNED, "never told as complete"
            assert len(instances) < len(tuner.design.race) and "dropped after" in trial.user_attrs["reason"]
            noted = race.noted(trial, len(instances))
            assert noted is not None and noted[0] == pytest.approx(value, abs=1e-12)


def test_wilcoxon_takes_one_objective(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match="'wilcoxon' takes one objective, the study has 2"):
        SimulatedTuner(make_spec(pruner="wilcoxon", objectives=["accuracy", "speed"]), tmp_path)


def test_the_race_takes_half_the_runs_of_the_full_grid_at_the_same_regret(tmp_path: Path) -> None:
    runs: dict[str, int] = {"none": 0, "halving": 0}
    regret: dict[str, list[float]] = {"none": [], "halving": []}
    for rule in runs:
        for seed in range(5):
            spec = make_spec(pruner=rule, trials=24, sampler_seed=seed)
            tuner = SimulatedTuner(spec, tmp_path / f"{rule}{seed}", effect=valley, seed=seed)
            regret[rule].append(valley(tuner.run().best_trial.params))
            runs[rule] += tuner.runs
    assert runs["halving"] <= 0.5 * runs["none"]
    assert np.mean(regret["halving"]) <= np.mean(regret["none"]) + 0.01


def test_nothing_is_claimed_where_nothing_is_better(tmp_path: Path) -> None:
    """Forty studies; a single comparison of the best trial on its own instances would claim a gain in most of them."""
    chosen = claims = lucky = 0
    for seed in range(40):
        tuner = SimulatedTuner(make_spec(sampler_seed=seed), tmp_path / str(seed), effect=nothing, seed=seed)
        lucky += tuner.run().best_value < math.log(0.95)
        summary = finish(tuner)
        chosen += summary.chosen is not None
        claims += summary.improves
        assert summary.improves == summary.conclusion.startswith("Better")
    assert claims <= 2, "5 % of 40"
    assert chosen <= 4, "5 % of 40, and its chance"
    assert lucky >= 20, "what the trials alone say"


def test_a_planted_gain_is_found_and_judged(tmp_path: Path) -> None:
    spec = make_spec(space={"include": ["gain"], "fixed": {}}, trials=20, top=1)
    tuner = SimulatedTuner(spec, tmp_path, effect=lambda settings: 4 * valley(settings), seed=3)
    tuner.run()
    summary = finish(tuner)
    held = summary.candidates[0].held_out
    assert summary.improves and held is not None and held.high < 1
    planted = 4 * valley({"gain": 1.5})
    assert -math.log(held.ratio) > 0.8 * planted - 0.2, "most of the planted loss, within the noise"


def test_eight_workers_and_a_resume_repeat_no_trial(tmp_path: Path) -> None:
    spec = make_spec(trials=40, sampler="tpe")

    def work(count: int) -> int:
        tuner = SimulatedTuner(spec.model_copy(update={"trials": count}), tmp_path, effect=valley, in_memory=False)
        return len(tuner.run().get_trials())

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, [32] * 8))
    assert work(40) == 40, "one of them goes on later"
    study = SimulatedTuner(spec, tmp_path, in_memory=False).study
    drawn = [tuple(sorted(trial.params.items())) for trial in study.get_trials()]
    assert len(set(drawn)) == len(drawn) == 40
    assert drawn[0] == (("gain", 1.5), ("wobble", 2)), "the default, once"


def test_survivors_make_the_trials_of_a_worker_that_dies_beside_them(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    tuner, other = (SimulatedTuner(make_spec(trials=6), tmp_path, in_memory=False) for _ in range(2))

    def dies_later(event: StudyEvent) -> None:
        if event.kind == "finished" and event.number == 2:
            other.study.ask().set_user_attr("worker", f"{socket.gethostname()}:{ended.pid}")

    reasons = [trial.user_attrs.get("reason") for trial in tuner.run(on_event=dies_later).get_trials()]
    assert (len(reasons), reasons.count(CRASHED_WORKER)) == (7, 1)


def test_workers_may_bury_the_same_trial_at_the_same_time(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    tuner, other = (SimulatedTuner(make_spec(trials=3), tmp_path, in_memory=False) for _ in range(2))
    lost = other.study.ask()
    lost.set_user_attr("worker", f"{socket.gethostname()}:{ended.pid}")
    seen = tuner.study.get_trials

    def then_the_other_is_quicker(*given: Any, **how: Any) -> list[FrozenTrial]:
        found = seen(*given, **how)
        with suppress(ValueError):  # it has done so before
            other.study.tell(lost, state=TrialState.FAIL)
        return found

    with patch.object(tuner.study, "get_trials", then_the_other_is_quicker):
        tuner.run()
    assert [trial.state for trial in tuner.study.get_trials()].count(TrialState.FAIL) == 1


def test_one_worker_makes_the_same_trials_again(tmp_path: Path) -> None:
    def drawn(name: str, seed: int) -> list[dict[str, object]]:
        tuner = SimulatedTuner(make_spec(sampler="tpe", sampler_seed=seed), tmp_path / name, effect=valley)
        return [trial.params for trial in tuner.run().get_trials()]

    assert drawn("a", 1) == drawn("b", 1) != drawn("c", 2)


def test_an_enqueued_trial_does_not_displace_the_default(tmp_path: Path) -> None:
    tuner = SimulatedTuner(make_spec(trials=4), tmp_path)
    tuner.study.enqueue_trial({"gain": 1.0, "wobble": 0})
    trials = tuner.run().get_trials()
    assert trials[0].params == {"gain": 1.5, "wobble": 2} and trials[1].params == {"gain": 1.0, "wobble": 0}


def test_a_stored_study_opens_in_optuna(tmp_path: Path) -> None:
    tuner = SimulatedTuner(make_spec(trials=6), tmp_path, effect=valley, in_memory=False)
    tuner.run()
    journal = optuna.storages.journal.JournalFileBackend(str(tuner.folder / "journal.log"))
    study = optuna.load_study(study_name="simulated", storage=optuna.storages.JournalStorage(journal))
    assert [trial.state for trial in study.trials] == [trial.state for trial in tuner.study.get_trials()]
    assert study.best_value == tuner.study.best_value and study.metric_names == ["accuracy"]
    assert any(trial.intermediate_values for trial in study.trials), "the course of the race, for the dashboard"
