"""Studies from Python: own objective, sampler, callbacks, a preset to start from; mistakes in one line."""

from __future__ import annotations

import json
import re
import runpy
from pathlib import Path
from typing import Any

import optuna
import pytest
from simulated import HELD_OUT, TRACKER, TUNE, SimulatedTuner, make_spec, simulated_design, valley

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.tuning import Outcome, ProblemInstance, Study
from dynslam_bench.tuning.storage import open_storage

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "tune_in_python.py"
DOCS = EXAMPLE.parents[1] / "docs"
FIELDS: dict[str, Any] = {
    "name": "py", "tracker": TRACKER, "tune": [TUNE], "held_out": [HELD_OUT], "recorded": (), "trials": 8,
    "space": {"include": ["gain", "wobble"]}, "min_coverage": None,
}  # fmt: skip


@pytest.fixture(autouse=True)
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


def test_own_objective_sampler_callbacks_and_start(tmp_path: Path) -> None:
    (tmp_path / "preset.toml").write_text("gain = 0.9\n")
    seen: list[int] = []
    study = Study(
        **FIELDS, results=tmp_path, objective=steady, sampler=optuna.samplers.RandomSampler(seed=3),
        callbacks=[lambda study, trial: seen.append(trial.number)], start=[tmp_path / "preset.toml", {"wobble": 0}],
    ).run()  # fmt: skip
    trials = study.study.get_trials()
    assert [trial.params for trial in trials[:3]] == [
        {"gain": 1.5, "wobble": 2},
        {"gain": 0.9, "wobble": 2},
        {"gain": 1.5, "wobble": 0},
    ]
    assert sorted(seen) == list(range(8)) and len(study.frame()) == 8
    assert study.spec.objectives == ("steady",) and isinstance(study.study.sampler, optuna.samplers.RandomSampler)
    summary = study.finish()
    assert summary.candidates[0].confirm is not None and summary.candidates[0].confirm.what == "steady"
    again = Study(**FIELDS, results=tmp_path, objective=steady, start=[{"wobble": 0}])
    assert len(again.run().study.get_trials()) == 8, "resumed, and nothing enqueued twice"
    looked = Study.open(tmp_path / "studies" / "py")
    assert len(looked.frame()) == 8 and optuna.load_study(study_name="py", storage=open_storage(tmp_path, study.spec))


def test_instances_may_be_objects(tmp_path: Path) -> None:
    instance = ProblemInstance("synthetic/walking_xyz?scene=3&frames=20", offset=2)
    study = Study(**{**FIELDS, "tune": [instance, TUNE]}, results=tmp_path)
    assert study.spec.tune == ("synthetic/walking_xyz?scene=3&frames=20&offsets=2", TUNE)
    assert study.spec.instances(study.spec.tune[0]) == [instance]


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
    with pytest.raises(DynslamError, match=named) as caught:
        Study(**{**FIELDS, **fields}, results=tmp_path)
    assert "\n" not in str(caught.value)


def test_the_example_goes_as_it_stands_but_for_its_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(EXAMPLE))["main"](str(tmp_path), 8)
    told = capsys.readouterr().out
    assert "trial 0: {'frames': 5}" in told and "trial 1: {'frames': 2}" in told
    assert told.splitlines()[-1].startswith("Does not matter here"), "nothing can be gained there"


def test_the_notebook_goes_as_it_stands_but_for_its_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    cells = json.loads((EXAMPLE.parent / "notebooks" / "study.ipynb").read_text())["cells"]
    for cell in cells:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), "study.ipynb", "exec"), names)
    assert len(names["trials"]) == 12 and names["summary"].conclusion in capsys.readouterr().out


def test_the_page_s_python_goes_as_it_stands_but_for_its_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib", reason="pandas draws with it")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fast.toml").write_text('"backend.keyframes.tracked_share" = 0.8\n')
    first, second = re.findall(r"^```python\n(.*?)^```", (DOCS / "how-to" / "study.md").read_text(), flags=re.S | re.M)
    exec(compile(first.replace("trials=30", "trials=6"), "docs/how-to/study.md", "exec"), {})
    assert "scenes that no trial saw" in capsys.readouterr().out.splitlines()[-1]
    tuned = "params.backend.keyframes.tracked_share"
    second = second.replace("studies/thresholds", "studies/mine").replace("params.epipolar.threshold_px", tuned)
    names: dict[str, Any] = {}
    exec(compile(second, "docs/how-to/study.md", "exec"), names)
    assert len(names["frame"]) == 6
