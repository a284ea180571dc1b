"""What a study may conclude: intervals that cover, sentences that do not promise, importances that are none by luck."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import optuna
import pytest
import toy_tracker

from dynslam_bench.core.errors import StudyError
from dynslam_bench.tuning import Study, StudySpec, finish, run_study, write_page
from dynslam_bench.tuning.importance import FEWEST_TRIALS, importances, inert_parameters
from dynslam_bench.tuning.objective import Instance, Outcome
from dynslam_bench.tuning.summary import Candidate, Ratio, StudySummary, conclude, paired_ratio

TRACKER = f"{toy_tracker.__file__}:SPEC"
TUNE = Ratio(ratio=0.7, low=0.6, high=0.82, n=8, sequences=4)


def candidate(low: float, ratio: float, high: float, sequences: int = 6, **changes: object) -> Candidate:
    held = Ratio(ratio=ratio, low=low, high=high, n=2 * sequences, sequences=sequences)
    values = {"trial": 7, "params": {}, "values": [-0.3], "tune": TUNE, "held_out": held}
    return Candidate.model_validate(values | changes)


@pytest.mark.parametrize("sequences", [3, 5, 10, 20])
def test_intervals_cover_the_truth(sequences: int) -> None:
    rng = np.random.default_rng(sequences)
    instances = [Instance(f"s{i}", seed) for i in range(sequences) for seed in range(2)]
    default = {i: Outcome(i, "", 0.02, 1.0, 0.03, 1.0) for i in instances}
    hits, rounds = 0, 600
    for _ in range(rounds):
        effect = {f"s{i}": rng.normal(math.log(0.8), 0.3) for i in range(sequences)}
        errors = {i: 0.02 * math.exp(effect[i.sequence] + rng.normal(0, 0.1)) for i in instances}
        tuned = {i: Outcome(i, "", error, 1.0, 0.03, 1.0) for i, error in errors.items()}
        found = paired_ratio(tuned, default, instances)
        assert found.low is not None and found.high is not None and found.low < found.ratio < found.high
        hits += found.low <= 0.8 <= found.high
    assert 0.93 <= hits / rounds <= 0.98


def test_one_sequence_has_no_interval_and_can_be_stored() -> None:
    instance = Instance("s", 0)
    one = {instance: Outcome(instance, "", 0.01, 1.0, 0.03, 1.0)}
    found = paired_ratio(one, {instance: Outcome(instance, "", 0.02, 1.0, 0.03, 1.0)}, [instance])
    assert found.ratio == pytest.approx(0.5) and found.low is None and not found.shows_gain and not found.shows_loss
    assert Ratio.model_validate_json(found.model_dump_json()) == found


@pytest.mark.parametrize(
    ("chosen", "notes", "start", "words"),
    [
        (
            candidate(0.6, 0.75, 0.9),
            [],
            "Better: trial 7 has 25.0 % less error on 6 held-out",
            "may replace the default",
        ),
        (candidate(0.6, 0.75, 0.9), ["same"], "Not better, keep the default", "THE SPLITS ARE NOT APART: same"),
        (candidate(0.7, 0.95, 1.3), [], "Not better, keep the default", "[0.700, 1.300]"),
        (candidate(1.1, 1.54, 2.0), [], "Worse, keep the default: 54.0 % more error", "95 % interval"),
        (candidate(1.1, 1.54, 2.0, 4), [], "Worse, keep the default", "rough below five"),
        (candidate(0.1, 0.2, 0.3, 2), [], "Not judged, keep the default", "nothing follows for others"),
        (candidate(0.6, 0.75, 0.9, held_out=None), [], "Not judged, keep the default", "no held-out split"),
        (candidate(0.6, 0.75, 0.9, feasible=False), [], "Keep the default", "violates a constraint"),
        (candidate(0.6, 0.75, 0.9, feasible=False, failed="it broke"), [], "Keep the default", "it broke"),
    ],
)
def test_the_conclusion_is_one_plain_sentence(chosen: Candidate, notes: list[str], start: str, words: str) -> None:
    text = conclude(chosen, notes)
    assert text.startswith(start) and words in text


def study(count: int, seed: int = 0) -> optuna.Study:
    """Only ``x`` matters, and much; ``y`` is noise, ``flag`` never anything but True."""
    rng = np.random.default_rng(seed)
    found = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=seed))
    for _ in range(count):
        trial = found.ask()
        x, _ = trial.suggest_float("x", 0, 1), trial.suggest_float("y", 0, 1)
        trial.suggest_categorical("flag", [True])
        found.tell(trial, x + rng.normal(0, 0.02))
    return found


def test_importances_need_trials_and_exceed_chance() -> None:
    names = ["x", "y", "flag", "never"]
    assert importances(study(FEWEST_TRIALS - 1), names) == {}
    assert importances(study(80), names) == {"x": 1.0}


def test_what_changes_nothing_is_inert() -> None:
    trials = [
        optuna.trial.create_trial(
            value=float(x), params={"x": x, "mode": mode, "one": 3},
            distributions={
                "x": optuna.distributions.IntDistribution(0, 9), "one": optuna.distributions.IntDistribution(0, 9),
                "mode": optuna.distributions.CategoricalDistribution(["a", "b"]),
            },
        )
        for x in range(4)
        for mode in ("a", "b")
    ]  # fmt: skip
    assert inert_parameters(trials, ["x", "mode", "one", "conditional"]) == ["mode", "one", "conditional"]


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    root = tmp_path_factory.mktemp("toys")
    return [str(toy_tracker.make_sequence(root / f"s{i}", 0.8 * i)) for i in range(5)]


def test_a_study_is_a_frame_and_its_page_tells_what_holds_up(folders: list[str], tmp_path: Path) -> None:
    values = {"name": "toy", "tracker": TRACKER, "tune": folders[:1], "held_out": folders[1:], "trials": 5, "top": 1}
    values |= {"space": {"include": ["gain", "mode", "anger"], "fixed": {"wobble": 0}}, "sampler": "random"}
    spec = StudySpec.model_validate(values | {"pruner": "none", "min_coverage": 0.5, "offsets": [0], "seeds": [0]})
    tuner = run_study(spec, results=tmp_path)
    summary = finish(tuner)
    page = write_page(tuner, summary).read_text()
    assert summary.verdict in page.replace("&#39;", "'")
    assert ("Use them" in page) == summary.improves
    assert StudySummary.read(tuner.folder / "summary.json").verdict == summary.conclusion

    frame = Study.open(tuner.folder).frame()
    assert frame.equals(Study.open(spec, tmp_path).frame())
    trials = tuner.study.get_trials()
    assert frame["trial"].tolist() == list(range(len(trials))) and len(trials) == 5
    assert frame["state"].tolist() == [trial.state.name.lower() for trial in trials]
    assert frame["ratio"][0] == pytest.approx(1.0) and frame["value_accuracy"][0] == pytest.approx(0.0, abs=1e-12)
    assert {str(kind) for kind in frame.dtypes} <= {"Int64", "string", "Float64", "boolean"}
    assert frame["params.gain"].tolist() == [trial.params["gain"] for trial in trials]
    assert frame["params.anger"].isna().tolist() == ["anger" not in trial.params for trial in trials]
    assert (frame["duration_s"] > 0).all()
    failed = frame["state"] == "fail"
    assert frame["reason"][failed].notna().all() and frame["reason"][frame["state"] == "complete"].isna().all()


def test_a_study_that_is_not_there_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match="there is no study 'none'"):
        Study.open(StudySpec(name="none", tune=("a",)), tmp_path)
    with pytest.raises(StudyError, match="holds no study"):
        Study.open(tmp_path)
