"""The study's page: its tables, what it warns of, and Optuna's plots beside it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import optuna
import pytest
import simulated
from optuna.trial import TrialState
from reports_browser import Browser, needs_browser

from dynslam_bench.core.settings import Parameter
from dynslam_bench.tuning import Study, finish, write_page
from dynslam_bench.tuning.page import fewer_starts, settings_table, warnings_of
from dynslam_bench.tuning.splits import Design, with_more_starts
from dynslam_bench.tuning.study_file import ProblemInstance

SPACE = [
    Parameter("a.threshold", "float", 1.0, 0.1, 10.0, "log", unit="px"),
    Parameter("a.mode", "categorical", "fast", choices=("fast", "slow")),
]


def tuner_of(study: optuna.Study, objective: str = "accuracy") -> Study:
    return cast("Study", SimpleNamespace(study=study, spec=SimpleNamespace(objectives=(objective,))))


@pytest.mark.parametrize("offsets", [(0,), (0, 1), (0, 1, 2), (0, 1, 2, 3)])
def test_a_default_of_more_starts_than_the_trials_is_explained(offsets: tuple[int, ...]) -> None:
    tune = tuple(ProblemInstance("synthetic/walking_xyz?scene=0", offset=offset) for offset in offsets)
    text = fewer_starts(Design(tune, tuple(with_more_starts(tune)), (), (), ()))
    assert bool(text) == (len(offsets) < 3)


@pytest.mark.parametrize(("values", "count"), [((0.01, 0.02, 0.03), 3), ((-0.01, 0.02, 0.03), 2), ((-1, -1, -1), 0)])
def test_infeasible_trials_are_counted(values: tuple[float, ...], count: int) -> None:
    study = optuna.create_study()
    for value in values:
        trial = study.ask()
        trial.set_constraint("ate", value)
        study.tell(trial, 1.0)
    (text, *_) = [note for note in warnings_of(tuner_of(study)) if "constraint" in note] or [""]
    assert (str(count) in text) == bool(text) == (count > 0)


def test_times_of_trials_are_called_unpaired() -> None:
    speed, accuracy = (warnings_of(tuner_of(optuna.create_study(), name)) for name in ("speed", "accuracy"))
    assert set(accuracy) < set(speed)


def test_the_table_holds_default_chosen_and_range() -> None:
    default: dict[str, Any] = {"a.threshold": 1.0, "a.mode": "fast"}
    table = settings_table(SPACE, default, {"a.threshold": 3.0, "a.mode": "slow"}, True)
    assert [[cell.text for cell in row] for row in table.rows] == [
        ["a.threshold", "1", "3", "0.1 to 10, log", "px"],
        ["a.mode", "fast", "slow", "fast, slow", ""],
    ]
    assert [column.name for column in table.columns] == ["setting", "baseline", "best trial", "range", "unit"]
    unproven = settings_table(SPACE, default, {}, False)
    assert unproven.rows[0][2].text == "–" and "keep the baseline" in unproven.caption


@needs_browser
def test_the_page_shows_verdict_funnel_and_optunas_plots(tmp_path: Path) -> None:
    tuner = simulated.SimulatedTuner(simulated.make_spec(trials=12), tmp_path)
    tuner.run()
    summary = finish(tuner)
    browser = Browser(tmp_path / "profile")
    try:
        for width in (1440, 390):
            browser.open(write_page(tuner, summary), width)
            browser.run("all('.figure').forEach((figure) => figure.scrollIntoView())")
            browser.until("all('.figure').every((figure) => figure.querySelector('.main-svg'))", tries=200)
            assert browser.faults == [] and browser.run("document.documentElement.scrollWidth") == width
        assert browser.violations() == []
        assert browser.run("one('.verdict').textContent") == summary.conclusion
        stages = browser.run("byId('result-1').layout.xaxis.ticktext")
        confirmed, held_out = (
            sum(getattr(candidate, split) is not None for candidate in summary.candidates)
            for split in ("confirm", "held_out")
        )
        complete = len(tuner.study.get_trials(states=(TrialState.COMPLETE,)))
        assert stages == [f"tried: {complete} whole trials", f"confirmed: {confirmed}", f"held out: {held_out}"]
        assert len(browser.run("all('.figure').map((figure) => figure.id)")) >= 6
    finally:
        browser.close()
