"""What a study may conclude: intervals that cover, the choice, conclusions, importances, and its frame."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import optuna
import pytest
import toy_tracker
from scipy import stats
from scipy.stats import mstats

from dynslam_bench.core.errors import StudyError
from dynslam_bench.tuning import Study, StudySpec, finish, run_study, write_page
from dynslam_bench.tuning.evaluate import Outcome
from dynslam_bench.tuning.instances import ProblemInstance
from dynslam_bench.tuning.objectives import bounds, by_scene, centre, upper
from dynslam_bench.tuning.storage import open_storage
from dynslam_bench.tuning.summary import Candidate, Ratio, StudySummary, choose, compared, conclude
from dynslam_bench.tuning.trials import FEWEST_TRIALS, importances

TRACKER = f"{toy_tracker.__file__}:SPEC"
CONFIRM = Ratio(ratio=0.7, low=0.6, high=0.82, n=8, sequences=4, bound=0.85)


def candidate(low: float, ratio: float, high: float, sequences: int = 6, **changes: object) -> Candidate:
    held = Ratio(ratio=ratio, low=low, high=high, n=2 * sequences, sequences=sequences)
    values = {"trial": 7, "params": {}, "values": [-0.3], "confirm": CONFIRM, "held_out": held}
    return Candidate.model_validate(values | changes)


@pytest.mark.parametrize("scenes", [3, 4, 6, 9, 10, 15, 20, 40])
@pytest.mark.parametrize("lost", [0.0, 0.1], ids=["normal", "one in ten is a catastrophe"])
def test_intervals_and_bounds_cover_the_truth(scenes: int, lost: float) -> None:
    rng = np.random.default_rng([scenes, round(10 * lost)])
    rounds, truth = 1500, math.log(0.8)
    spread = np.where(rng.random((rounds, scenes)) < lost, 1.2, 0.3)
    samples = truth + rng.normal(0, 1, (rounds, scenes)) * spread
    found = [bounds(sample) for sample in samples]
    covered = np.mean([each is not None and each[0] <= truth <= each[1] for each in found])
    below = np.mean([upper(sample, 0.95) < truth for sample in samples])
    assert 0.935 <= covered <= 0.98, "nominal 95 %, never less; a little more under catastrophes"
    assert 0.015 <= below <= 0.065, "nominal 5 %"


def test_the_interval_is_students_and_from_ten_on_that_of_the_trimmed_mean() -> None:
    sample = np.random.default_rng(0).normal(size=9)
    interval = bounds(sample)
    assert interval == pytest.approx(stats.t.interval(0.95, 8, sample.mean(), stats.sem(sample)))
    assert interval is not None and upper(sample, 0.975) == pytest.approx(interval[1])
    many = np.random.default_rng(1).normal(size=20)  # 10 % of 20 is whole, so that SciPy's formula is the same
    winsorised = np.asarray(mstats.winsorize(many, (0.1, 0.1)))
    error = winsorised.std(ddof=1) / (0.8 * math.sqrt(20))
    assert centre(many) == pytest.approx(stats.trim_mean(many, 0.1))
    assert bounds(many) == pytest.approx(stats.t.interval(0.95, 15, stats.trim_mean(many, 0.1), error))
    assert bounds([1.0]) is None and upper([1.0], 0.95) == math.inf


def outcomes(errors: dict[ProblemInstance, float]) -> dict[ProblemInstance, Outcome]:
    return {instance: Outcome(instance, "", error, 1.0, 0.03, 0.03, 1.0) for instance, error in errors.items()}


def test_one_lucky_start_of_the_default_decides_nothing() -> None:
    starts = [ProblemInstance("s", offset=offset) for offset in range(3)]
    default = dict(zip(starts, (0.002, 0.02, 0.021), strict=True))
    same = dict.fromkeys(starts, 0.02)
    assert by_scene(same, default) == {starts[0].scene: pytest.approx(0.0)}
    assert by_scene({starts[0]: 0.02}, default) == {starts[0].scene: pytest.approx(0.0)}, "no pairing with that luck"


def test_few_scenes_have_an_interval_over_starts_that_shows_nothing() -> None:
    starts = [ProblemInstance("s", offset=offset) for offset in range(4)]
    found = compared(outcomes(dict.fromkeys(starts, 0.01)), outcomes(dict.fromkeys(starts, 0.02)))
    assert (found.ratio, found.low, found.high) == pytest.approx((0.5, 0.5, 0.5))
    assert found.sequences == 1 and found.n == 4 and not found.shows_gain and not found.shows_loss
    one = compared(outcomes({starts[0]: 0.01}), outcomes({starts[0]: 0.02}))
    assert one.ratio == pytest.approx(0.5) and one.low is None and one.bound is None and not one.shows_gain
    assert Ratio.model_validate_json(one.model_dump_json()) == one


def test_the_choice_is_by_the_upper_bound_and_falls_back_to_the_default() -> None:
    def judged(trial: int, ratio: float, bound: float, **changes: object) -> Candidate:
        found = Ratio(ratio=ratio, low=0.1, high=bound, n=8, sequences=4, bound=bound)
        return candidate(0.6, 0.75, 0.9, **({"trial": trial, "confirm": found, "held_out": None} | changes))

    sure, lucky, broken = judged(1, 0.9, 0.97), judged(2, 0.7, 1.2), judged(3, 0.2, 0.3, feasible=False)
    assert choose([lucky, sure, broken]) is sure
    assert choose([lucky, broken]) is None and choose([]) is None
    broke = judged(4, 1, 1, confirm=None, feasible=False, failed="it broke")
    for candidates, named in (([lucky, broken], "trial 2"), ([broken], "trial 3"), ([broke], "it broke"), ([], "")):
        text = conclude(candidates, None, [])
        assert text.startswith("Keep the default: ") and named in text


@pytest.mark.parametrize(
    ("chosen", "notes", "start", "named"),
    [
        (candidate(0.6, 0.75, 0.9), [], "Better: trial 7", "25.0 % less ATE on 6 held-out"),
        (candidate(0.6, 0.75, 0.9), ["same"], "Not better, keep the default", "same"),
        (candidate(0.7, 0.95, 1.3), [], "Not better, keep the default", "[0.700, 1.300]"),
        (candidate(1.1, 1.54, 2.0), [], "Worse, keep the default", "54.0 % more ATE"),
        (candidate(1.1, 1.54, 2.0, 4), [], "Worse, keep the default", "rough below five"),
        (candidate(0.1, 0.2, 0.3, 2), [], "Not judged, keep the default", "2 held-out scenes"),
        (candidate(0.6, 0.75, 0.9, held_out=None), [], "Not judged, keep the default", "no held-out split"),
        (
            candidate(0.6, 0.75, 0.9, recorded=Ratio(ratio=1.3, low=1.1, high=1.5, n=4, sequences=1)),
            [],
            "Worse on recordings, keep the default",
            "1.300 [1.100, 1.500]",
        ),
        (candidate(0.6, 0.75, 0.9, feasible=False, failed="it broke"), [], "Keep the default", "it broke"),
    ],
)
def test_the_conclusion_is_one_sentence_with_the_numbers(
    chosen: Candidate, notes: list[str], start: str, named: str
) -> None:
    text = conclude([chosen], chosen.trial, notes)
    assert text.startswith(start) and named in text


@pytest.mark.parametrize("count", [FEWEST_TRIALS - 1, 80])
def test_importances_are_optunas_from_enough_trials_on(count: int) -> None:
    rng = np.random.default_rng(0)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(count):
        trial = study.ask()
        x, _ = trial.suggest_float("x", 0, 1), trial.suggest_float("y", 0, 1)
        study.tell(trial, x + rng.normal(0, 0.02))
    shares = importances(study)
    assert (shares == {}) == (count < FEWEST_TRIALS)
    assert not shares or (sum(shares.values()) == pytest.approx(1.0) and shares["x"] > 0.9)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    root = tmp_path_factory.mktemp("toys")
    return [str(toy_tracker.make_sequence(root / f"s{i}", 0.8 * i)) for i in range(5)]


def test_a_study_is_a_frame(folders: list[str], tmp_path: Path) -> None:
    spec = StudySpec.model_validate({
        "name": "toy", "tracker": TRACKER, "tune": folders[:1], "held_out": folders[1:], "trials": 5, "top": 1,
        "sampler": "random", "sampler_seed": 3, "pruner": "none", "min_coverage": 0.5, "recorded": [],
        "space": {"include": ["gain", "mode", "anger"], "fixed": {"wobble": 0}},
    })  # fmt: skip
    tuner = run_study(spec, results=tmp_path)
    summary = finish(tuner)
    tuner.study.set_user_attr("command", ["/home/x/venv/bin/dynslam-bench", "tune", "run", "my study.toml"])
    page = write_page(tuner, summary).read_text().replace("&#39;", "'")
    assert summary.verdict in page and "dynslam-bench tune run 'my study.toml'" in page
    assert ("Use them" in page) == summary.improves
    assert StudySummary.read(tuner.folder / "summary.json").verdict == summary.conclusion

    frame, trials = Study.open(tuner.folder).frame(), tuner.study.get_trials()
    assert frame.equals(Study.open(spec, tmp_path).frame()) and len(trials) == 5
    assert frame["trial"].tolist() == list(range(5))
    assert frame["state"].tolist() == [trial.state.name.lower() for trial in trials]
    assert frame["value_accuracy"][0] == trials[0].value
    assert frame["ratio"][0] == pytest.approx(math.exp(trials[0].value))
    assert {str(kind) for kind in frame.dtypes} <= {"Int64", "string", "Float64", "boolean"}
    assert frame["params.gain"].tolist() == [trial.params["gain"] for trial in trials]
    complete = frame["state"] == "complete"
    assert frame["feasible"].notna().tolist() == complete.tolist() == frame["reason"].isna().tolist()


def test_a_study_that_is_not_there_is_one_clear_line(tmp_path: Path) -> None:
    for study in (StudySpec(name="none", tune=("a",)), tmp_path):
        with pytest.raises(StudyError, match="no study"):
            Study.open(study, tmp_path)


@pytest.mark.parametrize(
    "content",
    [b"\xff", b"[]", b"{", b'{"name": "../../x", "tune": ["a"]}', b'{"name": "' + b"a" * 300 + b'"}', b"[" * 10**5],
)
def test_a_damaged_stored_study_is_one_clear_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "study.json").write_bytes(content)
    with pytest.raises(StudyError, match=r"study\.json"):
        Study.open(tmp_path)


@pytest.mark.parametrize("value", ["", {}, [1], "x" * 400])
def test_a_storage_that_holds_no_trials_is_one_clear_line(tmp_path: Path, value: object) -> None:
    spec = StudySpec(name="small", tune=("a",))
    study = optuna.create_study(study_name="small", storage=open_storage(tmp_path, spec))
    study.ask().set_user_attr("coverage", value)
    with pytest.raises(StudyError, match="no trial"):
        Study.open(spec, tmp_path).frame()
