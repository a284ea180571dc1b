"""Before and after a study's run: what it could show, baselines, earlier studies, ask and tell, extensions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import optuna
import pytest
import simulated
import toy_tracker
from optuna.trial import TrialState
from simulated import SimulatedTuner, make_spec, valley

from dynslam_bench.cli.studies import status
from dynslam_bench.core.errors import DynslamError, StudyError
from dynslam_bench.core.toml import read_settings
from dynslam_bench.tuning import Plan, StudySpec, Verdict, finish, read_preset_text, run_study, write_page
from dynslam_bench.tuning.objectives import InstanceFailedError, Outcome
from dynslam_bench.tuning.storage import EARLIER, best_trials, importances
from dynslam_bench.tuning.study_file import ProblemInstance, SpaceSpec

TRACKER = f"{toy_tracker.__file__}:SPEC"


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    root = tmp_path_factory.mktemp("toys")
    return [str(toy_tracker.make_sequence(root / f"s{i}", 0.8 * i)) for i in range(7)]


def make(folders: list[str], **changes: object) -> StudySpec:
    values: dict[str, object] = {
        "name": "toy", "tracker": TRACKER, "tune": folders[:1], "confirm": folders[1:4], "held_out": folders[4:],
        "trials": 2, "space": {"include": ["gain"]}, "offsets": [0], "pruner": "none", "min_coverage": None,
        "recorded": [], "sampler": "random",
    }  # fmt: skip
    return StudySpec.model_validate({**values, **changes})


def test_a_preview_takes_what_stored_runs_show_and_else_what_is_known(folders: list[str], tmp_path: Path) -> None:
    before = Plan(make(folders), tmp_path).preview()
    assert before.runs == 0 and before.spread == pytest.approx(simulated.STARTS_SD, abs=0.05) and before.scenes == 3
    assert not (tmp_path / "studies").exists(), "looking makes no study"
    run_study(make(folders), results=tmp_path)
    after = Plan(make(folders), tmp_path).preview(jobs=2)
    assert after.runs == 3 and after.spread != before.spread and after.minutes != before.minutes
    assert after.unused == {} and "10 %" in after.figures[0] and "3 stored runs" in after.figures[0]


def test_a_preview_names_the_settings_of_parts_that_decide_nothing(tmp_path: Path) -> None:
    """The camera of `sitting_static` hardly moves, so that F is never used; nobody stands in the way of an oracle."""
    spec = StudySpec(
        name="s", tracker="emfoa-oft?masks=none", recorded=(), offsets=(0,),
        tune=("synthetic/sitting_static?scene=0&frames=8",),
        space={"include": ["epipolar.*", "features.fast_threshold"]},
    )  # fmt: skip
    plan = Plan(spec, tmp_path)
    assert plan.preview().unused == {}, "no run is stored"
    from dynslam_bench.tuning import Study

    Study(spec, tmp_path).reference()
    preview = plan.preview()
    assert {name.split(".")[0] for name in preview.unused} == {"epipolar"}
    assert preview.include == ["features.fast_threshold"] and preview.include[0] in preview.proposal[-1]
    alone = spec.model_copy(update={"space": SpaceSpec(include=("epipolar.*",))})
    assert Plan(alone, tmp_path).preview().proposal[-1] == "Nothing would be left of the space without them."


def test_ratios_are_to_the_baseline_and_the_default_stands_beside(folders: list[str], tmp_path: Path) -> None:
    preset = tmp_path / "mine.toml"
    preset.write_text("gain = 3.0\nwobble = 0\n")
    spec = make(folders, baseline=str(preset), trials=6, space={"include": ["gain"], "fixed": {"mode": "fine"}})
    tuner = run_study(spec, results=tmp_path)
    assert tuner.study.get_trials()[0].params == {"gain": 3.0}, "trial 0 is the baseline"
    assert tuner.configuration_of(tuner.study.get_trials()[1]).settings["wobble"] == 0, "trials build on it"
    summary = finish(tuner)
    assert set(summary.shipped) == {"confirm", "held_out"} and summary.baseline == str(preset)
    assert summary.shipped["held_out"].ratio == pytest.approx(0.25, abs=0.1), "errors of 50 % against 200 %"
    assert summary.verdict == Verdict.PROVEN
    best = tuner.folder / "best.toml"
    assert read_settings(best) == {**summary.candidates[0].params, "wobble": 0}
    assert 'status = "proven"' in best.read_text() and "default settings" in write_page(tuner, summary).read_text()
    preset.write_text("gain = 2.0\n")
    with pytest.raises(StudyError, match="stored with other baseline"):
        run_study(spec, results=tmp_path)


def test_the_baseline_may_be_another_tracker(folders: list[str], tmp_path: Path) -> None:
    tuner = run_study(make(folders, baseline="never-move", trials=3), results=tmp_path)
    summary = finish(tuner)
    assert summary.baseline == "never-move" and summary.verdict == Verdict.PROVEN
    assert {0} <= {trial.number for trial in best_trials(tuner.study, 3)}
    assert summary.shipped["confirm"].ratio < 1


@pytest.mark.parametrize(
    ("baseline", "named"), [("nobody", "unknown tracker"), ("none.toml", "none.toml"), ("far.toml", "'gain' is 99")]
)
def test_a_baseline_that_cannot_be_is_one_clear_line(
    baseline: str, named: str, folders: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("far.toml").write_text("gain = 99.0\n")
    with pytest.raises(DynslamError, match=named):
        Plan(make(folders, baseline=baseline), tmp_path)


@pytest.fixture
def earlier(tmp_path: Path) -> Iterator[SimulatedTuner]:
    tuner = SimulatedTuner(make_spec(name="first", trials=8, pruner="none"), tmp_path, effect=valley, in_memory=False)
    tuner.run()
    yield tuner


def test_a_study_begins_with_what_an_earlier_one_learnt(earlier: SimulatedTuner, tmp_path: Path) -> None:
    spec = make_spec(name="second", trials=5, pruner="none", start=[str(earlier.folder), {"gain": 0.9}])
    tuner = SimulatedTuner(spec, tmp_path, effect=valley, in_memory=False)
    trials = tuner.run().study.get_trials()
    taken = [trial for trial in trials if EARLIER in trial.user_attrs]
    assert len(taken) == 8 and {trial.user_attrs[EARLIER] for trial in taken} == {"study first"}
    own = [trial for trial in trials if EARLIER not in trial.user_attrs]
    assert len(own) == 5 and own[0].params == {"gain": 1.5, "wobble": 2}
    tried = [trial.params for trial in own[1:4]]
    assert {"gain": 0.9, "wobble": 2} in tried and all(trial.params in tried for trial in best_trials(earlier.study, 2))
    assert not any(trial in taken for trial in best_trials(tuner.study, 9)), "an earlier trial is no candidate"
    assert importances(tuner.study) == {}
    resumed = SimulatedTuner(spec, tmp_path, effect=valley, in_memory=False)
    assert len(resumed.run().study.get_trials()) == len(trials)


def test_trials_of_other_code_are_marked(
    earlier: SimulatedTuner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SimulatedTuner, "_identify", lambda self: {"code": "newer"})
    tuner = SimulatedTuner(make_spec(name="second", start=[str(earlier.folder)]), tmp_path, in_memory=False)
    marks = {trial.user_attrs[EARLIER] for trial in tuner.study.get_trials() if EARLIER in trial.user_attrs}
    assert marks == {"study first, other code"}
    with pytest.raises(StudyError, match="'first' has other objectives"):
        SimulatedTuner(make_spec(name="third", start=[str(earlier.folder)], objectives=["speed"]), tmp_path)
    with pytest.raises(StudyError, match="holds no study"):
        SimulatedTuner(make_spec(name="third", start=[str(tmp_path)]), tmp_path)


def test_trials_may_be_asked_for_and_told_one_by_one(tmp_path: Path) -> None:
    tuner = SimulatedTuner(make_spec(pruner="none"), tmp_path, effect=valley)
    values: list[Any] = []
    for gain in (1.0, 2.0, 0.5):
        trial = tuner.ask({"gain": gain})
        evaluation = tuner.evaluate(trial)
        tuner.tell(trial, evaluation)
        values.append((trial.params["gain"], evaluation.state))
    assert [gain for gain, _ in values] == [1.5, 1.0, 2.0], "the baseline is the first"
    assert {state for _, state in values} == {TrialState.COMPLETE}
    assert len(tuner.run().study.get_trials()) == 12, "the rest follows, with those that wait"
    with pytest.raises(StudyError, match="gain = 99"):
        tuner.ask({"gain": 99.0})


def test_an_extended_study_goes_on_with_more_scenes_and_trials(tmp_path: Path) -> None:
    spec = make_spec(trials=4, pruner="none")
    tuner = SimulatedTuner(spec, tmp_path, effect=valley, in_memory=False)
    tuner.run()
    tuner.extend(scenes=3, trials=2)
    again = SimulatedTuner(spec, tmp_path, effect=valley, in_memory=False)
    assert len(again.run().study.get_trials()) == 6 == again.trials
    summary = finish(again)
    assert (len(summary.confirm), len(summary.held_out)) == ((18 + 3) * 2, (8 + 3) * 3)
    again.extend(scenes=1)
    assert again.extension == {"scenes": 4, "trials": 2}
    with pytest.raises(StudyError, match="further scenes cannot be made"):
        again.extend(scenes=200)
    assert again.extension["scenes"] == 4


def test_any_trial_is_a_preset(tmp_path: Path) -> None:
    spec = make_spec(trials=4, pruner="none")
    tuner = SimulatedTuner(spec, tmp_path, in_memory=False)
    trial = tuner.run().study.get_trials()[2]
    text = read_preset_text(spec, tmp_path, trial=2)
    (tmp_path / "two.toml").write_text(text)
    assert read_settings(tmp_path / "two.toml") == trial.params and 'status = "not judged"' in text
    with pytest.raises(StudyError, match="no trial 9"):
        read_preset_text(spec, tmp_path, trial=9)


def test_a_pruned_trial_is_a_preset_too(folders: list[str], tmp_path: Path) -> None:
    spec = make(folders, trials=2, start=[{"gain": 3.0}], tune=folders[:5], confirm=[], held_out=[], pruner="wilcoxon")
    trial = run_study(spec, results=tmp_path).study.get_trials()[1]
    assert trial.state == TrialState.PRUNED and trial.params == {"gain": 3.0}
    text = read_preset_text(spec, tmp_path, trial=1)
    assert "gain = 3.0" in text and 'status = "not judged"' in text


def test_a_baseline_that_crashes_is_one_clear_line(folders: list[str], tmp_path: Path) -> None:
    (tmp_path / "crash.toml").write_text('mode = "crash"\n')
    with pytest.raises(StudyError, match=r"the baseline fails: .*the toy broke"):
        run_study(make(folders, baseline=str(tmp_path / "crash.toml")), results=tmp_path)


def test_a_study_whose_trials_all_fail_is_not_judged(folders: list[str], tmp_path: Path) -> None:
    spec = make(folders, trials=2, start=[{"mode": "crash"}], space={"include": ["mode"]})
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    tuner = run_study(spec, results=tmp_path)
    summary = finish(tuner)
    assert summary.verdict == Verdict.NOT_JUDGED and "no trial with other settings" in summary.conclusion
    assert read_settings(tuner.folder / "best.toml") == {} and write_page(tuner, summary).is_file()


def test_one_recording_alone_is_not_judged(
    folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tuner = run_study(make(folders, confirm=[], held_out=[], trials=3), results=tmp_path)
    summary = finish(tuner)
    assert summary.verdict == Verdict.NOT_JUDGED and "no frames are left" in summary.conclusion
    assert summary.best is not None and summary.best.confirm is None and summary.p_value is None
    page = write_page(tuner, summary).read_text()
    assert summary.conclusion in page and "not recommended: not judged" in page
    status(tuner.folder)
    assert "no frames are left" in " ".join(capsys.readouterr().out.split())
    with pytest.raises(StudyError, match="scenes can be made of rendered sequences alone"):
        tuner.extend(scenes=1)


def test_scenes_of_uneven_lengths_and_starts_count_alike(folders: list[str], tmp_path: Path) -> None:
    uneven = [f"{folders[0]}?offsets=0-2", f"{folders[1]}[0:8]", f"{folders[2]}?stride=2&offsets=0,3"]
    tuner = run_study(make(folders, tune=uneven, confirm=folders[3:6], held_out=[]), results=tmp_path)
    trial = tuner.study.get_trials()[1]
    assert len(trial.user_attrs["instances"]) == 6 and len(trial.user_attrs["scenes"]) == 3
    assert trial.value == pytest.approx(sum(trial.user_attrs["scenes"].values()) / 3)
    assert finish(tuner).candidates[0].confirm.sequences == 3


class CrashingBaseline(SimulatedTuner):
    """Its baseline crashes on the scenes of the choice."""

    def outcomes(
        self, settings: Mapping[str, Any], instances: Sequence[ProblemInstance], **how: Any
    ) -> dict[ProblemInstance, Outcome]:
        if not settings and set(instances) & set(self.design.confirm):
            raise InstanceFailedError(f"{instances[0]}: crashed: it broke")
        return super().outcomes(settings, instances, **how)


def test_a_baseline_that_crashes_where_it_judges_is_one_clear_line(tmp_path: Path) -> None:
    tuner = CrashingBaseline(make_spec(trials=3), tmp_path)
    tuner.run()
    with pytest.raises(StudyError, match=r"^the baseline fails: \S+: crashed: it broke"):
        finish(tuner)
