"""Studies on a toy tracker whose best setting is known."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import optuna
import pytest
import toy_tracker
from optuna.trial import TrialState

from dynslam_bench.core.errors import DynslamError, StudyError
from dynslam_bench.core.settings import apply_overrides
from dynslam_bench.core.toml import read_settings
from dynslam_bench.runs import RunEvent, RunStore
from dynslam_bench.trackers import TRACKERS
from dynslam_bench.tuning import (
    Study,
    StudySpec,
    Verdict,
    distributions,
    finish,
    read_preset_text,
    read_study,
    run_study,
    search_space,
    write_page,
)
from dynslam_bench.tuning.study import CRASHED_WORKER
from dynslam_bench.tuning.study_file import SpaceSpec

TRACKER = f"{toy_tracker.__file__}:SPEC"


@pytest.fixture(scope="module")
def sequences(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    root = tmp_path_factory.mktemp("toys")
    return [str(toy_tracker.make_sequence(root / f"s{i}", 0.8 * i)) for i in range(4)]


def make(sequences: list[str], **changes: object) -> StudySpec:
    values: dict[str, object] = {
        "name": "toy", "tracker": TRACKER, "tune": sequences[:2], "held_out": sequences[3:], "trials": 10,
        "confirm": sequences[2:3],
        "space": {"include": ["gain", "wobble"]}, "seeds": [0], "offsets": [0], "top": 2,
        "pruner": "none", "min_coverage": None, "recorded": [],
    }  # fmt: skip
    return StudySpec.model_validate({**values, **changes})


def test_a_study_finds_the_known_optimum(sequences: list[str], tmp_path: Path) -> None:
    tuner = run_study(make(sequences, trials=14), results=tmp_path)
    trials = tuner.study.get_trials()
    assert len(trials) == 14 and all(trial.state == TrialState.COMPLETE for trial in trials)
    assert trials[0].params == {"gain": 1.5, "wobble": 2}, "trial 0 is the default"
    assert abs(trials[0].value) < 0.1, "the default's luck with these starts, beside its median over three"
    best = tuner.study.best_trial
    assert best.value < -0.5 and abs(math.log(best.params["gain"])) < math.log(1.3)
    summary = finish(tuner, jobs=2)
    held = summary.candidates[0].held_out
    assert held.ratio < 1 and held.sequences == 1
    assert summary.verdict == Verdict.NOT_JUDGED, "one sequence to choose on and one held out prove nothing"
    assert not summary.importances, "fourteen trials are too few"
    page = write_page(tuner, summary).read_text()
    assert "Use them" not in page and "not recommended: not judged" in page and "https://" not in page
    assert 'class="verdict amber"' in page and "<h3>History</h3>" in page
    preset = read_settings(tuner.folder / "best.toml")
    assert set(preset) == {"gain", "wobble"} and abs(math.log(preset["gain"])) < math.log(1.3)


def test_trials_are_runs_of_the_store(sequences: list[str], tmp_path: Path) -> None:
    told: list[RunEvent] = []
    tuner = run_study(make(sequences, trials=3), results=tmp_path, on_run=told.append)
    stored = set(RunStore(tmp_path).ids())
    trials = tuner.study.get_trials()
    assert trials
    for trial in trials:
        named = {run_id for _, run_id, *_ in trial.user_attrs["instances"]}
        assert len(named) == 2 and named <= stored
    assert {event.run_id for event in told if event.kind == "finished"} == stored  # those of the default among them
    frames = [event.partial["frames_done"] for event in told if event.kind == "progress" and event.partial]
    assert frames and min(frames) > 0
    records = [RunStore(tmp_path).read_whole(run_id) for run_id in stored]
    assert {record.study for record in records} == {"toy"}
    assert "study" not in records[0].identity
    assert {record.tracker.given for record in records} == {TRACKER}, "its id, toy, names it to nobody"


def test_a_crash_is_a_failed_trial_with_its_reason(sequences: list[str], tmp_path: Path) -> None:
    spec = make(sequences, space={"include": ["mode", "anger"]}, trials=8, sampler="random")
    tuner = run_study(spec, results=tmp_path)
    failed = tuner.study.get_trials(states=(TrialState.FAIL,))
    assert failed, "a random sampler draws 'crash' within eight trials"
    for trial in failed:
        assert trial.params["mode"] == "crash"
        assert "the toy broke" in trial.user_attrs["reason"]


def test_constraints_decide_who_is_a_candidate(sequences: list[str], tmp_path: Path) -> None:
    tuner = run_study(make(sequences, trials=4, min_fps=1e9), results=tmp_path)
    assert all(trial.constraints["fps"] > 0 for trial in tuner.study.get_trials())
    summary = finish(tuner)
    assert summary.verdict in (Verdict.WORSE, Verdict.NOT_JUDGED)
    assert not any(candidate.feasible for candidate in summary.candidates)


WORKER = """
import sys
from dynslam_bench.tuning import StudySpec, run_study
if __name__ == "__main__":
    run_study(StudySpec.model_validate_json(sys.argv[1]), results=sys.argv[2])
"""


def test_kill_and_resume_loses_only_the_running_trial(sequences: list[str], tmp_path: Path) -> None:
    spec = make(sequences, trials=6)
    script = tmp_path / "worker.py"
    script.write_text(WORKER)
    command = [sys.executable, str(script), spec.model_dump_json(), str(tmp_path)]
    checkout = str(Path(__file__).resolve().parents[2])
    child = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": checkout}, start_new_session=True)
    journal = tmp_path / "studies" / "toy" / "journal.log"
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and not (journal.exists() and journal.read_text().count('"op_code":6') >= 4):
        time.sleep(0.1)  # a state is set for each trial that was told, and once for the enqueued first one
        assert child.poll() is None, "the worker ended before it could be killed"
    os.killpg(child.pid, signal.SIGKILL)
    child.wait()
    before = {t.number: t.values for t in Study(spec, tmp_path).study.get_trials() if t.state == TrialState.COMPLETE}
    tuner = run_study(spec, results=tmp_path)
    after = tuner.study.get_trials()
    assert len(before) >= 3
    assert all(after[number].values == values for number, values in before.items()), "no finished trial was lost"
    lost = [trial for trial in after if trial.user_attrs.get("reason") == CRASHED_WORKER]
    assert len(lost) <= 1 and len(after) == 6 + len(lost), "none doubled"
    assert [trial.number for trial in after] == list(range(len(after)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"space": {"include": ["gian"]}}, "'gian'.*'gain'"),
        ({"space": {"include": ["plain"]}}, "not tunable"),
        ({"space": {"include": ["gain"], "exclude": ["gain"]}}, "space is empty"),
        ({"space": {"include": ["gain"], "fixed": {"wobbel": 1}}}, "'wobbel'.*'wobble'"),
        ({"space": {"include": ["gain"], "fixed": {"wobble": 99}}}, "wobble.*99"),
        ({"tracker": "tyo-tracker"}, "unknown tracker"),
        ({"tune": ["synthetic/wlaking_xyz"]}, "wlaking_xyz"),
        ({"storage": "sqlite:////no/such/folder/x.db"}, "cannot open the storage"),
        ({"space": {"include": ["gain"], "fixed": {"mode": "crash"}}}, "the toy broke"),
    ],
)
def test_bad_studies_are_refused_before_any_trial(
    sequences: list[str], tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(DynslamError, match=message):
        run_study(make(sequences, **changes), results=tmp_path)
    journal = tmp_path / "studies" / "toy" / "journal.log"
    assert not journal.exists() or '"op_code":6' not in journal.read_text()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("trails = 3\n", "'trails'.*'trials'"),
        ("[space]\ninclud = []\n", "'space.includ'.*space.include"),
        ('objectives = ["speed", "speed"]\n', "objectives: .*twice"),
        ("trials = 1\n", "trials.*greater than or equal to 2"),
        ('pruner = "best"\n', "pruner.*'halving'"),
        ("trials = = 1\n", "TOML"),
    ],
)
def test_bad_study_files_are_one_clear_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "study.toml"
    path.write_text('tune = ["synthetic/walking_xyz?scene=0"]\n' + text)
    with pytest.raises(StudyError, match=message):
        read_study(path)


def test_resuming_something_else_is_refused_with_the_difference(
    sequences: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_study(make(sequences, trials=2), results=tmp_path)
    with pytest.raises(StudyError, match=r"stored with other seeds: \[0\] there, \[0, 1\] here"):
        run_study(make(sequences, trials=2, seeds=[0, 1]), results=tmp_path)
    ask = Study.ask
    monkeypatch.setattr(Study, "ask", lambda *given: time.sleep(0.2) or ask(*given))  # other threads count meanwhile
    more = run_study(make(sequences, trials=4), results=tmp_path, jobs=3)
    assert len(more.study.get_trials()) == 4, "more trials of the same study are welcome"


def test_a_study_does_not_go_on_after_its_data_changed(tmp_path: Path) -> None:
    folders = [str(toy_tracker.make_sequence(tmp_path / f"s{i}", 0.8 * i)) for i in range(3)]
    spec = make(folders, trials=2)
    run_study(spec, results=tmp_path / "r")
    truth = Path(folders[1]) / "groundtruth.txt"
    lines = truth.read_text().splitlines()
    truth.write_text("\n".join([*lines[:-1], lines[-1].replace(" 0.0", " 0.1", 1).replace(" 0 ", " 0.1 ", 1)]) + "\n")
    with pytest.raises(StudyError, match=r"stored with other content of \S*s1"):
        run_study(make(folders, trials=3), results=tmp_path / "r")
    assert len(Study.open(spec, tmp_path / "r").study.get_trials()) == 2


def test_a_study_of_older_code_can_be_read_but_not_continued(
    sequences: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = make(sequences, trials=2)
    run_study(spec, results=tmp_path)
    monkeypatch.setattr("dynslam_bench.runs.identity.source_fingerprint", lambda *_: "newer")
    with pytest.raises(StudyError, match="stored with other code"):
        Study(spec, tmp_path)
    assert len(Study.open(spec, tmp_path).study.get_trials()) == 2
    assert 'status = "not judged"' in read_preset_text(spec, tmp_path)
    with pytest.raises(StudyError, match="there is no study 'toy'"):
        Study.open(spec, tmp_path / "elsewhere")
    assert not (tmp_path / "elsewhere" / "studies").exists(), "looking creates nothing"


def test_space_of_a_real_tracker_can_be_drawn() -> None:
    settings = TRACKERS.get("emfoa-oft").settings
    space = search_space(settings(), SpaceSpec(include=("flow.*", "epipolar.*", "segmentation.*"), fixed={}))
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(20):
        values = study.ask(distributions(space)).params
        apply_overrides(settings(), values)  # every drawn configuration is valid
