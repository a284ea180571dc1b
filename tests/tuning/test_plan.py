"""Before and after a study's run: what it could show, baselines, earlier studies, ask and tell, extensions."""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest
from helpers import simulated, toy_tracker
from helpers.simulated import TRACKER, SimulatedTuner, make_spec, toy_spec, valley
from optuna.trial import TrialState

from dynslam_bench.cli.studies import status
from dynslam_bench.core import DynslamError, StudyError, read_settings
from dynslam_bench.core.settings import apply_overrides
from dynslam_bench.evaluation.verdicts import LOOKS, ONE_SIDED, USUAL_SPREAD, power
from dynslam_bench.sequences.catalogue import open_sequence
from dynslam_bench.sequences.view import sequence_part_of
from dynslam_bench.trackers import TRACKERS
from dynslam_bench.tuning import (
    ComparisonVerdict,
    Study,
    StudyPlan,
    StudySpec,
    finish,
    read_preset_text,
    run_study,
    write_page,
)
from dynslam_bench.tuning.objectives import OBJECTIVES, InstanceFailedError, Outcome
from dynslam_bench.tuning.plan import (
    check_splits,
    design_of,
    seen_note,
    splits_seen,
    with_more_starts,
)
from dynslam_bench.tuning.storage import EARLIER, best_trials, importances
from dynslam_bench.tuning.study_file import (
    ProblemInstance,
    SpaceSpec,
    further_scenes,
    parse_instances,
    scenes,
)


def make(folders: list[str], **changes: object) -> StudySpec:
    return toy_spec(
        **{"tune": folders[:1], "confirm": folders[1:4], "held_out": folders[4:]} | changes
    )


def check(tune: list[str], held_out: list[str]) -> None:
    study = toy_spec(tune=tune, held_out=held_out)
    check_splits(
        study.name,
        {"tune": study.instances(*study.tune), "held_out": study.instances(*study.held_out)},
    )


@pytest.mark.slow
def test_a_preview_takes_what_stored_runs_show_and_else_what_is_known(
    folders: list[str], tmp_path: Path
) -> None:
    before = StudyPlan(make(folders), tmp_path).preview()
    assert before.runs == 0
    assert before.spread == pytest.approx(USUAL_SPREAD)
    assert before.scenes == 3
    assert "50 ms a frame" in before.figures[-1], "an assumption is stated as one"
    assert not (tmp_path / "studies").exists(), "looking makes no study"
    run_study(make(folders), results=tmp_path)
    after = StudyPlan(make(folders), tmp_path).preview(jobs=2)
    assert after.runs == 3
    assert after.spread >= before.spread
    assert after.minutes != before.minutes
    assert "ms a frame" not in after.figures[-1]
    assert after.unused == {}
    assert "3 scenes judge this study; below 6 it claims nothing" in after.figures[0]
    assert after.power == 0.0
    assert f"{after.needed} held-out scenes" in after.figures[1]


@pytest.mark.slow
@pytest.mark.parametrize(("held_out", "extendable"), [("100-139", False), ("100-111", True)])
def test_a_preview_states_power_at_the_level_of_the_study(
    held_out: str, extendable: bool, tmp_path: Path
) -> None:
    spec = make_spec(
        held_out=[f"{WALK}?scene={held_out}&frames=20&offsets=0"], extendable=extendable
    )
    preview = SimulatedTuner(spec, tmp_path).preview()
    assert preview.scenes == (12 if extendable else 40)
    assert preview.level == (LOOKS[12] if extendable else ONE_SIDED)
    assert preview.power == pytest.approx(power(0.2, USUAL_SPREAD, preview.scenes, preview.level))
    assert (preview.power >= 0.8) is not extendable
    assert ("An extendable study proves 20 %" in " ".join(preview.figures)) is extendable


@pytest.mark.slow
def test_a_preview_names_the_settings_of_parts_that_decide_nothing(tmp_path: Path) -> None:
    """The camera of `sitting_static` hardly moves, so that F is never used; nobody stands in the way of an oracle."""
    spec = StudySpec(
        name="s", tracker="emfoa-oft?masks=none", recorded=(), offsets=(0,),
        tune=("synthetic/sitting_static?scene=0&frames=8",),
        space={"include": ["epipolar.*", "features.fast_threshold"]},
    )  # fmt: skip
    plan = StudyPlan(spec, tmp_path)
    assert plan.preview().unused == {}, "no run is stored"
    Study(spec, tmp_path).reference()
    preview = plan.preview()
    assert {name.split(".")[0] for name in preview.unused} == {"epipolar"}
    assert preview.include == ["features.fast_threshold"]
    assert preview.include[0] in preview.proposal[-1]
    alone = spec.model_copy(update={"space": SpaceSpec(include=("epipolar.*",))})
    assert (
        StudyPlan(alone, tmp_path).preview().proposal[-1]
        == "Nothing would be left of the space without them."
    )


@pytest.mark.slow
def test_ratios_are_to_the_baseline_and_the_default_stands_beside(tmp_path: Path) -> None:
    preset = tmp_path / "mine.toml"
    preset.write_text("gain = 3.0\nwobble = 0\n")
    spec = make_spec(baseline=str(preset), space={"include": ["gain"], "fixed": {"mode": "fine"}})
    tuner = SimulatedTuner(spec, tmp_path, effect=valley).run()
    assert tuner.study.get_trials()[0].params == {"gain": 3.0}, "trial 0 is the baseline"
    assert tuner.configuration_of(tuner.study.get_trials()[1]).settings["wobble"] == 0, (
        "trials build on it"
    )
    summary = finish(tuner)
    assert set(summary.shipped) == {"held_out"}
    assert summary.baseline == str(preset)
    assert summary.shipped["held_out"].ratio == pytest.approx(math.exp(valley({}) - 1.5), abs=0.1)
    assert summary.verdict == ComparisonVerdict.PROVEN
    best = tuner.folder / "best.toml"
    assert read_settings(best) == {**summary.candidates[0].params, "wobble": 0}
    assert 'status = "proven"' in best.read_text()
    assert "default settings" in write_page(tuner, summary).read_text()


@pytest.mark.slow
def test_the_baseline_may_be_another_tracker(folders: list[str], tmp_path: Path) -> None:
    spec = make(folders, baseline="never-move", confirm=folders[1:2], held_out=[])
    summary = finish(run_study(spec, results=tmp_path))
    assert summary.baseline == "never-move"
    assert summary.shipped["confirm"].ratio < 1
    ranked = best_trials(Study.open(spec, tmp_path).study, 1)
    assert summary.best is not None
    assert summary.best.trial == ranked[0].number, "the default settings compete with it"
    with pytest.raises(StudyError, match="stored with other baseline"):
        Study(spec.model_copy(update={"baseline": ""}), tmp_path)


@pytest.mark.parametrize(
    ("baseline", "named"),
    [("nobody", "unknown tracker"), ("none.toml", "none.toml"), ("far.toml", "'gain' is 99")],
)
def test_a_baseline_that_cannot_be_is_one_clear_line(
    baseline: str, named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("far.toml").write_text("gain = 99.0\n")
    with pytest.raises(DynslamError, match=named):
        StudyPlan(make_spec(baseline=baseline), tmp_path)


@pytest.fixture
def earlier(tmp_path: Path) -> Study:
    return SimulatedTuner(
        make_spec(name="first", trials=8, pruner="none"), tmp_path, effect=valley, in_memory=False
    ).run()


@pytest.mark.slow
def test_a_study_begins_with_what_an_earlier_one_learnt(earlier: Study, tmp_path: Path) -> None:
    spec = make_spec(
        name="second", trials=5, pruner="none", start=[str(earlier.folder), {"gain": 0.9}]
    )
    tuner, resumed = (
        SimulatedTuner(spec, tmp_path, effect=valley, in_memory=False) for _ in range(2)
    )
    trials = tuner.run().study.get_trials()
    taken = [trial for trial in trials if EARLIER in trial.user_attrs]
    own = [trial for trial in trials if trial not in taken]
    assert len(taken) == 8
    assert {trial.user_attrs[EARLIER] for trial in taken} == {"study first"}
    assert len(own) == 5
    assert own[0].params == {"gain": 1.5, "wobble": 2}
    tried = [trial.params for trial in own[1:4]]
    assert {"gain": 0.9, "wobble": 2} in tried
    assert all(trial.params in tried for trial in best_trials(earlier.study, 2))
    assert not any(trial in taken for trial in best_trials(tuner.study, 9)), (
        "an earlier trial is no candidate"
    )
    assert importances(tuner.study) == {}
    assert len(resumed.run().study.get_trials()) == len(trials)


def test_trials_of_other_code_are_marked(
    earlier: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SimulatedTuner, "_identify", lambda self: {"code": "newer"})
    tuner = SimulatedTuner(
        make_spec(name="second", start=[str(earlier.folder)]), tmp_path, in_memory=False
    )
    marks = {
        trial.user_attrs[EARLIER]
        for trial in tuner.study.get_trials()
        if EARLIER in trial.user_attrs
    }
    assert marks == {"study first, other code"}
    with pytest.raises(StudyError, match="'first' has other objectives"):
        SimulatedTuner(
            make_spec(name="third", start=[str(earlier.folder)], objectives=["speed"]), tmp_path
        )
    with pytest.raises(StudyError, match="holds no study"):
        SimulatedTuner(make_spec(name="third", start=[str(tmp_path)]), tmp_path)


def test_trials_may_be_asked_for_and_told_one_by_one(tmp_path: Path) -> None:
    tuner = SimulatedTuner(make_spec(pruner="none"), tmp_path, effect=valley)
    trials = []
    for gain in (1.0, 2.0, 0.5):
        trials.append(tuner.ask({"gain": gain}))
        evaluation = tuner.evaluate(trials[-1])
        tuner.tell(trials[-1], evaluation)
        assert evaluation.state == TrialState.COMPLETE
    assert [trial.params["gain"] for trial in trials] == [1.5, 1.0, 2.0], (
        "the baseline is the first"
    )
    assert len(tuner.run().study.get_trials()) == 12, "the rest follows, with those that wait"
    with pytest.raises(StudyError, match="gain = 99"):
        tuner.ask({"gain": 99.0})


@pytest.mark.slow
def test_a_study_without_a_verdict_goes_on_with_more_scenes_and_trials(tmp_path: Path) -> None:
    spec = make_spec(trials=4, pruner="none")
    SimulatedTuner(spec, tmp_path, effect=valley, in_memory=False).run().extend(scenes=3, trials=2)
    again = SimulatedTuner(spec, tmp_path, effect=valley, in_memory=False).run()
    assert len(again.study.get_trials()) == 6 == again.trials
    with pytest.raises(StudyError, match="further scenes cannot be made"):
        again.extend(scenes=200)
    assert again.extension == {"scenes": 3, "trials": 2}
    summary = finish(again)
    assert (len(summary.confirm), len(summary.held_out)) == (0, (8 + 3) * 3)
    with pytest.raises(StudyError, match="not extendable: a second look would claim falsely"):
        again.extend(scenes=1)
    with pytest.raises(StudyError, match="2 more trials would be judged on the same scenes"):
        again.extend(trials=2)


@pytest.mark.slow
def test_another_trial_is_not_judged_on_scenes_that_have_judged(tmp_path: Path) -> None:
    """However the further trials were asked for; the same trial may be judged again."""
    spec = make_spec(trials=3, pruner="none")
    first = finish(SimulatedTuner(spec, tmp_path, effect=valley, in_memory=False).run())
    again = finish(SimulatedTuner(spec, tmp_path, effect=valley, in_memory=False).run())
    assert first.best is not None
    assert again.conclusion == first.conclusion
    more = spec.model_copy(update={"trials": 60})
    tuner = SimulatedTuner(more, tmp_path, effect=valley, in_memory=False).run()
    with pytest.raises(StudyError, match=f"has its verdict on trial {first.best.trial}; trial"):
        finish(tuner)


def test_an_extendable_study_has_a_level_for_each_of_its_looks(tmp_path: Path) -> None:
    twelve = f"{WALK}?scene=100-111&frames=20&offsets=0"
    spec = make_spec(trials=4, pruner="none", held_out=[twelve], extendable=True)
    tuner = SimulatedTuner(spec, tmp_path, in_memory=False).run()
    first = finish(tuner)
    with pytest.raises(StudyError, match=r"19 scenes judge it"):
        tuner.extend(scenes=7)
    tuner.extend(scenes=12)
    second = finish(tuner)
    assert first.best is not None
    assert second.best is not None
    assert first.best.trial == second.best.trial
    levels = [summary.best.held_out.one_sided for summary in (first, second)]
    assert levels == [LOOKS[12], LOOKS[24]]
    assert second.best.held_out.scenes == 24


def test_an_extendable_study_begins_with_a_planned_number_of_scenes(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match=r"8 scenes judge it.*judge on 12, 24, 36, 48"):
        SimulatedTuner(make_spec(extendable=True), tmp_path)


def test_any_trial_is_a_preset(tmp_path: Path) -> None:
    spec = make_spec(trials=16, pruner="halving")
    own = tmp_path / "own.toml"
    tuner = SimulatedTuner(spec, tmp_path, effect=valley, in_memory=False).run()
    for state in (TrialState.COMPLETE, TrialState.PRUNED):
        trial = tuner.study.get_trials(states=(state,))[-1]
        own.write_text(read_preset_text(spec, tmp_path, trial=trial.number))
        assert read_settings(own) == trial.params
        assert 'status = "not judged"' in own.read_text()
    with pytest.raises(StudyError, match="no trial 99"):
        read_preset_text(spec, tmp_path, trial=99)


@pytest.mark.slow
def test_a_study_whose_trials_all_fail_is_not_judged(folders: list[str], tmp_path: Path) -> None:
    tuner = run_study(
        make(folders, start=[{"mode": "crash"}], space={"include": ["mode"]}), results=tmp_path
    )
    summary = finish(tuner)
    assert summary.verdict == ComparisonVerdict.CANNOT_TELL
    assert "no trial with other settings" in summary.conclusion
    assert read_settings(tuner.folder / "best.toml") == {}
    assert write_page(tuner, summary).is_file()


@pytest.mark.slow
def test_one_recording_alone_is_not_judged(
    folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tuner = run_study(make(folders, confirm=[], held_out=[], trials=3), results=tmp_path)
    summary = finish(tuner)
    assert summary.verdict == ComparisonVerdict.CANNOT_TELL
    assert "no frames are left" in summary.conclusion
    assert summary.best is not None
    assert summary.best.confirm is None
    assert "is better by more than" not in summary.conclusion
    page = write_page(tuner, summary).read_text()
    assert summary.conclusion in page
    assert "not recommended: cannot tell" in page
    status(tuner.folder)
    assert "no frames are left" in " ".join(capsys.readouterr().out.split())
    with pytest.raises(StudyError, match="scenes can be made of rendered sequences alone"):
        tuner.extend(scenes=1)


@pytest.mark.slow
def test_scenes_of_uneven_lengths_and_starts_count_alike(
    folders: list[str], tmp_path: Path
) -> None:
    uneven = [
        f"{folders[0]}?offsets=0-2",
        f"{folders[1]}[0:8]",
        f"{folders[2]}?stride=2&offsets=0,3",
    ]
    spec = make(folders, tune=uneven, confirm=folders[3:4], held_out=[])
    trial = run_study(spec, results=tmp_path).study.get_trials()[1]
    assert len(trial.user_attrs["instances"]) == 6
    assert len(trial.user_attrs["scenes"]) == 3
    assert trial.value == pytest.approx(sum(trial.user_attrs["scenes"].values()) / 3)


class CrashingTuner(SimulatedTuner):
    """Its baseline, or its candidates, crash on some of the scenes that judge."""

    baseline_crashes_on: tuple[str, ...] = ()
    candidate_crashes_on: tuple[str, ...] = ()

    def outcomes(
        self, settings: Mapping[str, Any], instances: Sequence[ProblemInstance], **how: Any
    ) -> Any:
        numbers = self.candidate_crashes_on if settings else self.baseline_crashes_on
        for instance in instances:
            if any(f"scene={number}" in instance.sequence for number in numbers):
                raise InstanceFailedError(f"{instance}: crashed: it broke")
        return super().outcomes(settings, instances, **how)


EVERY = tuple(str(number) for number in range(100, 108))


def test_a_baseline_that_crashes_everywhere_where_it_judges_is_one_clear_line(
    tmp_path: Path,
) -> None:
    tuner = CrashingTuner(make_spec(trials=3), tmp_path).run()
    tuner.baseline_crashes_on = EVERY
    with pytest.raises(StudyError, match=r"^the baseline fails: \S+: crashed: it broke"):
        finish(tuner)


@pytest.mark.parametrize(
    ("by_candidate", "by_baseline", "losses"),
    [(("103",), (), (1, 0)), ((), ("100", "107"), (0, 2)), (("101",), ("101",), (0, 0))],
)
def test_a_crash_in_a_scene_that_judges_is_a_loss_there_and_ends_nothing(
    by_candidate: tuple[str, ...],
    by_baseline: tuple[str, ...],
    losses: tuple[int, int],
    tmp_path: Path,
) -> None:
    tuner = CrashingTuner(make_spec(trials=3), tmp_path).run()
    tuner.candidate_crashes_on = by_candidate
    tuner.baseline_crashes_on = by_baseline
    summary = finish(tuner)
    assert summary.best is not None
    evidence = summary.best.evidence
    assert evidence is not None
    assert (len(evidence.lost), len(evidence.lost_baseline)) == losses
    assert evidence.all_scenes == len(EVERY)
    crashes = 3 * (len(by_candidate) + len(by_baseline))
    assert f"{crashes} runs crashed" in summary.conclusion
    assert "it broke" in summary.conclusion


class LosingTuner(SimulatedTuner):
    """Its baseline, or both sides, lose all scenes that judge, or have no error there."""

    losers: tuple[str, ...] = ()
    is_perfect = False

    def outcomes(
        self, settings: Mapping[str, Any], instances: Sequence[ProblemInstance], **how: Any
    ) -> Any:
        side = "candidate" if settings else "baseline"
        judging = set(self.design.held_out)
        drawn = super().outcomes(settings, instances, **how)
        for instance in judging & set(instances):
            drawn[instance] = replace(drawn[instance], lost=side in self.losers)
            if self.is_perfect:
                drawn[instance] = replace(drawn[instance], ate_m=0.0)
        return drawn


@pytest.mark.parametrize(
    ("losers", "verdict", "said"),
    [
        (
            ("baseline", "candidate"),
            ComparisonVerdict.CANNOT_TELL,
            "judge on scenes that both sides track",
        ),
        (("baseline",), ComparisonVerdict.CANNOT_TELL, "judge on scenes that both sides track"),
        (
            ("candidate",),
            ComparisonVerdict.WORSE,
            "loses more scenes than the baseline: both succeed on none",
        ),
    ],
)
def test_scenes_that_a_side_lost_say_what_cannot_be_said(
    losers: tuple[str, ...], verdict: ComparisonVerdict, said: str, tmp_path: Path
) -> None:
    tuner = LosingTuner(make_spec(trials=3), tmp_path).run()
    tuner.losers = losers
    summary = finish(tuner)
    assert summary.verdict is verdict
    assert said in summary.conclusion
    assert summary.offered == {}


def test_errors_below_the_floor_are_equal_and_said(tmp_path: Path) -> None:
    tuner = LosingTuner(make_spec(trials=3), tmp_path).run()
    tuner.is_perfect = True
    summary = finish(tuner)
    assert summary.verdict is ComparisonVerdict.CANNOT_TELL
    assert "exactly the same error in 8 scenes" in summary.conclusion
    assert "an error below 0.1 mm counts as 0.1 mm" in summary.conclusion


def test_claims_beyond_the_families_rest_on_six_that_no_trial_saw(tmp_path: Path) -> None:
    names = ("sitting_xyz", "sitting_rpy", "walking_rpy", "objects_balloon", "objects_trolley")
    every = (*names, "walking_static")
    for families in (names, every):
        held_out = [f"synthetic/{name}?scene=100-101&frames=20&offsets=0" for name in families]
        spec = make_spec(held_out=held_out, trials=4)
        summary = finish(SimulatedTuner(spec, tmp_path / str(len(families)), effect=valley).run())
        assert summary.best is not None
        beyond = summary.best.beyond
        if families is names:
            assert beyond is None
            assert "says nothing of others" in summary.conclusion
            continue
        assert beyond is not None
        assert beyond.all_scenes == 6
        assert "by the means of the 6 families that no trial saw" in summary.conclusion
        assert "says nothing of others" not in summary.conclusion


def test_a_candidate_that_crashes_everywhere_is_not_judged(tmp_path: Path) -> None:
    tuner = CrashingTuner(make_spec(trials=3), tmp_path).run()
    tuner.candidate_crashes_on = EVERY
    summary = finish(tuner)
    assert summary.verdict is ComparisonVerdict.CANNOT_TELL
    assert "failed when it was run again" in summary.conclusion


@pytest.mark.parametrize("objective", ["accuracy", "speed", "robustness"])
def test_losing_a_scene_never_pays_in_the_search(objective: str) -> None:
    """Before a fixed camera a run that lost at once has no error, and one that gives up is fast."""
    (first, second) = make_spec().instances(
        f"{WALK}?scene=0-1&frames=20&degrade=blur:0.5&offsets=0"
    )
    baseline = {one: Outcome(one, "", 0.002, 1.0, 0.03, 0.03, 1.0) for one in (first, second)}
    lost = Outcome(first, "", 0.0, 0.05, 0.001, 0.001, 1.0, lost=True)
    candidate = baseline | {first: lost}
    kind = OBJECTIVES[objective]
    assert kind.ratios(candidate, baseline)[first.scene] >= math.log(3.0) - 1e-12
    assert kind.by_start(candidate, baseline)[0] >= math.log(3.0) - 1e-12
    assert kind.value(candidate, baseline) > 0
    assert kind.value(baseline, candidate) < 0
    both = kind.ratios(candidate, candidate)
    assert set(both.values()) == {0.0}


WALK = "synthetic/walking_xyz"


@pytest.mark.parametrize(
    "other", ["?scene=0", "?scene=000", "@0", "?scene=0&frames=50", "?frames=10&noise=3", ""]
)
def test_rendered_sequences_overlap_in_every_spelling(other: str) -> None:
    with pytest.raises(StudyError, match=r"^[^\n]*are the same sequence") as caught:
        check([WALK], [f"{WALK}{other}"])
    assert f"'{WALK}'" in str(caught.value), "both spellings"


def test_a_copy_is_the_same_recording(tmp_path: Path) -> None:
    whole = str(toy_tracker.make_sequence(tmp_path / "whole", 0.3))
    copy = str(shutil.copytree(whole, tmp_path / "copy"))
    for tune, held_out, named in (
        ([whole], [copy], "same sequence"),
        ([whole, copy], [], "same frames"),
    ):
        with pytest.raises(StudyError, match=f"are the {named}") as caught:
            check(tune, held_out)
        assert whole in str(caught.value)
        assert copy in str(caught.value)


def disguised(whole: Path, copy: Path, how: str) -> Path:
    """A copy of a toy recording: renamed, shifted, re-encoded, beginning later, seen from elsewhere."""
    shutil.copytree(whole, copy)
    shift = 1000.013 * ("shifted" in how)
    dropped = 5 * (how == "later") + ("one fewer" in how)
    for kind in ("rgb", "depth", "groundtruth"):
        lines = [line.split() for line in (copy / f"{kind}.txt").read_text().splitlines()[dropped:]]
        for words in lines:
            words[0] = f"{float(words[0]) + shift:.6f}"
            if kind != "groundtruth":
                image = cv2.imread(str(copy / words[1]), cv2.IMREAD_UNCHANGED)
                (copy / words[1]).unlink()
                words[1] = words[1].replace(".png", "-b.png") if how == "renamed" else words[1]
                level = 0 if how == "re-encoded" else 3
                cv2.imwrite(str(copy / words[1]), image, [cv2.IMWRITE_PNG_COMPRESSION, level])
            elif how == "elsewhere":  # turned by 90 degrees and moved
                words[1:4] = ["5", f"{float(words[1]) - 2:.6f}", "1"]
        (copy / f"{kind}.txt").write_text("\n".join(" ".join(words) for words in lines) + "\n")
    return copy


@pytest.mark.parametrize(
    "how",
    [
        "renamed",
        "shifted",
        "re-encoded",
        "later",
        "elsewhere",
        "one fewer",
        "one fewer and shifted",
    ],
)
def test_a_copy_in_disguise_is_the_same_recording(tmp_path: Path, how: str) -> None:
    whole = toy_tracker.make_sequence(tmp_path / "whole", 0.3, 24)
    copy = disguised(whole, tmp_path / "copy", how)
    assert (
        sequence_part_of(open_sequence(str(copy))).scene
        != sequence_part_of(open_sequence(str(whole))).scene
    ), "digests alone pass it"
    for pair in ((whole, copy), (copy, whole)):
        with pytest.raises(StudyError, match="are the same sequence"):
            check(*([str(folder)] for folder in pair))
    for phase in (0.9, 1.9, 2.6):
        check([str(copy)], [str(toy_tracker.make_sequence(tmp_path / f"other{phase}", phase, 24))])


@pytest.mark.parametrize("how", ["one fewer", "one fewer and shifted", "later"])
def test_a_copy_of_a_fixed_cameras_recording_is_the_same_recording(
    tmp_path: Path, how: str
) -> None:
    """Its poses tell nothing: every fixed camera has such ones."""
    whole = fixed_camera(toy_tracker.make_sequence(tmp_path / "whole", 0.3, 24))
    copy = disguised(whole, tmp_path / "copy", how)
    with pytest.raises(StudyError, match="are the same sequence"):
        check([str(whole)], [str(copy)])
    with pytest.raises(StudyError, match="are the same recording"):
        check([str(whole), str(copy)], [])
    other = fixed_camera(toy_tracker.make_sequence(tmp_path / "other", 1.7, 24))
    check([str(whole)], [str(other)])


def fixed_camera(folder: Path) -> Path:
    """The recording with the truth of a camera that stands still."""
    truth = folder / "groundtruth.txt"
    stamps = [line.split()[0] for line in truth.read_text().splitlines() if line[0] != "#"]
    truth.write_text("".join(f"{stamp} 0 0 1 0 0 0 1\n" for stamp in stamps))
    return folder


@pytest.mark.parametrize(
    ("tune", "held_out", "named"),
    [
        (1, 5, r"scene=5' is used as held-out.*0-99.*the tune split"),
        (105, 101, r"scene=105' is used as tune.*100 and above.*held-out split"),
    ],
)
def test_scenes_stay_in_their_split(tune: int, held_out: int, named: str) -> None:
    with pytest.raises(StudyError, match=named):
        check([f"{WALK}?scene={tune}"], [f"{WALK}?scene={held_out}"])
    check([f"{WALK}?scene=1", f"{WALK}?scene=1&noise=4"], [f"{WALK}?scene=101"])


def test_the_catalogues_split_is_enforced(tmp_path: Path) -> None:
    held, tune, plain = (
        str(toy_tracker.make_sequence(tmp_path / name, phase))
        for name, phase in (
            ("rgbd_dataset_freiburg3_walking_rpy", 3.4), ("rgbd_dataset_freiburg3_walking_xyz", 3.9), ("plain", 0.7)
        )
    )  # fmt: skip
    with pytest.raises(StudyError, match="the catalogue puts it into the held-out"):
        check([held], [])
    with pytest.raises(StudyError, match="the catalogue puts it into the tune"):
        check([plain], [tune])
    check([tune], [held])


@pytest.mark.parametrize(
    ("source", "seen"),
    [("auto", ["tune"]), ("embedded", ["tune"]), ("oracle", [])],
)
def test_the_embedded_network_alone_was_trained_on_the_scenes(source: str, seen: list[str]) -> None:
    design = simulated.simulated_design(make_spec())
    settings = apply_overrides(
        TRACKERS.get("mask-rcnn").settings(), {"segmentation.source": source}
    )
    assert splits_seen(settings, design) == seen
    assert splits_seen(TRACKERS.get(TRACKER).settings(), design) == [], "a system without masks"


@pytest.mark.slow
@pytest.mark.parametrize("masks", [True, False])
def test_page_summary_and_preset_mark_scenes_of_the_training(masks: bool, tmp_path: Path) -> None:
    changes = (
        {"tracker": "mask-rcnn", "space": {"include": ["features.n_features"]}} if masks else {}
    )
    tuner = SimulatedTuner(make_spec(trials=3, **changes), tmp_path).run()
    summary = finish(tuner)
    assert summary.seen == (["tune"] if masks else [])
    assert bool(seen_note(summary.seen)) == masks
    page = write_page(tuner, summary).read_text()
    preset = (tuner.folder / "best.toml").read_text()
    assert ("in the trial §" in page) == masks
    assert "held-out §" not in page
    assert page.count("trained on those very scenes") >= 3 * masks
    assert ("trained on" in preset) == masks


def test_a_text_names_scenes_lengths_and_starts() -> None:
    instances = parse_instances(f"{WALK}?scene=0-1,7&frames=80&offsets=0-4")
    assert instances[0] == ProblemInstance(f"{WALK}?scene=0&frames=80")
    assert len(instances) == 15
    assert instances[-1] == ProblemInstance(f"{WALK}?scene=7&frames=80", offset=4)
    assert list(scenes(instances)) == [f"{WALK}?scene=0", f"{WALK}?scene=1", f"{WALK}?scene=7"]


@pytest.mark.parametrize("text", [
    "bonn/crowd[0:120]", "bonn/crowd[40:]?offsets=2,5&stride=2", "bonn/crowd?frames=120&degrade=blur:0.5,glare:0.2",
    f"{WALK}[10:40]?scene=3&frames=60&noise=7&seeds=0-1", "tum/fr1/xyz", "some/folder[0:9]?offsets=1",
])  # fmt: skip
def test_the_text_of_an_instance_names_it(text: str) -> None:
    instances = parse_instances(text)
    assert (
        [parse_instances(str(instance)) for instance in instances]
        == [(instance,) for instance in instances]
        != []
    )


def test_parts_strides_and_degradation_reach_the_run() -> None:
    (instance,) = parse_instances("bonn/crowd[20:120]?offsets=3&stride=2&degrade=blur:0.5&seeds=4")
    run = instance.run_spec("orb-slam2", threads=2)
    assert (run.frames, run.offset, run.stride, run.seed, run.threads) == ((20, 120), 3, 2, 4, 2)
    assert run.degrade == {"blur": 0.5}
    assert parse_instances("bonn/crowd?frames=120")[0].frames == (0, 120)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("bonn/crowd[0:10", "names no instances"),
        ("bonn/crowd[9:3]", "9:3"),
        (f"{WALK}?scene=5-2", "'5-2'"),
        (f"{WALK}?scene=1,0-2", "'0-2'"),
        (f"{WALK}?scene=first", "'scene=first'"),
        ("bonn/crowd?offset=3", "'offset=3'.*offsets"),
        ("bonn/crowd?stride=2&stride=3", "stride twice"),
        ("bonn/crowd?noise=3", "noise"),
        ("bonn/crowd?scene=3", "scene"),
        ("bonn/crowd[0:9]?frames=3", "frames"),
        ("bonn/crowd?degrade=blurr:0.3", "'blurr'.*'blur'"),
        ("bonn/crowd?degrade=blur:3", "'blur' is 3.0"),
        ("bonn/crowd?degrade=blur:much", "blur:much"),
    ],
)
def test_what_cannot_be_read_is_one_clear_line(text: str, named: str) -> None:
    with pytest.raises(DynslamError, match=named):
        parse_instances(text)


@pytest.fixture
def folder(tmp_path: Path) -> str:
    return str(toy_tracker.make_sequence(tmp_path / "a", 0.3))


def test_instances_are_measured_against_their_sequence(folder: str) -> None:
    whole = ProblemInstance(folder)
    assert len(ProblemInstance(folder, (2, 10), offset=1, stride=3).open()) == 3
    wrong = {r"0 to 19.* 12 frames": {"frames": (0, 20)}, "1 frames, it needs 2": {"offset": 11}}
    for named, change in wrong.items():
        with pytest.raises(StudyError, match=named):
            replace(whole, **change).open()
    (Path(folder) / "groundtruth.txt").unlink()
    with pytest.raises(StudyError, match="no ground truth"):
        whole.open()


def test_instances_of_one_recording_are_apart_or_repeats(folder: str) -> None:
    one = ProblemInstance(folder, (0, 6))
    later = ProblemInstance(folder, (6, 12))
    check_splits("s", {"tune": [one, replace(one, offset=1), later]})
    for instances, named in (
        ([one, ProblemInstance(folder, (4, 12))], "share 2 frames"),
        ([one, one], "is named twice"),
        ([ProblemInstance(folder), ProblemInstance(folder, (0, 12))], "are the same frames"),
    ):
        with pytest.raises(StudyError, match=named):
            check_splits("s", {"tune": instances})
    with pytest.raises(StudyError, match=f"{re.escape(folder)}' held out are the same sequence"):
        check_splits("s", {"tune": [one], "held_out": [later]})


def test_the_baseline_runs_from_three_starts() -> None:
    few = parse_instances(f"{WALK}?scene=0-3&frames=20&offsets=0,3")
    first = [
        instance.offset for instance in with_more_starts(few) if instance.scene.endswith("?scene=0")
    ]
    assert sorted(first) == [0, 1, 3]


@pytest.mark.slow
@pytest.mark.parametrize(("scenes_to_tune_on", "reserved"), [(1, 28), (11, 28), (40, 28)])
def test_further_scenes_judge_where_none_are_named(scenes_to_tune_on: int, reserved: int) -> None:
    design = design_of(
        StudySpec(
            name="s", tune=(f"{WALK}?scene=0-{scenes_to_tune_on - 1}&frames=20",), recorded=()
        )
    )
    confirm = scenes(design.confirm).keys()
    tuned = scenes(design.tune).keys()
    assert (len(tuned), len(confirm)) == (scenes_to_tune_on, reserved)
    assert not confirm & tuned
    assert len(scenes(design.tune[:scenes_to_tune_on])) == scenes_to_tune_on, "in turn"
    assert {instance.offset for instance in design.confirm} == {0, 3}


def test_further_scenes_are_of_all_sequences_in_turn_and_of_their_split() -> None:
    tune = (
        f"{WALK}?scene=0-1&frames=20&offsets=0",
        "synthetic/sitting_xyz?scene=5&frames=20&offsets=2&seeds=3",
    )
    spec = StudySpec(name="s", tune=tune, confirm=(tune[0].replace("0-1", "7"),), recorded=(),
                     held_out=(f"{WALK}?scene=100-101&frames=20&offsets=0",))  # fmt: skip
    design = design_of(spec, further=2)
    assert [instance.scene.rpartition("=")[2] for instance in design.confirm] == ["7"], (
        "what chooses stays"
    )
    assert [instance.scene.rpartition("=")[2] for instance in design.held_out] == [
        "100",
        "101",
        "102",
        "103",
    ]
    added = further_scenes(spec.instances(*tune), 2, set(), range(3, 9))
    assert [str(instance) for instance in added] == [
        f"{WALK}?scene=3&frames=20&offsets=0", "synthetic/sitting_xyz?scene=3&frames=20&offsets=2&seeds=3"
    ]  # fmt: skip
    with pytest.raises(StudyError, match=r"2 further scenes.*only 1"):
        further_scenes(spec.instances(tune[0]), 2, {f"{WALK}?scene=3"}, range(3, 5))


def test_recordings_are_confirmed_on_other_stretches_or_not_at_all(folder: str) -> None:
    def confirm(*tune: str, **changes: object) -> list[str]:
        spec = StudySpec.model_validate(
            {"name": "s", "tune": tune, "recorded": (), "offsets": (0,), **changes}
        )
        return [str(instance).removeprefix(folder) for instance in design_of(spec).confirm]

    assert confirm(f"{folder}[0:3]", f"{folder}[3:5]") == ["[5:8]?offsets=0", "[8:10]?offsets=0"]
    assert confirm(f"{folder}[0:8]") == [] == confirm(folder), "no frames are left"
    for other in (f"{folder}[2:6]", f"{folder}[0:4]?offsets=1"):
        with pytest.raises(StudyError, match=r"share [24] frames"):
            confirm(f"{folder}[0:4]", confirm=(other,))


def test_a_recording_that_is_here_is_in_the_check(folder: str, tmp_path: Path) -> None:
    root = tmp_path / "data"
    toy_tracker.make_sequence(root / "bonn" / "rgbd_bonn_crowd", 0.2)
    recorded = design_of(StudySpec(name="s", tune=(folder,), data_root=str(root))).recorded
    assert recorded == tuple(
        ProblemInstance("bonn/crowd", recorded[0].frames, offset) for offset in range(4)
    )
    assert (
        design_of(StudySpec(name="s", tune=(folder,), recorded=(), data_root=str(root))).recorded
        == ()
    )
    assert (
        design_of(StudySpec(name="s", tune=(folder,), data_root=str(tmp_path / "empty"))).recorded
        == ()
    )
