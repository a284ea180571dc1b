"""The study page's figures: ratios instead of logarithms, default and chosen marked, every setting with its range."""

import math
from types import SimpleNamespace
from typing import cast

import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution
from optuna.trial import FrozenTrial, create_trial

from dynslam_bench.core.settings import Parameter
from dynslam_bench.tuning.figures import front, history, settings_table, slices
from dynslam_bench.tuning.instances import ProblemInstance
from dynslam_bench.tuning.page import fewer_starts, star_of
from dynslam_bench.tuning.splits import Design, with_more_starts
from dynslam_bench.tuning.summary import StudySummary

SPACE = [
    Parameter("a.threshold", "float", 1.0, 0.1, 10.0, "log", unit="px"),
    Parameter("a.mode", "categorical", "fast", choices=("fast", "slow")),
]


@pytest.fixture
def trials() -> list[FrozenTrial]:
    """The default and two more; ratios 1, 0.5 and 2 of the first objective, 1, 2 and 4 of the second."""
    found = []
    kinds = {"a.threshold": FloatDistribution(0.1, 10), "a.mode": CategoricalDistribution(["fast", "slow"])}
    for number, (x, mode, first, second) in enumerate([(1, "fast", 1, 1), (3, "slow", 0.5, 2), (0.2, "fast", 2, 4)]):
        params = {"a.threshold": float(x), "a.mode": mode}
        trial = create_trial(params=params, distributions=kinds, values=[math.log(first), math.log(second)])
        trial.number = number
        found.append(trial)
    return found


def by_name(figure: dict, axis: str = "x") -> dict:
    return {trace["name"]: trace for trace in figure["data"] if trace.get("xaxis", "x") == axis}


def test_axes_are_ratios_and_default_and_chosen_are_marked(trials: list[FrozenTrial]) -> None:
    shown = by_name(history(trials, "ATE", (1, "chosen")))
    assert shown["best so far"]["y"] == [1.0, 0.5, 0.5]
    assert [(shown[name]["x"], shown[name]["y"]) for name in ("default", "chosen", "trial")] == [
        ([0], [1.0]), ([1], [0.5]), ([2], [2.0])
    ]  # fmt: skip
    assert "ratio of ATE" in history(trials, "ATE", (1, "chosen"))["layout"]["yaxis"]["title"]["text"]


def test_every_setting_has_a_panel_of_its_own_scale(trials: list[FrozenTrial]) -> None:
    figure = slices(trials, SPACE, {"a.threshold": 1.0, "a.mode": "fast"}, "ATE", (1, "chosen"))
    assert (figure["layout"]["xaxis"]["type"], figure["layout"]["xaxis2"]["type"]) == ("log", "category")
    assert by_name(figure)["chosen"]["x"] == [3.0] and by_name(figure, "x2")["chosen"]["x"] == ["slow"]
    assert by_name(figure)["default"]["x"] == [1.0] and by_name(figure, "x2")["default"]["x"] == ["fast"]


@pytest.mark.parametrize(("offsets", "said"), [((0,), True), ((0, 1), True), ((0, 1, 2), False), ((0, 1, 2, 3), False)])
def test_why_the_default_is_not_1_is_said_where_trials_run_from_fewer_starts(offsets: tuple, said: bool) -> None:
    race = tuple(ProblemInstance("synthetic/walking_xyz?scene=0", offset=offset) for offset in offsets)
    text = fewer_starts(Design(race, tuple(with_more_starts(race)), (), (), ()))
    assert ("over 3 or more starts" in text and "best so far" in text) is said and bool(text) is said


def test_nothing_is_called_chosen_that_was_not(trials: list[FrozenTrial]) -> None:
    candidates = [SimpleNamespace(trial=1)]
    kept, taken = (star_of(cast(StudySummary, SimpleNamespace(candidates=candidates, chosen=c))) for c in (None, 1))
    assert (kept, taken) == ((1, "best trial"), (1, "chosen"))
    assert by_name(history(trials, "ATE", kept))["best trial"]["x"] == [1]


def test_the_front_is_drawn(trials: list[FrozenTrial]) -> None:
    shown = by_name(front(trials, {0, 1}, ["ATE", "time"], (1, "chosen")))
    assert shown["front"]["x"] == pytest.approx([0.5, 1.0]) and shown["front"]["y"] == pytest.approx([2.0, 1.0])


def test_the_table_holds_default_chosen_and_range() -> None:
    table = settings_table(SPACE, {"a.threshold": 1.0, "a.mode": "fast"}, {"a.threshold": 3.0, "a.mode": "slow"}, True)
    assert [[cell.text for cell in row] for row in table.rows] == [
        ["a.threshold", "1", "3", "0.1 to 10, log", "px"],
        ["a.mode", "fast", "slow", "fast, slow", ""],
    ]
    assert [column.name for column in table.columns] == ["setting", "default", "chosen", "range", "unit"]
    missing = settings_table(SPACE, {"a.threshold": 1.0, "a.mode": "fast"}, None, False)
    assert missing.rows[0][2].text == "–" and missing.columns[2].name == "best trial"
