"""What a study may conclude: intervals that cover, sentences that do not promise, importances that are none by luck."""

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
from dynslam_bench.tuning.summary import Candidate, Ratio, StudySummary, choose, compared, conclude
from dynslam_bench.tuning.trials import FEWEST_TRIALS, importances, inert_parameters

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
    found = bounds(sample)
    assert found == pytest.approx(stats.t.interval(0.95, 8, sample.mean(), stats.sem(sample)))
    assert upper(sample, 0.975) == pytest.approx(found[1])
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
    for candidates, words in (
        ([lucky, broken], "none of the 2 best trials holds up on 8 runs that no trial had seen (trial 2: ATE x 0.700"),
        ([broken], "trial 3 violates a constraint when run again"),
        ([judged(4, 1, 1, confirm=None, feasible=False, failed="it broke")], "trial 4 failed when run again: it broke"),
        ([], "no trial with other settings came to its end"),
    ):
        text = conclude(candidates, None, [])
        assert text.startswith("Keep the default: ") and words in text


@pytest.mark.parametrize(
    ("chosen", "notes", "start", "words"),
    [
        (
            candidate(0.6, 0.75, 0.9),
            [],
            "Better: trial 7 has 25.0 % less ATE on 6 held-out",
            "may replace the default",
        ),
        (candidate(0.6, 0.75, 0.9), ["same"], "Not better, keep the default", "THE SPLITS ARE NOT APART: same"),
        (candidate(0.7, 0.95, 1.3), [], "Not better, keep the default", "[0.700, 1.300]"),
        (candidate(1.1, 1.54, 2.0), [], "Worse, keep the default: 54.0 % more ATE", "95 % interval"),
        (candidate(1.1, 1.54, 2.0, 4), [], "Worse, keep the default", "rough below five"),
        (candidate(0.1, 0.2, 0.3, 2), [], "Not judged, keep the default", "nothing follows for others"),
        (candidate(0.6, 0.75, 0.9, held_out=None), [], "Not judged, keep the default", "no held-out split"),
        (
            candidate(0.6, 0.75, 0.9, recorded=Ratio(ratio=1.3, low=1.1, high=1.5, n=4, sequences=1)),
            [],
            "Worse on recordings, keep the default: ATE x 1.300 [1.100, 1.500]",
            "0.750",
        ),
        (candidate(0.6, 0.75, 0.9, feasible=False, failed="it broke"), [], "Keep the default", "it broke"),
    ],
)
def test_the_conclusion_is_one_plain_sentence(chosen: Candidate, notes: list[str], start: str, words: str) -> None:
    text = conclude([chosen], chosen.trial, notes)
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
            value=float(x),
            params={"x": x, "mode": mode, "one": 3},
            distributions={
                "x": optuna.distributions.IntDistribution(0, 9),
                "one": optuna.distributions.IntDistribution(0, 9),
                "mode": optuna.distributions.CategoricalDistribution(["a", "b"]),
            },
        )
        for x in range(4)
        for mode in ("a", "b")
    ]
    assert inert_parameters(trials, ["x", "mode", "one", "conditional"]) == ["mode", "one", "conditional"]


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    root = tmp_path_factory.mktemp("toys")
    return [str(toy_tracker.make_sequence(root / f"s{i}", 0.8 * i)) for i in range(5)]


def test_a_study_is_a_frame_and_its_page_tells_what_holds_up(folders: list[str], tmp_path: Path) -> None:
    values = {
        "name": "toy",
        "tracker": TRACKER,
        "tune": folders[:1],
        "held_out": folders[1:],
        "trials": 5,
        "top": 1,
        "sampler_seed": 3,
    }
    values |= {"space": {"include": ["gain", "mode", "anger"], "fixed": {"wobble": 0}}, "sampler": "random"}
    spec = StudySpec.model_validate(values | {"pruner": "none", "min_coverage": 0.5, "recorded": []})
    tuner = run_study(spec, results=tmp_path)
    summary = finish(tuner)
    tuner.study.set_user_attr("command", ["/home/x/venv/bin/dynslam-bench", "tune", "run", "my study.toml"])
    page = write_page(tuner, summary).read_text()
    assert summary.verdict in page.replace("&#39;", "'")
    assert "Reproduce: dynslam-bench tune run 'my study.toml'" in page.replace("&#39;", "'")
    assert ("Use them" in page) == summary.improves
    assert StudySummary.read(tuner.folder / "summary.json").verdict == summary.conclusion

    frame = Study.open(tuner.folder).frame()
    assert frame.equals(Study.open(spec, tmp_path).frame())
    trials = tuner.study.get_trials()
    assert frame["trial"].tolist() == list(range(len(trials))) and len(trials) == 5
    assert frame["state"].tolist() == [trial.state.name.lower() for trial in trials]
    assert frame["value_accuracy"][0] == trials[0].value and frame["ratio"][0] == pytest.approx(
        math.exp(trials[0].value)
    )
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
