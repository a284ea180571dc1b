"""Studies on a toy tracker whose best setting is known, their storages, and their workers on several machines."""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import re
import runpy
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pytest
from helpers import toy_tracker
from helpers.faults import in_a_small_process, survey
from helpers.simulated import (
    HELD_OUT,
    TRACKER,
    TUNE,
    SimulatedTuner,
    make_spec,
    nothing,
    simulated_design,
    toy_spec,
    valley,
)
from helpers.waiting import until
from optuna.storages import RDBStorage
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.exc import OperationalError

from dynslam_bench.core import DynslamError, StudyError, read_settings
from dynslam_bench.core.settings import apply_overrides
from dynslam_bench.runs import RunEvent, RunSpec, RunStore
from dynslam_bench.runs.identity import resolve
from dynslam_bench.trackers import TRACKERS
from dynslam_bench.tuning import (
    ComparisonVerdict,
    Outcome,
    ProblemInstance,
    SpaceSpec,
    Study,
    StudySpec,
    database,
    distributions,
    finish,
    parse_instances,
    read_preset_text,
    read_study,
    run_study,
    search_space,
    storage,
    write_page,
)
from dynslam_bench.tuning.database import open_database
from dynslam_bench.tuning.objectives import ACCURACY
from dynslam_bench.tuning.storage import (
    Heartbeats,
    JournalFile,
    open_storage,
    worker_name,
)
from dynslam_bench.tuning.study import Evaluation, StudyEvent

pytestmark = pytest.mark.slow


def make(folders: list[str], **changes: object) -> StudySpec:
    splits = {"tune": folders[:2], "confirm": folders[2:3], "held_out": folders[3:4]}
    return toy_spec(
        **splits
        | {"trials": 10, "space": {"include": ["gain", "wobble"]}, "sampler": "tpe"}
        | changes
    )


def test_a_study_finds_the_known_optimum(folders: list[str], tmp_path: Path) -> None:
    tuner = run_study(make(folders, tune=folders[:1], trials=14), results=tmp_path)
    trials = tuner.study.get_trials()
    assert len(trials) == 14
    assert all(trial.state == TrialState.COMPLETE for trial in trials)
    assert trials[0].params == {"gain": 1.5, "wobble": 2}, "trial 0 is the default"
    assert abs(trials[0].value) < 0.1, (
        "the default's luck with these starts, beside its median over three"
    )
    summary = finish(tuner, jobs=2)
    held = summary.candidates[0].held_out
    assert tuner.study.best_value < -0.5
    assert held.ratio < 1
    assert held.scenes == 1
    assert summary.verdict == ComparisonVerdict.CANNOT_TELL, "one sequence held out proves nothing"
    assert not summary.importances, "fourteen trials are too few"
    page = write_page(tuner, summary).read_text()
    assert "Use them" not in page
    assert "not recommended: cannot tell" in page
    assert "https://" not in page
    assert 'class="verdict amber"' in page
    assert "<h3>History</h3>" in page
    assert read_settings(tuner.folder / "best.toml") == {}, "nothing is offered as a result"
    best = summary.candidates[0].params
    assert f"gain = {best['gain']}" in (tuner.folder / "best.toml").read_text().replace("\n# ", " ")
    assert abs(math.log(best["gain"])) < math.log(1.3)


def test_trials_are_runs_of_the_store(folders: list[str], tmp_path: Path) -> None:
    events: list[RunEvent] = []
    tuner = run_study(make(folders, trials=3), results=tmp_path, on_run=events.append)
    stored = set(RunStore(tmp_path).ids())
    named = [
        {run_id for _, run_id, *_ in trial.user_attrs["instances"]}
        for trial in tuner.study.get_trials()
    ]
    assert len(named) == 3
    assert all(len(ids) == 2 and ids <= stored for ids in named)
    finished = {
        event.record.run_id for event in events if event.kind == "finished" and event.record
    }
    assert finished == stored  # the default's among them
    frames = [
        event.partial["frames_done"]
        for event in events
        if event.kind == "progress" and event.partial
    ]
    assert frames
    assert min(frames) > 0
    records = [RunStore(tmp_path).read_whole(run_id) for run_id in stored]
    assert {record.study for record in records} == {"toy"}
    assert "study" not in records[0].identity
    assert {record.tracker.given for record in records} == {TRACKER}, (
        "its id, toy, names it to nobody"
    )


def test_a_crash_is_a_failed_trial_with_its_reason(folders: list[str], tmp_path: Path) -> None:
    spec = make(
        folders, tune=folders[:1], space={"include": ["mode", "anger"]}, trials=6, sampler="random"
    )
    failed = run_study(spec, results=tmp_path).study.get_trials(states=(TrialState.FAIL,))
    assert failed, "a random sampler draws 'crash' within six trials"
    assert {trial.params["mode"] for trial in failed} == {"crash"}
    assert all("the toy broke" in trial.user_attrs["reason"] for trial in failed)


def test_constraints_decide_who_is_a_candidate(folders: list[str], tmp_path: Path) -> None:
    tuner = run_study(make(folders, tune=folders[:1], trials=3, min_fps=1e9), results=tmp_path)
    assert all(trial.constraints["fps"] > 0 for trial in tuner.study.get_trials())
    summary = finish(tuner)
    assert summary.verdict is ComparisonVerdict.CANNOT_TELL
    assert not any(candidate.feasible for candidate in summary.candidates)
    assert "violates a constraint" in summary.conclusion


WORKER = """
import sys
from dynslam_bench.tuning import StudySpec, run_study, storage
storage.HEARTBEAT_S, storage.GRACE_S = 0.5, 4.0
if __name__ == "__main__":
    run_study(StudySpec.model_validate_json(sys.argv[1]), results=sys.argv[2])
"""


def test_kill_and_resume_loses_only_the_running_trial(folders: list[str], tmp_path: Path) -> None:
    spec = make(folders, tune=folders[:1], trials=4)
    (tmp_path / "worker.py").write_text(WORKER)
    command = [sys.executable, str(tmp_path / "worker.py"), spec.model_dump_json(), str(tmp_path)]
    child = subprocess.Popen(command, start_new_session=True)
    journal = tmp_path / "studies" / "toy" / "journal.log"
    # a state is set for each trial that was told, and once for the enqueued first one
    until(
        lambda: (
            child.poll() is not None
            or (journal.exists() and journal.read_text().count('"op_code":6') >= 3)
        )
    )
    assert child.poll() is None, "the worker ended before it could be killed"
    os.killpg(child.pid, signal.SIGKILL)
    child.wait()
    before = {
        t.number: t.values
        for t in Study(spec, tmp_path).study.get_trials()
        if t.state == TrialState.COMPLETE
    }
    after = run_study(spec, results=tmp_path).study.get_trials()
    assert len(before) >= 2
    assert all(after[number].values == values for number, values in before.items()), (
        "no finished trial was lost"
    )
    assert [trial.state for trial in after] == [TrialState.COMPLETE] * 4, "none doubled"
    undisturbed = run_study(spec, results=tmp_path / "again").study.get_trials()
    assert [(trial.params, trial.values) for trial in after] == [
        (one.params, one.values) for one in undisturbed
    ]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"space": {"include": ["gian"]}}, "'gian'.*'gain'"),
        ({"space": {"include": ["plain"]}}, "matches no tunable setting"),
        ({"space": {"include": ["gain"], "exclude": ["gain"]}}, "space is empty"),
        ({"space": {"include": ["gain"], "fixed": {"wobbel": 1}}}, "'wobbel'.*'wobble'"),
        ({"space": {"include": ["gain"], "fixed": {"wobble": 99}}}, "wobble.*99"),
        ({"tracker": "tyo-tracker"}, "unknown tracker"),
        ({"tune": ["synthetic/wlaking_xyz"]}, "wlaking_xyz"),
        ({"storage": "sqlite:////no/such/folder/x.db"}, "cannot open the storage"),
        (
            {"space": {"include": ["gain"], "fixed": {"mode": "crash"}}},
            "the baseline fails: .*the toy broke",
        ),
    ],
)
def test_bad_studies_are_refused_before_any_trial(
    folders: list[str], tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(DynslamError, match=message):
        run_study(make(folders, **changes), results=tmp_path)
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
    folders: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_study(make(folders, tune=folders[:1], trials=2), results=tmp_path)
    with pytest.raises(StudyError, match=r"stored with other seeds: \[0\] there, \[0, 1\] here"):
        run_study(make(folders, tune=folders[:1], trials=2, seeds=[0, 1]), results=tmp_path)
    ask = Study.ask
    # other threads count meanwhile
    monkeypatch.setattr(Study, "ask", lambda *given: time.sleep(0.2) or ask(*given))
    more = run_study(make(folders, tune=folders[:1], trials=4), results=tmp_path, jobs=3)
    assert len(more.study.get_trials()) == 4, "more trials of the same study are welcome"


def test_a_study_does_not_go_on_after_its_data_changed(tmp_path: Path) -> None:
    folders = [str(toy_tracker.make_sequence(tmp_path / f"s{i}", 0.8 * i)) for i in range(3)]
    spec = make(folders, trials=2)
    run_study(spec, results=tmp_path / "r")
    truth = Path(folders[1]) / "groundtruth.txt"
    *lines, last = truth.read_text().splitlines()
    truth.write_text("\n".join([*lines, last.replace(" 0 ", " 0.1 ", 1)]) + "\n")
    with pytest.raises(StudyError, match=r"stored with other content of \S*s1"):
        run_study(make(folders, trials=3), results=tmp_path / "r")
    assert len(Study.open(spec, tmp_path / "r").study.get_trials()) == 2


def test_a_study_of_older_code_can_be_read_but_not_continued(
    folders: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = make(folders, tune=folders[:1], trials=2)
    run_study(spec, results=tmp_path)
    monkeypatch.setattr("dynslam_bench.runs.identity.source_digests", lambda _: {"all": "newer"})
    with pytest.raises(StudyError, match="stored with other code"):
        Study(spec, tmp_path)
    assert len(Study.open(spec, tmp_path).study.get_trials()) == 2
    assert 'status = "not judged"' in read_preset_text(spec, tmp_path)
    with pytest.raises(StudyError, match="there is no study 'toy'"):
        Study.open(spec, tmp_path / "elsewhere")
    assert not (tmp_path / "elsewhere" / "studies").exists(), "looking creates nothing"


def test_the_code_of_each_sequence_counts(
    folders: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sequences of two kinds are read by other code; the one that is looked up last hides no other."""
    spec = make(folders, trials=2)

    def reader(version: str) -> Callable[[Mapping[str, Any]], dict[str, str]]:
        first = resolve(RunSpec(tracker=spec.tracker, sequence=folders[0])).identity["content"]
        return lambda run: {"code": version if run["content"] == first else "same"}

    monkeypatch.setattr("dynslam_bench.tuning.study.program_of", reader("older"))
    run_study(spec, results=tmp_path)
    monkeypatch.setattr("dynslam_bench.tuning.study.program_of", reader("newer"))
    with pytest.raises(
        StudyError, match='stored with other code: "older same" there, "newer same"'
    ):
        Study(spec, tmp_path)


def test_a_study_does_not_go_on_after_its_plug_in_changed(tmp_path: Path) -> None:
    folder = str(toy_tracker.make_sequence(tmp_path / "s0", 0.8))
    plugin = tmp_path / "plugin" / "toy_plugin.py"
    plugin.parent.mkdir()
    shutil.copy(toy_tracker.__file__, plugin)
    splits = {"tune": [folder], "confirm": [], "held_out": []}
    run_study(
        make([folder] * 3, **splits, tracker=f"{plugin}:SPEC", trials=2), results=tmp_path / "r"
    )
    plugin.write_text(plugin.read_text() + "\n# a note\n")
    with pytest.raises(
        StudyError, match=r"the file toy_plugin.py has changed since the baseline ran"
    ):
        run_study(
            make([folder] * 3, **splits, tracker=f"{plugin}:SPEC", trials=3), results=tmp_path / "r"
        )


def test_space_of_a_real_tracker_can_be_drawn() -> None:
    settings = TRACKERS.get("emfoa-oft").settings()
    space = search_space(
        settings, SpaceSpec(include=("flow.*", "epipolar.*", "segmentation.*"), fixed={})
    )
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(20):
        # every drawn configuration is valid
        apply_overrides(settings, study.ask(distributions(space)).params)


EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "tune_in_python.py"
DOCS = EXAMPLE.parents[1] / "docs"
FIELDS: dict[str, Any] = {
    "name": "py", "tracker": TRACKER, "tune": [TUNE], "held_out": [HELD_OUT], "recorded": (), "trials": 8,
    "space": {"include": ["gain", "wobble"]}, "min_coverage": None,
}  # fmt: skip


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs are drawn."""
    design = simulated_design(make_spec())
    monkeypatch.setattr("dynslam_bench.tuning.plan.design_of", lambda spec: design)
    for name in ("outcomes", "_identify", "_error"):
        monkeypatch.setattr(Study, name, getattr(SimulatedTuner, name), raising=False)
    for name, value in {"effect": staticmethod(valley), "noise_seed": 0, "_made": set()}.items():
        monkeypatch.setattr(Study, name, value, raising=False)


def steady(run: Outcome) -> float:
    return run.ate_m


@pytest.mark.usefixtures("drawn")
def test_own_objective_sampler_callbacks_and_start(tmp_path: Path) -> None:
    (tmp_path / "preset.toml").write_text("gain = 0.9\n")
    seen: list[int] = []
    study = Study(
        **FIELDS, results=tmp_path, objective=steady, sampler=optuna.samplers.RandomSampler(seed=3),
        callbacks=[lambda study, trial: seen.append(trial.number)], start=[tmp_path / "preset.toml", {"wobble": 0}],
    ).run()  # fmt: skip
    points = [(trial.params["gain"], trial.params["wobble"]) for trial in study.study.get_trials()]
    assert points[:3] == [(1.5, 2), (0.9, 2), (1.5, 0)]
    assert sorted(seen) == list(range(8))
    assert len(study.frame()) == 8
    assert study.spec.objectives == ("steady",)
    assert isinstance(study.study.sampler, optuna.samplers.RandomSampler)
    assert study.finish().candidates[0].evidence.what == "steady"
    again = Study(**FIELDS, results=tmp_path, objective=steady, start=[{"wobble": 0}])
    assert len(again.run().study.get_trials()) == 8, "resumed, and nothing enqueued twice"
    assert len(Study.open(tmp_path / "studies" / "py").frame()) == 8
    assert optuna.load_study(study_name="py", storage=open_storage(tmp_path, study.spec))


@pytest.mark.usefixtures("drawn")
def test_instances_may_be_objects(tmp_path: Path) -> None:
    instance = ProblemInstance("synthetic/walking_xyz?scene=3&frames=20", offset=2)
    study = Study(**{**FIELDS, "tune": [instance, TUNE]}, results=tmp_path)
    assert study.spec.tune == ("synthetic/walking_xyz?scene=3&frames=20&offsets=2", TUNE)
    assert study.spec.instances(study.spec.tune[0]) == [instance]


@pytest.mark.usefixtures("drawn")
@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"start": [{"gian": 1.0}]}, "'gian'.*'gain'"),
        ({"start": [{"mode": "crash"}]}, "'crash'.*'fine'"),
        ({"start": [{"gain": 99.0}]}, "gain = 99.0"),
        ({"objective": "sped"}, "unknown objective 'sped'.*'speed'"),
        ({"trails": 3}, "the study: unknown key 'trails'.*'trials'"),
        ({"start": ["nowhere.toml"]}, "nowhere.toml"),
    ],
)
def test_mistakes_are_one_clear_line(fields: dict[str, Any], named: str, tmp_path: Path) -> None:
    with pytest.raises(DynslamError, match=named):
        Study(**{**FIELDS, **fields}, results=tmp_path)


@pytest.mark.usefixtures("drawn")
def test_the_example_goes_as_it_stands_but_for_its_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runpy.run_path(str(EXAMPLE))["main"](str(tmp_path), 8)
    shown = capsys.readouterr().out
    assert "trial 0: {'frames': 5}" in shown
    assert "trial 1: {'frames': 2}" in shown
    assert shown.splitlines()[-1].startswith(
        ("No difference that matters", "Cannot tell", "Promising")
    ), "nothing can be gained there"


@pytest.mark.usefixtures("drawn")
def test_the_notebook_goes_as_it_stands_but_for_its_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    cells = json.loads((EXAMPLE.parent / "notebooks" / "study.ipynb").read_text())["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    exec(compile(code, "study.ipynb", "exec"), names)
    assert len(names["trials"]) == 12
    assert names["summary"].conclusion in capsys.readouterr().out


@pytest.mark.usefixtures("drawn")
def test_the_page_s_python_goes_as_it_stands_but_for_its_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib", reason="pandas draws with it")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fast.toml").write_text('"features.n_features" = 800\n')
    first, second = re.findall(
        r"^```python\n(.*?)^```", (DOCS / "how-to" / "study.md").read_text(), flags=re.S | re.M
    )
    exec(compile(first.replace("trials=30", "trials=6"), "docs/how-to/study.md", "exec"), {})
    assert "of which trials saw other scenes" in capsys.readouterr().out.splitlines()[-1]
    tuned = "params.features.n_features"
    second = second.replace("studies/thresholds", "studies/mine").replace(
        "params.epipolar.threshold_px", tuned
    )
    names: dict[str, Any] = {}
    exec(compile(second, "docs/how-to/study.md", "exec"), names)
    assert len(names["frame"]) == 6


LOSS = {"x": optuna.distributions.FloatDistribution(0, 1)}
SPEC = StudySpec(name="trust", tune=("synthetic/walking_xyz?frames=10",))


def add(path: Path, upto: int) -> None:
    """Open the study and add finished trials until it has so many."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    path.parent.mkdir(exist_ok=True)
    storage = optuna.storages.JournalStorage(JournalFile(path))
    study = optuna.create_study(storage=storage, study_name="s", load_if_exists=True)
    for x in [number / 8 for number in range(len(study.trials), upto)]:
        study.add_trial(optuna.trial.create_trial(value=x, params={"x": x}, distributions=LOSS))


def values(path: Path) -> list[float]:
    storage = optuna.storages.JournalStorage(JournalFile(path))
    return [trial.value for trial in optuna.load_study(storage=storage, study_name="s").trials]


@in_a_small_process
def test_no_fault_spoils_a_journal(tmp_path: Path) -> None:
    path = tmp_path / "study" / "journal.log"
    ends = survey(
        lambda: add(path, 3),
        path.parent,
        result=lambda: values(path),
        faults=("kill", "full", "read-only"),
    )
    assert values(path) == [0, 1 / 8, 2 / 8]
    assert path.read_bytes().endswith(b"\n")
    assert ends.operations > 8
    assert ends.ends["kill", -9] == ends.operations
    assert ends.ends["full", 3] > 3


def test_an_unfinished_line_is_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "journal.log"
    add(path, 2)
    with path.open("ab") as file:
        file.write(b'{"op_code": 4, "half')
    assert values(path) == [0, 1 / 8]
    add(path, 3)
    assert values(path) == [0, 1 / 8, 2 / 8]


def begin(url: str, barrier: Any) -> None:
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    barrier.wait()
    optuna.create_study(storage=open_database(url), study_name="s", load_if_exists=True)


def test_workers_may_begin_on_an_empty_database_at_the_same_time(tmp_path: Path) -> None:
    """SQLite, with as many errors as PostgreSQL gives: without repeats three of four workers fail."""
    context = multiprocessing.get_context("fork")
    barrier = context.Barrier(4)
    url = f"sqlite:///{tmp_path}/study.db"
    workers = [context.Process(target=begin, args=(url, barrier)) for _ in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(120)
    assert [worker.exitcode for worker in workers] == [0] * 4


@pytest.mark.parametrize("storage", ["redis://host/0", "postgres", "file:///x", "s3://bucket"])
def test_storages_that_may_hold_code_are_refused(tmp_path: Path, storage: str) -> None:
    with pytest.raises(StudyError, match="is of no kind that is known"):
        open_storage(tmp_path, SPEC.model_copy(update={"storage": storage}))


@pytest.mark.parametrize(
    "address",
    ["postgresql://me:s3cret@127.0.0.1:9/x", "mysql+nothing://me:s3cret@host/x", "postgresql://me:s3%63ret@127.0.0.1:9/x",
     "grpc://me:s3cret@host"],
)  # fmt: skip
def test_the_password_is_in_no_error_and_no_record(tmp_path: Path, address: str) -> None:
    spec = SPEC.model_copy(update={"storage": address})
    with pytest.raises(StudyError, match="cannot open the storage") as caught:
        open_storage(tmp_path, spec)
    assert "s3" not in str(caught.value)
    assert caught.value.__cause__ is None
    assert "s3" not in str(spec.for_others())


# Workers of one study on several machines: which live, what becomes of their trials, a database
# that restarts.


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storage, "HEARTBEAT_S", 0.1)
    monkeypatch.setattr(storage, "GRACE_S", 1.0)
    monkeypatch.setattr(storage, "NAMELESS_S", 0.5)
    monkeypatch.setattr("dynslam_bench.tuning.study._WAIT_S", 0.1)


def running(study: optuna.Study, worker: str) -> optuna.Trial:
    trial = study.ask()
    trial.set_user_attr("worker", worker)
    return trial


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> Callable[[optuna.Study], Heartbeats]:
    """Makes the heartbeats of another machine's worker."""

    def made(study: optuna.Study) -> Heartbeats:
        with monkeypatch.context() as patch:
            patch.setattr(storage, "worker_name", lambda: "there:1")
            return Heartbeats(study)

    return made


@pytest.mark.usefixtures("quick")
def test_a_worker_elsewhere_is_dead_once_it_counts_no_more(
    elsewhere: Callable[[optuna.Study], Heartbeats],
) -> None:
    study = optuna.create_study()
    alive = running(study, "there:1")
    silent = running(study, f"there:{os.getpid()}")
    nameless = study.ask()
    heartbeats, other = Heartbeats(study), elsewhere(study)

    def dead_after(seconds: float) -> set[int]:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            dead = {
                trial.number
                for trial in study.get_trials(deepcopy=False)
                if heartbeats.is_dead(trial)
            }
            time.sleep(0.1)
        return dead

    other.beat()
    with other.beating():
        assert dead_after(2.0) == {silent.number}, "the nameless trial may be that worker's"
    assert dead_after(2.0) == {alive.number, silent.number, nameless.number}


@pytest.mark.usefixtures("quick")
def test_running_trials_are_shown_with_their_workers(
    dead: str, elsewhere: Callable[[optuna.Study], Heartbeats]
) -> None:
    study = optuna.create_study()
    names = [worker_name(), dead, "there:1", "there:2"]
    for name in names:
        running(study, name)
    with elsewhere(study).beating():
        states = Heartbeats(study).running()
    ends = zip(names, ("alive", "dead", "alive", "silent"), strict=True)
    assert states == {number: f"{name}, {end}" for number, (name, end) in enumerate(ends)}


@pytest.mark.parametrize("answers_after", [1, None])
def test_a_database_that_does_not_answer_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answers_after: int | None
) -> None:
    calls = iter(range(1000))

    def fails(_: object) -> list[object]:
        if answers_after is None or next(calls) < answers_after:
            raise OperationalError("SELECT", {}, Exception("connection refused"))
        return []

    monkeypatch.setattr(database, "MAX_RETRY_S", 60.0 if answers_after else 0.0)
    monkeypatch.setattr(RDBStorage, "get_all_studies", fails)
    opened = open_database(f"sqlite:///{tmp_path}/study.db")
    refused = pytest.raises(
        StudyError, match=r"^the study's database does not answer: .*connection refused"
    )
    with nullcontext() if answers_after else refused:
        assert opened.get_all_studies() == []


class Postgres:
    """A server of its own, run by a user without privileges."""

    def __init__(self, root: Path) -> None:
        self.user = "postgres" if os.getuid() == 0 else None
        self.root = root
        if self.user:
            shutil.chown(root, self.user)
        self.run("initdb", "-D", str(root / "data"), "-U", "me", "--auth=trust")
        self.start()
        self.run("createdb", "-h", str(root), "-U", "me", "trials")
        self.url = f"postgresql+psycopg://me@/trials?host={root}"

    def run(self, program: str, *arguments: str) -> None:
        binary = next(Path("/usr/lib/postgresql").glob(f"*/bin/{program}"))
        subprocess.run(
            [binary, *arguments],
            check=True,
            user=self.user,
            cwd=self.root,
            stdout=subprocess.DEVNULL,
        )

    def start(self) -> None:
        log = str(self.root / "log")
        options = f"-c listen_addresses= -c unix_socket_directories={self.root}"
        self.run("pg_ctl", "-D", str(self.root / "data"), "-l", log, "-o", options, "-w", "start")

    def stop(self) -> None:
        self.run("pg_ctl", "-D", str(self.root / "data"), "-m", "immediate", "stop")


@pytest.fixture
def postgres() -> Iterator[Postgres]:
    pytest.importorskip("psycopg", reason="the extra [postgres] is not installed")
    if not list(Path("/usr/lib/postgresql").glob("*/bin/initdb")):
        pytest.skip("Debian's postgresql is not installed")
    root = Path(tempfile.mkdtemp(prefix="pg"))  # a socket's path is short
    server = Postgres(root)
    yield server
    server.stop()
    shutil.rmtree(root)


def test_a_killed_worker_and_a_restarted_database_lose_no_trial(
    folders: list[str], tmp_path: Path, postgres: Postgres
) -> None:
    spec = toy_spec(tune=folders[:1], confirm=folders[1:2], storage=postgres.url, trials=10)
    (tmp_path / "worker.py").write_text(WORKER)
    command = [sys.executable, str(tmp_path / "worker.py"), spec.model_dump_json()]
    elsewhere = ["unshare", "--uts", "--pid", "--fork", "--kill-child", "--mount-proc", "sh", "-c"]
    elsewhere.append('hostname "$0" && exec "$@"')
    if subprocess.run([*elsewhere, "other", "true"], check=False, capture_output=True).returncode:
        elsewhere = []  # namespaces need privileges
    workers = [
        subprocess.Popen(
            [*elsewhere, *([f"host{number}"] if elsewhere else []), *command, str(tmp_path / f"results{number}")],
            stderr=subprocess.PIPE, text=True, start_new_session=True,
        )
        for number in range(2)
    ]  # fmt: skip

    def finished() -> int:
        with suppress(KeyError):  # no study yet
            with_states = optuna.load_study(study_name="toy", storage=postgres.url).get_trials(
                deepcopy=False
            )
            return sum(trial.state.is_finished() for trial in with_states)
        return 0

    try:
        until(lambda: finished() >= 2)
        os.killpg(workers[0].pid, signal.SIGKILL)
        until(lambda: finished() >= 4)
        postgres.stop()
        postgres.start()
        _, errors = workers[1].communicate(timeout=240)
    finally:
        for worker in workers:
            if worker.poll() is None:
                os.killpg(worker.pid, signal.SIGKILL)
    assert workers[1].returncode == 0, errors[-2000:]
    assert "Traceback" not in errors, errors[-2000:]
    trials = optuna.load_study(study_name="toy", storage=postgres.url).get_trials()
    assert [trial.state for trial in trials] == [TrialState.COMPLETE] * 10


def test_fifty_workers_of_one_database_lose_repeat_and_double_no_trial(
    tmp_path: Path, postgres: Postgres
) -> None:
    spec = make_spec(trials=80, storage=postgres.url, pruner="none")

    def work(number: int) -> Study:
        return SimulatedTuner(spec, tmp_path / str(number), effect=valley, in_memory=False).run()

    # each with connections of its own; PostgreSQL takes 100 unless told otherwise
    with ThreadPoolExecutor(50) as pool:
        studies = list(pool.map(work, range(50)))
    trials = studies[0].study.get_trials()
    assert [trial.number for trial in trials] == list(range(len(trials)))
    assert {trial.state for trial in trials} == {TrialState.COMPLETE}
    assert len({tuple(sorted(trial.params.items())) for trial in trials}) == len(trials)
    assert 80 <= len(trials) < 80 + 50, "workers that ask at the same time may each begin one more"


def ran_on(trial: FrozenTrial) -> list[ProblemInstance]:
    return [parse_instances(text)[0] for text, *_ in trial.user_attrs["instances"]]


@pytest.mark.parametrize("pruner", ["halving", "wilcoxon"])
def test_values_are_of_the_instances_that_ran(pruner: str, tmp_path: Path) -> None:
    tuner = SimulatedTuner(make_spec(pruner=pruner, trials=16), tmp_path, effect=valley)
    trials = tuner.run().study.get_trials()
    assert trials[0].state == TrialState.COMPLETE
    assert {trial.state for trial in trials[1:]} >= {TrialState.PRUNED}
    for trial in trials:
        instances = ran_on(trial)
        value = ACCURACY.value(
            tuner.outcomes(tuner.configuration_of(trial).settings, instances), tuner.reference()
        )
        if trial.state == TrialState.COMPLETE:
            assert instances == list(tuner.design.tune), "a value is one of all instances"
            assert trial.values[0] == pytest.approx(value, abs=1e-12)
        else:
            assert trial.state == TrialState.PRUNED
            assert 3 <= len(instances) < len(tuner.design.tune)
            assert len(trial.intermediate_values) == len(instances)
            if pruner == "halving":
                assert trial.value == pytest.approx(value, abs=1e-12)
                assert len(instances) in (3, 6, 12)


def test_trials_of_several_objectives_run_on_all_instances(tmp_path: Path) -> None:
    tuner = SimulatedTuner(
        make_spec(objectives=["accuracy", "speed"]), tmp_path, effect=valley
    ).run()
    assert {len(ran_on(trial)) for trial in tuner.study.get_trials()} == {len(tuner.design.tune)}


def test_pruning_takes_half_the_runs_at_the_same_regret(tmp_path: Path) -> None:
    def cost(pruner: str) -> tuple[int, float]:
        specs = [make_spec(pruner=pruner, trials=24, sampler_seed=seed) for seed in range(3)]
        tuners = [
            SimulatedTuner(s, tmp_path / pruner / str(n), effect=valley, seed=n).run()
            for n, s in enumerate(specs)
        ]
        regret = np.mean([valley(tuner.study.best_trial.params) for tuner in tuners])
        return sum(tuner.runs for tuner in tuners), float(regret)

    (whole, best) = cost("none")
    (pruned, regret) = cost("halving")
    assert pruned <= 0.5 * whole
    assert regret <= best + 0.01


def test_nothing_is_claimed_where_nothing_is_better(tmp_path: Path) -> None:
    """Twelve studies; tests/benchmarks/study_null.py has more. The trials alone would claim a gain in most of them."""
    tuners = [
        SimulatedTuner(make_spec(sampler_seed=n), tmp_path / str(n), effect=nothing, seed=n)
        for n in range(12)
    ]
    lucky = sum(tuner.run().study.best_value < math.log(0.95) for tuner in tuners)
    summaries = [finish(tuner) for tuner in tuners]
    verdicts = [summary.verdict for summary in summaries]
    assert verdicts.count(ComparisonVerdict.PROVEN) == 0
    assert verdicts.count(ComparisonVerdict.WORSE) <= 2
    assert lucky >= 5, "what the trials alone say"


def test_eight_workers_and_a_resume_repeat_no_trial(tmp_path: Path) -> None:
    def work(count: int) -> SimulatedTuner:
        return SimulatedTuner(
            make_spec(trials=count, sampler="tpe"), tmp_path, effect=valley, in_memory=False
        ).run()

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, [32] * 8))
    tuner = work(40)  # one of them goes on later
    drawn = [tuple(sorted(trial.params.items())) for trial in tuner.study.get_trials()]
    assert len(set(drawn)) == len(drawn) == 40
    assert drawn[0] == (("gain", 1.5), ("wobble", 2)), "the default, once"
    journal = optuna.storages.journal.JournalFileBackend(str(tuner.folder / "journal.log"))
    study = optuna.load_study(
        study_name="simulated", storage=optuna.storages.JournalStorage(journal)
    )
    assert study.best_value == tuner.study.best_value
    assert study.metric_names == ["accuracy"]
    assert any(trial.intermediate_values for trial in study.trials), "for Optuna's dashboard"


@pytest.fixture
def dead() -> str:
    """The name of a worker that has ended."""
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    return f"{worker_name().rpartition(':')[0]}:{ended.pid}"


def test_a_trial_of_a_dead_worker_is_repeated(tmp_path: Path, dead: str) -> None:
    spec = make_spec(trials=6, pruner="none")
    tuner, other = (SimulatedTuner(spec, tmp_path, in_memory=False) for _ in range(2))

    def dies_later(event: StudyEvent) -> None:
        if event.kind == "finished" and event.number == 2:
            other.study.ask().set_user_attr("worker", dead)

    trials = tuner.run(on_event=dies_later).study.get_trials()
    assert [trial.state for trial in trials] == [TrialState.COMPLETE] * 6
    undisturbed = SimulatedTuner(spec, tmp_path / "again").run().study.get_trials()
    assert [trial.params for trial in trials] == [trial.params for trial in undisturbed]


@pytest.mark.parametrize("sampler", ["random", "tpe", "nsga2"])
@pytest.mark.parametrize("drawn", [0, 1])
def test_a_trial_gets_its_settings_where_its_worker_died_while_they_were_drawn(
    tmp_path: Path, dead: str, sampler: str, drawn: int
) -> None:
    """So many of two settings were stored."""
    spec = make_spec(trials=6, pruner="none", sampler=sampler)
    undisturbed = SimulatedTuner(spec, tmp_path / "whole").run().study.get_trials()
    tuner, other = (SimulatedTuner(spec, tmp_path, in_memory=False) for _ in range(2))

    def dies(event: StudyEvent) -> None:
        if event.kind == "finished" and event.number == 3:
            some = dict(list(distributions(other.space).items())[:drawn])
            other.study.ask(some).set_user_attr("worker", dead)

    trials = tuner.run(on_event=dies).study.get_trials()
    assert [trial.params for trial in trials] == [trial.params for trial in undisturbed]


def test_a_trial_that_a_worker_begins_again_is_not_begun_by_another(
    tmp_path: Path, dead: str
) -> None:
    """Both find its worker dead; the other one is quicker, and is running it, or has finished it."""
    for state in (TrialState.RUNNING, TrialState.COMPLETE):
        tuner, other = (
            SimulatedTuner(make_spec(trials=3), tmp_path / state.name, in_memory=False)
            for _ in range(2)
        )
        other.study.ask().set_user_attr("worker", dead)
        (lost,) = tuner.study.get_trials(states=(TrialState.RUNNING,))
        assert other._more()
        taken = other.ask()
        assert taken.number == lost.number
        if state == TrialState.COMPLETE:
            other.tell(taken, other.evaluate(taken))
        tuner._put_back(lost)
        assert tuner.study.get_trials()[lost.number].state == state


def test_a_trial_that_was_pruned_before_its_worker_died_is_pruned(
    tmp_path: Path, dead: str
) -> None:
    def outcomes(name: str, *, dies: bool) -> list[tuple[TrialState, float | None]]:
        tuner = SimulatedTuner(
            make_spec(pruner="halving", trials=12), tmp_path / name, effect=valley
        )
        killed = set[int]()
        tell = tuner.tell

        def dies_before(trial: optuna.Trial, evaluation: Evaluation) -> None:
            if trial.number in killed:
                tell(trial, evaluation)
            else:
                killed.add(trial.number)
                trial.set_user_attr("worker", dead)

        if dies:
            tuner.tell = dies_before
        return [(trial.state, trial.value) for trial in tuner.run().study.get_trials()]

    undisturbed = outcomes("a", dies=False)
    assert {state for state, _ in undisturbed} == {TrialState.COMPLETE, TrialState.PRUNED}
    assert outcomes("b", dies=True) == undisturbed


@pytest.mark.parametrize("start", ["", "1", "99999999"])
def test_a_number_that_another_process_has_now_is_no_sign_of_life(
    start: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This process has the number; without a time of start, as earlier versions wrote it, the counts decide."""
    monkeypatch.setattr(storage, "GRACE_S", 0.2)
    study = optuna.create_study()
    own = worker_name().partition(".")[0]
    trial = running(study, f"{own}.{start}" if start else own)
    (frozen,) = study.get_trials(deepcopy=False)
    heartbeats = Heartbeats(study)
    if start:
        assert heartbeats.is_dead(frozen)
    else:
        assert not heartbeats.is_dead(frozen)
        time.sleep(0.3)
        assert heartbeats.is_dead(frozen)
    trial.set_user_attr("worker", worker_name())
    (frozen,) = study.get_trials(deepcopy=False)
    assert not heartbeats.is_dead(frozen)


@pytest.mark.parametrize("writes", [1, 2, 3, 4, 5, 6])
def test_a_study_that_was_killed_while_it_was_begun_is_begun(tmp_path: Path, writes: int) -> None:
    """The journal holds so many of its first lines."""
    folder = tmp_path / "studies" / "simulated"
    spec = make_spec(trials=2, start=[{"gain": 1.0, "wobble": 0}])
    expected = SimulatedTuner(spec, tmp_path, in_memory=False).study.user_attrs
    lines = (folder / "journal.log").read_text().splitlines(keepends=True)
    assert len(lines) > writes
    (folder / "journal.log").write_text("".join(lines[:writes]))
    begun = SimulatedTuner(spec, tmp_path, in_memory=False)
    assert begun.study.user_attrs == expected
    assert [trial.system_attrs for trial in begun.study.get_trials()] == [
        {"fixed_params": {"gain": 1.5, "wobble": 2}},
        {"fixed_params": {"gain": 1.0, "wobble": 0}},
    ]


def test_one_worker_makes_the_same_trials_again(tmp_path: Path) -> None:
    def drawn(name: str, seed: int) -> list[dict[str, object]]:
        tuner = SimulatedTuner(
            make_spec(sampler="tpe", sampler_seed=seed), tmp_path / name, effect=valley
        )
        tuner.study.enqueue_trial({"gain": 1.0, "wobble": 0})
        return [trial.params for trial in tuner.run().study.get_trials()]

    first = drawn("a", 1)
    assert first == drawn("b", 1) != drawn("c", 2)
    assert first[:2] == [{"gain": 1.5, "wobble": 2}, {"gain": 1.0, "wobble": 0}], (
        "the default stays the first"
    )
