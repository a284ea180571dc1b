"""Own samplers, pruners, objectives and constraints, the front of several objectives, and Optuna's dashboard on it."""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import optuna
import pytest
from helpers.simulated import HELD_OUT, TRACKER, TUNE, SimulatedTuner, make_spec, valley

from dynslam_bench.core import StudyError
from dynslam_bench.core.records import validated
from dynslam_bench.tuning import Outcome, ProblemInstance, Study, StudySpec, finish, write_page
from dynslam_bench.tuning.objectives import find_objective, violations
from dynslam_bench.tuning.storage import front_trials

HERE = ProblemInstance("synthetic/walking_xyz?scene=0&frames=20")
RUN = Outcome(
    HERE, "", 0.03, 1.0, 0.02, 0.01, 1.5, rpe_m=0.02, final_ate_m=0.025, network_calls=0.5, memory_mb=600.0,
    stages={"tracking": 0.004},
)  # fmt: skip
FIELDS: dict[str, Any] = {
    "name": "own", "tracker": TRACKER, "tune": [TUNE], "held_out": [HELD_OUT], "recorded": (), "trials": 12,
    "space": {"include": ["gain"]}, "min_coverage": None,
}  # fmt: skip


class Traded(SimulatedTuner):
    """Runs whose time grows with the gain, where the error falls with it."""

    def outcomes(
        self, settings: Mapping[str, Any], instances: Sequence[ProblemInstance], **how: Any
    ) -> dict[ProblemInstance, Outcome]:
        gain = settings.get("gain", 1.5)
        return {
            instance: replace(
                run, processor_s=0.01 * gain, ate_m=run.ate_m / gain, memory_mb=100 * gain
            )
            for instance, run in super().outcomes(settings, instances, **how).items()
        }


@pytest.mark.parametrize(
    ("name", "what", "cost"),
    [
        ("relative", "relative error", 0.02),
        ("final", "final ATE", 0.025),
        ("network_calls", "network calls", 0.51),
        ("memory", "memory", 600.0),
        ("time:tracking", "time of tracking", 4.0),
    ],
)
def test_objectives_over_all_that_a_run_came_to(name: str, what: str, cost: float) -> None:
    objective = find_objective(name)
    assert objective.what == what
    assert objective.cost(RUN) == pytest.approx(cost)
    more = replace(
        RUN, rpe_m=0.04, final_ate_m=0.05, network_calls=1.01, memory_mb=1200.0, stages={"tracking": 0.008}
    )  # fmt: skip
    assert objective.value({HERE: more}, {HERE: RUN}) == pytest.approx(math.log(2))


@pytest.mark.parametrize(
    ("name", "run", "words"),
    [
        ("time:trackin", RUN, "no stage 'trackin'.*tracking"),
        ("relative", replace(RUN, rpe_m=math.nan), "no rpe_m.*protocol"),
        ("memory", replace(RUN, memory_mb=math.nan), "no memory_mb"),
    ],
)
def test_a_run_without_the_quantity_is_one_clear_line(name: str, run: Outcome, words: str) -> None:
    with pytest.raises(StudyError, match=words):
        find_objective(name).cost(run)


def test_limits_and_own_constraints_are_those_of_optuna(tmp_path: Path) -> None:
    spec = make_spec(limits={"memory_mb": 500.0, "time:tracking": 5.0, "processor_s": 0.02})
    own = {"coverage_of_half": lambda run: 0.5 - run.coverage}
    violated = violations(spec, {HERE: RUN}, constraints=own)
    assert violated == pytest.approx(
        {"memory_mb": 0.2, "time:tracking": -0.2, "processor_s": -0.5, "coverage_of_half": -0.5}
    )
    with pytest.raises(StudyError, match=r"unknown limit 'memory'.*memory_mb"):
        Study(**FIELDS | {"limits": {"memory": 500.0}}, results=tmp_path)
    values = make_spec().model_dump() | {"limits": {"memory_mb": 0}}
    with pytest.raises(StudyError, match=r"limits.memory_mb"):
        validated(StudySpec, values, "the study", StudyError)


def test_trials_beyond_a_limit_are_no_candidates(tmp_path: Path) -> None:
    tuner = Traded(make_spec(limits={"memory_mb": 160.0}, trials=12), tmp_path).run()
    summary = finish(tuner)
    assert summary.best is not None
    # less error needs a larger gain, and that more memory
    assert 100 * summary.best.params["gain"] <= 160
    assert "memory_mb of 160 or less" in write_page(tuner, summary).read_text()


class PruneAfter(optuna.pruners.BasePruner):
    """Ends every trial after so many instances, and keeps what it was told."""

    def __init__(self, steps: int) -> None:
        self.steps = steps
        self.told: dict[int, dict[int, float]] = {}

    def prune(self, study: optuna.Study, trial: optuna.trial.FrozenTrial) -> bool:
        self.told[trial.number] = dict(trial.intermediate_values)
        return len(trial.intermediate_values) >= self.steps


def test_an_own_pruner_is_asked_after_every_instance(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("outcomes", "_identify", "_error"):
        monkeypatch.setattr(Study, name, getattr(SimulatedTuner, name), raising=False)
    for name, value in {"effect": staticmethod(valley), "noise_seed": 0, "_made": set()}.items():
        monkeypatch.setattr(Study, name, value, raising=False)
    pruner = PruneAfter(2)
    # the sampler of a grid ends the study after its last point
    sampler = optuna.samplers.GridSampler({"gain": [0.5, 1.0, 2.0]})
    study = Study(**FIELDS, results=tmp_path, sampler=sampler, pruner=pruner).run()
    gains = [trial.params["gain"] for trial in study.study.get_trials()]
    assert gains[0] == 1.5
    assert sorted(gains[1:]) == [0.5, 1.0, 2.0]
    states = [trial.state.name for trial in study.study.get_trials()]
    assert states[0] == "COMPLETE", "the baseline is not pruned"
    assert set(states[1:]) == {"PRUNED"}
    assert list(pruner.told[1]) == [1, 2]
    # the value over the instances so far
    reference = study.reference()
    outcomes = study.outcomes(study.study.get_trials()[1].params, study.design.tune[:2])
    expected = study.objectives[0].value(outcomes, reference)
    assert pruner.told[1][2] == pytest.approx(expected)
    assert (study.sampler_name, study.pruner_name) == ("GridSampler", "PruneAfter")


@pytest.fixture
def traded(tmp_path: Path) -> Study:
    spec = make_spec(objectives=["accuracy", "speed"], pruner="none", trials=10)
    return Traded(spec, tmp_path, in_memory=False).run()


def test_the_front_is_shown_and_one_of_it_can_be_chosen(traded: Study) -> None:
    front = front_trials(traded.study)
    values = [trial.values for trial in front]
    assert len(front) > 2
    for one in values:
        assert not any(
            other != one and other[0] <= one[0] and other[1] <= one[1] for other in values
        )
    assert values == sorted(values)

    # the one with the least error, whatever the balance of both
    summary = finish(traded, trial=front[0].number)
    assert summary.best is not None
    assert summary.best.trial == front[0].number
    page = write_page(traded, summary).read_text()
    assert "The front: choose" in page
    for trial in front:
        assert f"Trial {trial.number}: ATE x {math.exp(trial.values[0]):.3f}" in page
        assert re.search(rf"gain = {trial.params['gain']}", page)
    assert len((traded.folder / "csv" / "front.csv").read_text().splitlines()) == len(front) + 1

    # scenes judge once
    with pytest.raises(StudyError, match="has its verdict on trial"):
        finish(traded, trial=front[-1].number)


def test_a_trial_that_cannot_be_chosen_is_one_clear_line(traded: Study) -> None:
    with pytest.raises(StudyError, match="no complete trial 99"):
        finish(traded, trial=99)
    with pytest.raises(StudyError, match="trial 0 has the baseline's settings"):
        finish(traded, trial=0)


def test_one_objective_has_no_front(tmp_path: Path) -> None:
    assert front_trials(SimulatedTuner(make_spec(trials=2), tmp_path).run().study) == []


def test_optunas_dashboard_opens_a_study(traded: Study) -> None:
    dashboard = pytest.importorskip("optuna_dashboard")
    journal = traded.folder / "journal.log"
    backend = optuna.storages.journal.JournalFileBackend(str(journal))
    app = dashboard.wsgi(optuna.storages.JournalStorage(backend))

    def get(path: str) -> Any:
        status: list[str] = []
        environ = {
            "REQUEST_METHOD": "GET", "PATH_INFO": path, "QUERY_STRING": "", "SERVER_NAME": "here",
            "SERVER_PORT": "80", "SERVER_PROTOCOL": "HTTP/1.1", "wsgi.url_scheme": "http",
            "wsgi.input": io.BytesIO(), "wsgi.errors": io.StringIO(),
        }  # fmt: skip
        body = b"".join(app(environ, lambda line, headers, *_: status.append(line)))
        assert status == ["200 OK"]
        return json.loads(body)

    (summary,) = get("/api/studies")["study_summaries"]
    assert summary["study_name"] == traded.spec.name
    detail = get(f"/api/studies/{summary['study_id']}")
    assert len(detail["trials"]) == len(traded.study.get_trials())
    assert [len(trial["values"]) for trial in detail["trials"]] == [2] * len(detail["trials"])
