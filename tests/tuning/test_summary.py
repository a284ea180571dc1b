"""What a study may conclude: intervals that cover, the choice, conclusions, importances, and its frame."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import optuna
import pytest
from helpers.reports_browser import Browser, needs_browser
from helpers.simulated import SimulatedTuner, make_spec, toy_spec
from optuna.trial import TrialState

from dynslam_bench.cli.studies import status
from dynslam_bench.core import StudyError, read_settings
from dynslam_bench.core.settings import Parameter
from dynslam_bench.evaluation.verdicts import (
    ComparisonVerdict,
    PairedRatio,
    paired_ratio,
    verdict_of,
)
from dynslam_bench.tuning import (
    Outcome,
    ProblemInstance,
    Study,
    StudySpec,
    finish,
    read_preset_text,
    run_study,
    write_page,
)
from dynslam_bench.tuning.judgement import Candidate, StudySummary, conclude, judge, next_step
from dynslam_bench.tuning.objectives import (
    OBJECTIVES,
    Configuration,
    InstanceFailedError,
    by_scene,
    centre,
    combined_objective,
    compare,
    improvement_bound,
    own_objective,
    scene_errors_m,
)
from dynslam_bench.tuning.page import fewer_starts, settings_table, warnings_of
from dynslam_bench.tuning.plan import Design, with_more_starts
from dynslam_bench.tuning.storage import FEWEST_TRIALS, importances, open_storage

SPEC = make_spec(tune=["synthetic/walking_xyz?scene=0-3&frames=20"])


def on_scenes(*ratios: float, lost: Sequence[int] = (), **changes: object) -> PairedRatio:
    """A comparison over scenes with these ratios, of which the candidate lost some."""
    logs = {f"scene {number}": math.log(ratio) for number, ratio in enumerate(ratios)}
    comparison = paired_ratio(logs, [f"scene {number}" for number in lost])
    return comparison.model_copy(update=changes)


GAIN = on_scenes(0.7, 0.72, 0.75, 0.77, 0.8, 0.74)
NOTHING = on_scenes(1.01, 0.99, 1.005, 1.02, 0.98, 0.995)
OPEN = on_scenes(0.4, 1.9, 0.7, 1.5, 0.9, 1.2)
PERHAPS = on_scenes(0.5, 0.6, 0.9, 0.7, 1.3, 0.8, 0.9)
UNSETTLED = on_scenes(*[0.6, 1.05, 0.7] * 4).model_copy(update={"high": 1.02})
LOSS = on_scenes(1.3, 1.4, 1.5, 1.6, 1.2, 1.3)


def candidate(**changes: object) -> Candidate:
    values = {"trial": 7, "params": {}, "values": [-0.3], "held_out": GAIN, "scene_s": 30.0}
    return Candidate.model_validate(values | changes)


def outcome(
    instance: ProblemInstance, ate: float, time: float = 0.03, coverage: float = 1.0
) -> Outcome:
    return Outcome(instance, "", ate, coverage, time, time, 1.0)


def outcomes(errors: Mapping[ProblemInstance, float]) -> dict[ProblemInstance, Outcome]:
    return {instance: outcome(instance, error) for instance, error in errors.items()}


def test_one_lucky_start_of_the_default_decides_nothing() -> None:
    starts = [ProblemInstance("s", offset=offset) for offset in range(3)]
    default = dict(zip(starts, (0.002, 0.02, 0.021), strict=True))
    for same in (starts, starts[:1]):  # no pairing with that luck
        assert by_scene(dict.fromkeys(same, 0.02), default) == {starts[0].scene: pytest.approx(0.0)}


def test_scenes_count_alike_however_many_starts_they_have() -> None:
    many = [ProblemInstance("synthetic/walking_xyz?scene=0", offset=start) for start in range(9)]
    one = ProblemInstance("synthetic/walking_xyz?scene=1")
    ratios = by_scene(dict.fromkeys(many, 0.02) | {one: 0.005}, dict.fromkeys([*many, one], 0.01))
    assert list(ratios.values()) == [pytest.approx(math.log(2)), pytest.approx(-math.log(2))]
    assert centre(ratios.values()) == pytest.approx(0.0)


def test_starts_of_one_scene_are_one_value_and_claim_nothing() -> None:
    starts = [ProblemInstance("s", offset=offset) for offset in range(8)]
    one = compare(outcomes(dict.fromkeys(starts, 0.01)), outcomes(dict.fromkeys(starts, 0.02)))
    assert one.ratio == pytest.approx(0.5)
    assert one.scenes == 1
    assert one.runs == 8
    assert one.low is None
    assert verdict_of(one) is ComparisonVerdict.CANNOT_TELL
    assert PairedRatio.model_validate_json(one.model_dump_json()) == one


@pytest.mark.parametrize(("lost_starts", "is_lost"), [(1, False), (2, True), (4, True)])
def test_a_scene_is_lost_where_half_of_its_starts_are(lost_starts: int, is_lost: bool) -> None:
    starts = [ProblemInstance("s", offset=offset) for offset in range(4)]
    runs = outcomes(dict.fromkeys(starts, 0.01))
    for start in starts[:lost_starts]:
        runs[start] = replace(runs[start], lost=True)
    compared = compare(runs, outcomes(dict.fromkeys(starts, 0.02)))
    assert compared.lost == ((starts[0].scene,) if is_lost else ())
    assert compared.scenes == (0 if is_lost else 1)


WIDE_ACCURACY = {"accuracy": on_scenes(0.9, 1.1, 1.3, 0.8, 1.2, 1.0)}
CLOSE_ACCURACY = {"accuracy": NOTHING}


@pytest.mark.parametrize(
    ("changes", "verdict", "said"),
    [
        ({}, ComparisonVerdict.PROVEN, "less ATE: ATE x 0.745 [0.700, 0.800] on 6 scenes"),
        ({"held_out": NOTHING}, ComparisonVerdict.NO_DIFFERENCE, "Differences above"),
        ({"held_out": OPEN}, ComparisonVerdict.CANNOT_TELL, "in a new study would settle it"),
        ({"held_out": PERHAPS}, ComparisonVerdict.PROMISING, "perhaps"),
        ({"held_out": LOSS}, ComparisonVerdict.WORSE, "more ATE"),
        ({"held_out": on_scenes(0.7, 0.72)}, ComparisonVerdict.CANNOT_TELL, "6 are the fewest"),
        (
            {"held_out": on_scenes(*[0.7] * 9, lost=[8])},
            ComparisonVerdict.BUT_LOST,
            "lost in 1 of 9 scenes",
        ),
        (
            {"held_out": on_scenes(*[0.7] * 9, lost=range(9))},
            ComparisonVerdict.WORSE,
            "none of 9 scenes",
        ),
        ({"feasible": False}, ComparisonVerdict.CANNOT_TELL, "violates a constraint"),
        (
            {"ate_margin": 0.05, "on_held_out": WIDE_ACCURACY},
            ComparisonVerdict.PROMISING,
            "below 1.05",
        ),
        ({"ate_margin": 0.05, "on_held_out": CLOSE_ACCURACY}, ComparisonVerdict.PROVEN, "less"),
        (
            {"ate_margin": 0.05, "on_held_out": {"accuracy": LOSS}},
            ComparisonVerdict.CANNOT_TELL,
            "below 1.05",
        ),
        (
            {"held_out": PERHAPS, "ate_margin": 0.05, "on_held_out": {"accuracy": LOSS}},
            ComparisonVerdict.CANNOT_TELL,
            "below 1.05",
        ),
        ({"held_out": None, "confirm": GAIN}, ComparisonVerdict.PROVEN, "less"),
        ({"held_out": None}, ComparisonVerdict.CANNOT_TELL, "no frames are left"),
        ({"failed": "it broke"}, ComparisonVerdict.CANNOT_TELL, "it broke"),
    ],
)
def test_the_conclusion_says_the_verdict_with_its_numbers(
    changes: dict[str, object], verdict: ComparisonVerdict, said: str
) -> None:
    given, text = conclude(SPEC, [candidate(**changes)], [{str(n): 0.1 * n for n in range(6)}])
    assert given is verdict
    assert text.startswith(f"{verdict.value.capitalize()}: ")
    assert said in text
    assert max(len(sentence.split()) for sentence in text.split(". ")) <= 34


def test_the_worst_scenes_rank_trials_and_all_scenes_judge_them() -> None:
    """Chosen by the candidate's own ratios, the worst quarter would always be worse."""
    rng = np.random.default_rng(0)
    instances = [ProblemInstance(f"synthetic/walking_xyz?scene={100 + n}") for n in range(28)]
    errors = [dict(zip(instances, rng.lognormal(-4, 0.3, 28), strict=True)) for _ in range(2)]
    compared = compare(outcomes(errors[0]), outcomes(errors[1]), objective=OBJECTIVES["worst"])
    assert compared.scenes == 28
    assert compared.what == "ATE"
    assert verdict_of(compared) is not ComparisonVerdict.WORSE


def test_frames_lost_are_a_value_of_the_coverage_objective() -> None:
    instances = [ProblemInstance(f"synthetic/walking_xyz?scene={100 + n}") for n in range(8)]
    tracked = outcomes(dict.fromkeys(instances, 0.01))
    lost = {at: replace(run, coverage=0.2, lost=True) for at, run in tracked.items()}
    compared = compare(tracked, lost, objective=OBJECTIVES["coverage"])
    assert compared.scenes == 8
    assert verdict_of(compared) is ComparisonVerdict.PROVEN


def test_no_trial_and_failed_trials_cannot_tell() -> None:
    assert judge(None)[0] is ComparisonVerdict.CANNOT_TELL
    _, text = conclude(SPEC, [], failures=["crashed: no memory", "crashed"])
    assert "2 trials failed, the first one as crashed: no memory" in text
    # so where a program refuses a part of the range, and other trials did better
    _, text = conclude(SPEC, [candidate()], failures=["crashed: n above 5000"])
    assert "1 trial failed: crashed: n above 5000" in text


def test_settings_without_any_effect_are_named() -> None:
    verdict, text = conclude(SPEC, [candidate()], inert=3)
    assert verdict is ComparisonVerdict.NO_DIFFERENCE
    assert "All 3 trials with other settings have the baseline's trajectories" in text


def test_an_extendable_study_names_the_command_of_its_next_look() -> None:
    spec = make_spec(tune=["synthetic/walking_xyz?scene=0-3&frames=20"], extendable=True)
    _, text = conclude(spec, [candidate(held_out=UNSETTLED)])
    assert "dynslam-bench tune extend STUDY.toml --scenes 12" in text
    _, text = conclude(SPEC, [candidate(held_out=UNSETTLED)])
    assert "a new study" in text
    assert "extend STUDY" not in text


def test_the_conclusion_names_a_baseline_that_is_not_the_default_and_what_the_default_reaches() -> (
    None
):
    spec = make_spec(tune=["synthetic/walking_xyz?scene=0-3&frames=20"], baseline="worse.toml")
    better = on_scenes(0.6, 0.6, 0.6, 0.6, 0.6, 0.6)
    _, text = conclude(spec, [candidate()], shipped=better)
    assert (
        f"Ratios are to worse.toml; the default settings have {better} there, so keep them" in text
    )
    _, text = conclude(spec, [candidate()], shipped=NOTHING)
    assert "keep them" not in text


def test_none_of_the_trials_is_better_by_more_than_the_largest_bound() -> None:
    """The bound is false in at most 5 % however many trials there are, and names how many it holds for."""
    rng = np.random.default_rng(0)
    true = math.log(0.9)
    false = 0
    for _ in range(400):
        trials = [dict(enumerate(rng.normal(true, 0.3, 8).tolist())) for _ in range(3)]
        bound = improvement_bound(
            [{str(at): value for at, value in trial.items()} for trial in trials]
        )
        assert bound is not None
        assert bound[1] == 3
        false += bound[0] < 0.1
    assert false / 400 <= 0.07
    assert improvement_bound([{"a": -1.0, "b": -1.0}]) is None


@pytest.mark.slow
@pytest.mark.parametrize("count", [FEWEST_TRIALS - 1, 60])
def test_importances_are_optunas_from_enough_trials_on(count: int) -> None:
    spans = dict.fromkeys("xy", optuna.distributions.FloatDistribution(0, 1))
    rng = np.random.default_rng(0)
    study = optuna.create_study()
    for number, (x, y) in enumerate(rng.random((count, 2)).tolist()):
        kind = {"state": TrialState.PRUNED} if number % 2 else {"value": x}
        attributes = {"scenes": {"s": x + rng.normal(0, 0.02)}}
        params = {"params": {"x": x, "y": y}, "distributions": spans, "intermediate_values": {0: x}}
        study.add_trial(optuna.trial.create_trial(user_attrs=attributes, **params, **kind))
    shares = importances(study)
    assert (shares == {}) == (count < FEWEST_TRIALS)
    if shares:
        assert sum(importance.share for importance in shares.values()) == pytest.approx(1.0)
        assert shares["x"].share > 0.9
        assert shares["x"].low > shares["y"].share
        assert all(0 <= importance.low <= importance.high <= 1 for importance in shares.values())


@pytest.mark.slow
def test_a_study_is_a_frame(
    folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = toy_spec(
        tune=folders[:1], held_out=folders[1:2], trials=5, top=1, sampler_seed=3, min_coverage=0.5,
        space={"include": ["gain", "mode", "anger"], "fixed": {"wobble": 0}},
    )  # fmt: skip
    tuner = run_study(spec, results=tmp_path)
    summary = finish(tuner)
    tuner.study.set_user_attr(
        "command", ["/home/x/venv/bin/dynslam-bench", "tune", "run", "my study.toml"]
    )
    page = write_page(tuner, summary).read_text().replace("&#39;", "'")
    assert summary.conclusion in page
    assert "dynslam-bench tune run 'my study.toml'" in page
    assert ("Use them" in page) == summary.is_to_use
    assert StudySummary.read(tuner.folder / "summary.json").conclusion == summary.conclusion
    status(tuner.folder)
    shown = capsys.readouterr().out
    assert summary.best is not None, "status names the trial of best.toml"
    assert summary.conclusion in shown, "status names the trial of best.toml"
    assert re.search(rf"best_trial +{summary.best.trial}\n", shown)
    assert bool(re.search(r"^setting +value", shown, re.MULTILINE)) == bool(summary.offered)

    frame = Study.open(tuner.folder).frame()
    trials = tuner.study.get_trials()
    assert frame.equals(Study.open(spec, tmp_path).frame())
    assert len(trials) == 5
    assert frame["trial"].tolist() == list(range(5))
    assert frame["state"].tolist() == [trial.state.name.lower() for trial in trials]
    assert frame["value_accuracy"][0] == trials[0].value
    assert frame["ratio"][0] == pytest.approx(math.exp(trials[0].value))
    assert {str(kind) for kind in frame.dtypes} <= {"Int64", "string", "Float64", "boolean"}
    assert frame["params.gain"].tolist() == [trial.params["gain"] for trial in trials]
    complete = frame["state"] == "complete"
    assert (
        frame["feasible"].notna().tolist() == complete.tolist() == frame["reason"].isna().tolist()
    )


@pytest.mark.parametrize(
    "content",
    [
        b"\xff",
        b"[]",
        b"{",
        b'{"name": "../../x", "tune": ["a"]}',
        b'{"name": "' + b"a" * 300 + b'"}',
        b"[" * 10**5,
    ],
)
def test_a_damaged_stored_study_is_one_clear_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "study.json").write_bytes(content)
    with pytest.raises(StudyError, match=r"study\.json"):
        Study.open(tmp_path)


@pytest.mark.parametrize("value", ["", {}, [1], "x" * 400])
def test_a_storage_that_holds_no_trials_is_one_clear_line(tmp_path: Path, value: object) -> None:
    spec = StudySpec(name="small", tune=("a",))
    optuna.create_study(
        study_name="small", storage=open_storage(tmp_path, spec)
    ).ask().set_user_attr("coverage", value)
    with pytest.raises(StudyError, match="no trial"):
        Study.open(spec, tmp_path).frame()


PLAIN = [ProblemInstance(f"synthetic/walking_xyz?scene={scene}") for scene in range(4)]
BLURRED = replace(PLAIN[0], degradation=(("blur", 0.5),))


def test_objectives_are_logarithms_of_ratios_by_hand() -> None:
    default = {instance: outcome(instance, 0.02) for instance in [*PLAIN, BLURRED]}
    tuned = {
        instance: outcome(instance, 0.01 * (1 + scene), 0.015, 0.98)
        for scene, instance in enumerate(PLAIN)
    }
    values = {
        name: each.value(tuned, default)
        for name, each in OBJECTIVES.items()
        if name in ("accuracy", "speed", "worst", "coverage")
    }
    assert values["accuracy"] == pytest.approx(sum(math.log(n / 2) for n in (1, 2, 3, 4)) / 4)
    assert values["speed"] == pytest.approx(math.log(0.5))
    assert values["worst"] == pytest.approx(math.log(2)), "the worst of four scenes"
    assert values["coverage"] == pytest.approx(math.log(3)), "2 % more lost, beside a floor of 1 %"
    blurred = {**tuned, BLURRED: outcome(BLURRED, 0.06)}
    assert OBJECTIVES["robustness"].value(blurred, default) == pytest.approx(math.log(3))
    balance = combined_objective([OBJECTIVES["accuracy"], OBJECTIVES["speed"]])
    assert balance.value(tuned, default) == pytest.approx(
        (values["accuracy"] + values["speed"]) / 2
    )


def test_what_cannot_be_an_objective_is_refused() -> None:
    default = {instance: outcome(instance, 0.02) for instance in PLAIN}
    with pytest.raises(StudyError, match="'robustness' counts degraded instances alone"):
        OBJECTIVES["robustness"].value(default, default)
    for given, shown in ((0.0, "0.0"), (None, "None"), ("fast", "'fast'"), (math.nan, "nan")):
        with pytest.raises(StudyError, match=f"gives {shown} on instance"):
            own_objective(lambda run, given=given: given).value(default, default)


class TimedTuner(SimulatedTuner):
    """`wobble` takes time and leaves the poses alone; a smaller `gain` saves time and may cost accuracy."""

    price = 0.0

    def outcomes(
        self, settings: Mapping[str, Any], instances: Sequence[ProblemInstance], **how: Any
    ) -> Any:
        gain = float(settings.get("gain", 1.5))
        wobble = int(settings.get("wobble", 2))
        time = 0.02 * (0.5 + 0.25 * wobble) * gain
        cost = math.exp(self.price * max(0.0, 1.5 - gain))
        runs = super().outcomes({"gain": gain}, instances, **how)
        return {
            instance: replace(run, ate_m=run.ate_m * cost, processor_s=time)
            for instance, run in runs.items()
        }


def spec(objectives: list[str], include: list[str], **changes: object):
    return make_spec(
        **{"objectives": objectives, "space": {"include": include}, "trials": 14, "top": 3}
        | changes
    )


@pytest.mark.slow
def test_speed_decides_where_the_poses_stay_as_they_are(tmp_path: Path) -> None:
    tuner = TimedTuner(spec(["speed"], ["wobble"], pruner="halving"), tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # a constraint is told once, when it is final
        tuner.run()
    summary = finish(tuner)
    chosen = summary.candidates[0]
    assert summary.verdict == ComparisonVerdict.PROVEN
    assert chosen.params == {"wobble": 0}
    assert chosen.held_out.ratio == pytest.approx(0.5)
    assert chosen.on_held_out["accuracy"].ratio == pytest.approx(1.0)


@pytest.mark.slow
def test_speed_that_is_paid_for_with_accuracy_is_no_gain(tmp_path: Path) -> None:
    tuner = TimedTuner(spec(["speed"], ["gain"], pruner="halving"), tmp_path)
    tuner.price = 0.6
    summary = finish(tuner.run())
    assert not summary.is_to_use
    assert summary.verdict in (
        ComparisonVerdict.PROMISING,
        ComparisonVerdict.CANNOT_TELL,
        ComparisonVerdict.WORSE,
    )
    offered = summary.verdict is ComparisonVerdict.PROMISING
    expected = summary.candidates[0].params if offered else {}
    assert read_settings(tuner.folder / "best.toml") == expected, "written with its status"
    assert f'status = "{summary.verdict.value}"' in (tuner.folder / "best.toml").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("objectives", [["accuracy", "speed"], ["speed", "accuracy"]])
def test_the_best_of_a_front_is_the_best_in_all_objectives_together(
    objectives: list[str], tmp_path: Path
) -> None:
    study = spec(objectives, ["wobble"], space={"include": ["wobble"], "fixed": {"mode": "fine"}})
    tuner = TimedTuner(study, tmp_path, in_memory=False)
    summary = finish(tuner.run())
    assert summary.best.params == {"wobble": 0} == read_settings(tuner.folder / "best.toml")
    assert 'mode = "fine"' in read_preset_text(study, tmp_path), "what the study fixed is a comment"
    assert "<h3>Pareto front</h3>" in write_page(tuner, summary).read_text()


class DriftingTuner(SimulatedTuner):
    """A machine that slows down with every run, and settings that change nothing; a gain of 13 breaks."""

    calls = 0

    def outcomes(
        self, settings: Mapping[str, Any], instances: Sequence[ProblemInstance], **how: Any
    ) -> Any:
        if settings.get("gain") == 13.0:
            raise InstanceFailedError(f"{instances[0]}: crashed")
        drawn = {}
        for instance in instances:
            self.calls += 1
            drawn[instance] = Outcome(
                instance, "", 0.02, 1.0, 0.03, 0.03 * 1.02 ** (self.calls / 2), 1.0
            )
        return drawn


def test_a_machine_that_slows_down_decides_nothing(tmp_path: Path) -> None:
    tuner = DriftingTuner(make_spec(objectives=["speed"]), tmp_path)
    instances = tuner.design.held_out
    speed = OBJECTIVES["speed"]
    configurations = [Configuration("", {"gain": gain}) for gain in (1.1, 13.0)]
    default, (same, broken) = tuner.evaluate_beside(configurations, instances)
    assert isinstance(broken, InstanceFailedError)
    assert list(default) == list(instances) == list(same)
    assert speed.value(same, default) == pytest.approx(math.log(1.01), abs=0.002), "one run apart"
    apart = [tuner.outcomes(settings, instances) for settings in ({}, {"gain": 1.1})]
    assert speed.value(apart[1], apart[0]) > 0.2, "all of one after all of the other"


SPACE = [
    Parameter("a.threshold", "float", 1.0, 0.1, 10.0, "log", unit="px"),
    Parameter("a.mode", "categorical", "fast", choices=("fast", "slow")),
]


def tuner_of(study: optuna.Study, objective: str = "accuracy") -> Study:
    return cast(
        "Study", SimpleNamespace(study=study, spec=SimpleNamespace(objectives=(objective,)))
    )


@pytest.mark.parametrize("offsets", [(0,), (0, 1), (0, 1, 2), (0, 1, 2, 3)])
def test_a_default_of_more_starts_than_the_trials_is_explained(offsets: tuple[int, ...]) -> None:
    tune = tuple(
        ProblemInstance("synthetic/walking_xyz?scene=0", offset=offset) for offset in offsets
    )
    assert bool(fewer_starts(Design(tune, tuple(with_more_starts(tune)), (), (), ()))) == (
        len(offsets) < 3
    )


@pytest.mark.parametrize(
    ("values", "count"), [((0.01, 0.02, 0.03), 3), ((-0.01, 0.02, 0.03), 2), ((-1, -1, -1), 0)]
)
def test_infeasible_trials_are_counted(values: tuple[float, ...], count: int) -> None:
    study = optuna.create_study()
    for value in values:
        trial = study.ask()
        trial.set_constraint("ate", value)
        study.tell(trial, 1.0)
    notes = [note for note in warnings_of(tuner_of(study)) if "constraint" in note]
    assert len(notes) == (count > 0)
    assert all(str(count) in note for note in notes)


def test_times_of_trials_are_called_unpaired() -> None:
    speed, accuracy = (
        warnings_of(tuner_of(optuna.create_study(), name)) for name in ("speed", "accuracy")
    )
    assert set(accuracy) < set(speed)


def test_the_table_holds_default_chosen_and_range() -> None:
    default: dict[str, Any] = {"a.threshold": 1.0, "a.mode": "fast"}
    table = settings_table(SPACE, default, {"a.threshold": 3.0, "a.mode": "slow"}, True)
    assert [
        [column.name for column in table.columns],
        *([cell.text for cell in row] for row in table.rows),
    ] == [
        ["setting", "baseline", "best trial", "range", "unit"],
        ["a.threshold", "1", "3", "0.1 to 10, log", "px"],
        ["a.mode", "fast", "slow", "fast, slow", ""],
    ]
    unproven = settings_table(SPACE, default, {}, False)
    assert unproven.rows[0][2].text == "–"
    assert "keep the baseline" in unproven.caption


def test_errors_by_scene_divide_to_the_ratios_that_judge() -> None:
    instances = [
        ProblemInstance(f"synthetic/walking_xyz?scene={scene}", offset=offset)
        for scene in range(6)
        for offset in range(3)
    ]
    rng = np.random.default_rng(3)
    baseline = outcomes(
        {
            each: float(error)
            for each, error in zip(instances, rng.uniform(0.01, 0.1, 18), strict=True)
        }
    )
    tried = outcomes(
        {
            each: float(error)
            for each, error in zip(instances, rng.uniform(0.01, 0.1, 18), strict=True)
        }
    )
    ratios = by_scene(
        {each: run.ate_m for each, run in tried.items()},
        {each: run.ate_m for each, run in baseline.items()},
    )
    tried_m = scene_errors_m(tried)
    baseline_m = scene_errors_m(baseline)
    for scene, ratio in ratios.items():
        assert math.log(tried_m[scene] / baseline_m[scene]) == pytest.approx(ratio)


def test_a_finished_study_keeps_the_errors_of_each_judging_scene(tmp_path: Path) -> None:
    tuner = SimulatedTuner(make_spec(trials=6), tmp_path).run()
    best = finish(tuner).best
    assert best is not None
    assert best.evidence is not None
    assert len(best.scene_errors) == best.evidence.all_scenes
    assert all(scene.baseline_m > 0 and scene.candidate_m > 0 for scene in best.scene_errors)
    # `summary.json` keeps them
    stored = StudySummary.read(tuner.folder / "summary.json").best
    assert stored is not None
    assert stored.scene_errors == best.scene_errors


@pytest.mark.parametrize(
    ("verdict", "evidence", "extendable", "wanted"),
    [
        (ComparisonVerdict.PROVEN, on_scenes(*[0.5] * 12), False, "--settings best.toml"),
        (ComparisonVerdict.WORSE, on_scenes(*[2.0] * 12), False, "run toy SEQUENCE"),
        (ComparisonVerdict.NO_DIFFERENCE, on_scenes(*[1.0] * 12), False, "run toy SEQUENCE"),
        (ComparisonVerdict.PROMISING, UNSETTLED, True, "--scenes 12"),
        (
            ComparisonVerdict.CANNOT_TELL,
            on_scenes(0.8, 0.9, 0.7, 1.2, 0.9, 1.1, 0.8, 0.95),
            False,
            "tune run",
        ),
        (
            ComparisonVerdict.BUT_LOST,
            on_scenes(*[0.5] * 12, lost=[3]),
            False,
            "'scene 3' --settings best.toml --snapshots",
        ),
    ],
)
def test_every_verdict_has_a_command_to_go_on_with(
    verdict: ComparisonVerdict, evidence: PairedRatio, extendable: bool, wanted: str
) -> None:
    spec = make_spec(extendable=extendable)
    summary = StudySummary(
        name="study",
        tracker="toy",
        baseline="default settings",
        protocol="",
        trials={},
        candidates=[candidate(held_out=evidence)],
        verdict=verdict,
        conclusion="",
        held_out=["scene 0"],
    )
    configuration = Configuration("toy", {})
    _, command = next_step(spec, summary, configuration, configuration)
    assert wanted in command


@pytest.mark.slow
@needs_browser
def test_the_page_shows_verdict_funnel_and_optunas_plots(tmp_path: Path) -> None:
    tuner = SimulatedTuner(make_spec(trials=12), tmp_path).run()
    summary = finish(tuner)
    page = write_page(tuner, summary)
    browser = Browser(tmp_path / "profile")
    try:
        for width in (1440, 390):
            browser.open(page, width)
            browser.run("all('.figure').forEach((figure) => figure.scrollIntoView())")
            browser.until("all('.figure').every((figure) => figure.querySelector('.main-svg'))")
            assert browser.faults == []
            assert browser.run("document.documentElement.scrollWidth") == width
        assert browser.violations() == []
        assert browser.run("one('.verdict').textContent") == summary.conclusion
        stages = browser.run("byId('result-1').layout.xaxis.ticktext")
        # trial 0 has the baseline's settings
        complete = len(tuner.study.get_trials(states=(TrialState.COMPLETE,))) - 1
        assert stages == [
            f"tried: {complete} whole trials",
            "held out: 1",
        ]
        assert len(browser.run("all('.figure').map((figure) => figure.id)")) >= 6
    finally:
        browser.close()
