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
from scipy import stats
from scipy.stats import mstats

from dynslam_bench.cli.studies import status
from dynslam_bench.core import StudyError, read_settings
from dynslam_bench.core.settings import Parameter
from dynslam_bench.tuning import (
    Outcome,
    ProblemInstance,
    Study,
    StudySpec,
    Verdict,
    finish,
    read_preset_text,
    run_study,
    write_page,
)
from dynslam_bench.tuning.judgement import (
    Candidate,
    Ratio,
    StudySummary,
    beside_default,
    compared,
    judge,
)
from dynslam_bench.tuning.objectives import (
    OBJECTIVES,
    Configuration,
    InstanceFailedError,
    bounds,
    by_scene,
    centre,
    combined_objective,
    detectable,
    own_objective,
    scenes_needed,
    spread_test,
)
from dynslam_bench.tuning.page import fewer_starts, settings_table, warnings_of
from dynslam_bench.tuning.plan import Design, with_more_starts
from dynslam_bench.tuning.storage import FEWEST_TRIALS, importances, open_storage

CONFIRM = Ratio(ratio=0.7, low=0.6, high=0.82, n=8, sequences=4, bound=0.85)


def candidate(
    low: float, ratio: float, high: float, sequences: int = 6, **changes: object
) -> Candidate:
    held = Ratio(ratio=ratio, low=low, high=high, n=2 * sequences, sequences=sequences)
    values = {"trial": 7, "params": {}, "values": [-0.3], "confirm": CONFIRM, "held_out": held}
    return Candidate.model_validate(values | changes)


@pytest.mark.slow
@pytest.mark.parametrize("scenes", [3, 9, 10, 40])
@pytest.mark.parametrize("lost", [0.0, 0.1], ids=["normal", "one in ten is a catastrophe"])
def test_intervals_and_bounds_cover_the_truth(scenes: int, lost: float) -> None:
    rng = np.random.default_rng([scenes, round(10 * lost)])
    rounds = 1500
    truth = math.log(0.8)
    spread = np.where(rng.random((rounds, scenes)) < lost, 1.2, 0.3)
    samples = truth + rng.normal(0, 1, (rounds, scenes)) * spread
    low, high = np.array([bounds(sample) for sample in samples]).T
    assert 0.935 <= ((low <= truth) & (truth <= high)).mean() <= 0.98, (
        "nominal 95 %; more under catastrophes"
    )
    assert 0.005 <= (high < truth).mean() <= 0.035, "nominal 2.5 %"


def test_the_interval_is_students_and_from_ten_on_that_of_the_trimmed_mean() -> None:
    sample, many = (
        np.random.default_rng(seed).normal(size=size) for seed, size in enumerate((9, 20))
    )
    assert bounds(sample) == pytest.approx(
        stats.t.interval(0.95, 8, sample.mean(), stats.sem(sample))
    )
    # 10 % of 20 is whole: SciPy's formula is the same
    error = np.asarray(mstats.winsorize(many, (0.1, 0.1))).std(ddof=1) / (0.8 * math.sqrt(20))
    assert centre(many) == pytest.approx(np.sort(many)[2:18].mean())
    assert bounds(many) == pytest.approx(stats.t.interval(0.95, 15, centre(many), error))


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


def test_few_scenes_have_an_interval_over_starts_that_shows_nothing() -> None:
    starts = [ProblemInstance("s", offset=offset) for offset in range(4)]
    four, one = (
        compared(outcomes(dict.fromkeys(where, 0.01)), outcomes(dict.fromkeys(where, 0.02)))
        for where in (starts, starts[:1])
    )
    assert (four.ratio, four.low, four.high) == pytest.approx((0.5, 0.5, 0.5))
    assert four.sequences == 1
    assert four.n == 4
    assert not four.shows_gain
    assert not four.shows_loss
    assert one.ratio == pytest.approx(0.5)
    assert one.low is None
    assert one.bound is None
    assert not one.shows_gain
    assert Ratio.model_validate_json(one.model_dump_json()) == one


LUCKY = Ratio(ratio=0.9, low=0.6, high=1.3, n=8, sequences=4, bound=1.2, spread=0.3)
WIDE = Ratio(ratio=0.9, low=0.7, high=1.2, n=12, sequences=6, spread=0.3)
TINY = WIDE.model_copy(update={"ratio": 0.994})
SPEED = {"confirm": CONFIRM, "ate_margin": 0.05}


def accuracy(bound: float) -> dict[str, Ratio]:
    return {"accuracy": Ratio(ratio=1.0, low=0.9, high=bound, n=8, sequences=4, bound=bound)}


def test_the_verdict_names_a_baseline_that_is_not_the_default_and_what_the_default_reaches() -> (
    None
):
    best = Candidate(trial=4, params={}, values=[0.0], confirm=CONFIRM, held_out=WIDE)
    assert (
        beside_default("worse.toml", {}, best)
        == beside_default("worse.toml", {"held_out": WIDE}, None)
        == ""
    )
    better, worse = (WIDE.model_copy(update={"ratio": ratio}) for ratio in (0.8, 0.95))
    said = beside_default("worse.toml", {"held_out": better}, best)
    assert (
        said
        == f" Ratios are to worse.toml; the default settings have {better} there, so keep them."
    )
    assert "keep" not in beside_default("worse.toml", {"held_out": worse}, best)


@pytest.mark.parametrize(
    ("changes", "p_value", "verdict", "named"),
    [
        ({}, 0.5, Verdict.PROVEN, "25.0 % less ATE: ATE x 0.750 [0.600, 0.900] on 6 scenes"),
        ({"confirm": LUCKY}, 0.5, Verdict.PROMISING, "upper bound 1.200"),
        ({"confirm": LUCKY}, 0.5, Verdict.PROMISING, "About 62 more scenes would settle it"),
        ({"confirm": LUCKY.model_copy(update={"ratio": 1.07})}, 0.5, Verdict.PROMISING, "nobody can tell how many"),
        ({"held_out": WIDE}, 0.5, Verdict.PROMISING, "About 60 more scenes would settle it"),
        ({"held_out": None}, 0.5, Verdict.PROMISING, "fewer than 3 held-out scenes"),
        ({"confirm": LUCKY, "held_out": WIDE}, 0.5, Verdict.NO_MATTER, "p = 0.50"),
        ({"confirm": LUCKY, "held_out": WIDE}, 0.001, Verdict.PROMISING, "perhaps 10.0 % less"),
        ({"confirm": LUCKY, "held_out": WIDE}, None, Verdict.PROMISING, "perhaps"),
        ({"held_out": WIDE.model_copy(update={"ratio": 1.1})}, 0.001, Verdict.WORSE, "is not better"),
        ({"held_out": WIDE.model_copy(update={"ratio": 1.1})}, 0.24, Verdict.NO_MATTER, "p = 0.24"),
        ({"held_out": WIDE.model_copy(update={"ratio": 1.1})}, None, Verdict.NOT_JUDGED, "cannot tell"),
        ({"held_out": Ratio(ratio=1.5, low=1.1, high=2, n=8, sequences=4)}, 0.5, Verdict.WORSE, "50.0 % more ATE"),
        ({"recorded": Ratio(ratio=1.3, low=1.1, high=1.5, n=4, sequences=1)}, 0.5, Verdict.WORSE, "recordings"),
        ({"held_out": Ratio(ratio=0.98, low=0.96, high=1.001, n=8, sequences=4)}, 0.001, Verdict.NO_MATTER,
         "gains at most 4.0 %"),
        ({"confirm": LUCKY, "held_out": TINY}, 0.001, Verdict.NO_MATTER, "below 5 % is not worth more scenes"),
        ({"held_out": TINY}, 0.001, Verdict.PROMISING, "below 5 % is not worth more scenes"),
        ({"feasible": False}, 0.5, Verdict.WORSE, "constraint"),
        ({**SPEED, "on_confirm": accuracy(1.1)}, 0.5, Verdict.PROMISING, "below 1.05"),
        ({**SPEED, "on_confirm": accuracy(1), "on_held_out": accuracy(1.1)}, 0.5, Verdict.PROMISING, "below 1.05"),
        ({"confirm": None}, 0.5, Verdict.NOT_JUDGED, "no frames are left"),
        ({"confirm": CONFIRM.model_copy(update={"sequences": 2}), "held_out": None}, 0.5, Verdict.NOT_JUDGED,
         "2 scenes only"),
        ({"failed": "it broke"}, 0.5, Verdict.NOT_JUDGED, "it broke"),
    ],
)  # fmt: skip
def test_the_verdict_is_one_of_five_with_the_numbers(
    changes: dict[str, object], p_value: float | None, verdict: Verdict, named: str
) -> None:
    given, text = judge([candidate(0.6, 0.75, 0.9, **changes)], p_value)
    assert (given, text.startswith(verdict.value.capitalize())) == (verdict, True)
    assert named in text
    assert max(len(sentence.split()) for sentence in text.split(". ")) <= 34
    assert judge([])[0] == Verdict.NOT_JUDGED


@pytest.mark.parametrize("effect", [0.0, 0.3])
def test_settings_matter_where_trials_differ_by_more_than_their_scenes(effect: float) -> None:
    def p_value(seed: int) -> float | None:
        rng = np.random.default_rng(seed)
        scenes, trials = rng.normal(0, 1, 6), rng.normal(0, effect, 8)
        table = scenes + trials[:, None] + rng.normal(0, 0.3, (8, 6))
        return spread_test(
            [dict(zip("abcdef"[: 3 + 3 * (row % 2)], table[row], strict=False)) for row in range(8)]
        )

    share = np.mean([p_value(seed) < 0.02 for seed in range(300)])
    assert share <= 0.04 if effect == 0 else share >= 0.7
    assert spread_test([{"a": 1.0, "b": 2.0}, {"a": 1.0, "b": 2.0}]) == 1.0, (
        "settings that change nothing"
    )
    assert spread_test([{"a": 1.0}, {"a": 2.0}]) is None is spread_test([])


@pytest.mark.slow
def test_the_scenes_that_a_gain_needs_are_the_fewest_and_show_it_in_four_of_five_studies() -> None:
    assert [scenes_needed(0.1, 0.24), scenes_needed(0.1, 0.31)] == [43, 70], (
        "measured: 40 to 70 runs"
    )
    gain = detectable(0.25, 8)
    rng = np.random.default_rng(1)
    assert scenes_needed(gain, 0.25) == 8
    assert detectable(0.25, 1) == 1
    for true, share in ((math.log(1 - gain), 0.8), (0.0, 0.025)):
        shown = [bounds(rng.normal(true, 0.25, 8))[1] < 0 for _ in range(1000)]
        assert np.mean(shown) == pytest.approx(share, abs=0.03)


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
    assert ("Use them" in page) == (summary.verdict == Verdict.PROVEN)
    assert StudySummary.read(tuner.folder / "summary.json").conclusion == summary.conclusion
    status(tuner.folder)
    shown = capsys.readouterr().out
    assert summary.best is not None, "status names the trial of best.toml"
    assert summary.conclusion in shown, "status names the trial of best.toml"
    assert re.search(rf"best_trial +{summary.best.trial}\n", shown)

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
        if name != "robustness"
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
    with pytest.raises(StudyError, match="gives 0 on instance"):
        own_objective(lambda run: 0.0).value(default, default)


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
    assert summary.verdict == Verdict.PROVEN
    assert chosen.params == {"wobble": 0}
    assert chosen.held_out.ratio == pytest.approx(0.5)
    assert chosen.on_held_out["accuracy"].ratio == pytest.approx(1.0)


@pytest.mark.slow
def test_speed_that_is_paid_for_with_accuracy_is_no_gain(tmp_path: Path) -> None:
    tuner = TimedTuner(spec(["speed"], ["gain"], pruner="halving"), tmp_path)
    tuner.price = 0.6
    summary = finish(tuner.run())
    assert not summary.candidates[0].chosen
    assert summary.verdict in (Verdict.WORSE, Verdict.PROMISING)
    assert read_settings(tuner.folder / "best.toml") == summary.candidates[0].params, (
        "written with its status"
    )
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
        confirmed, held_out = (
            sum(getattr(candidate, split) is not None for candidate in summary.candidates)
            for split in ("confirm", "held_out")
        )
        complete = len(tuner.study.get_trials(states=(TrialState.COMPLETE,)))
        assert stages == [
            f"tried: {complete} whole trials",
            f"confirmed: {confirmed}",
            f"held out: {held_out}",
        ]
        assert len(browser.run("all('.figure').map((figure) => figure.id)")) >= 6
    finally:
        browser.close()
