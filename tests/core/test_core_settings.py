"""Settings: one annotation gives validation, overrides, search space and table; errors name what is wrong."""

from pathlib import Path
from typing import Literal

import pytest

from dynslam_bench.core.errors import DynslamError, SettingsError, did_you_mean
from dynslam_bench.core.settings import (
    Settings,
    apply_overrides,
    build,
    field_names,
    flatten,
    parameters,
    parse_assignments,
    settings_table,
    tunable,
)


class Epipolar(Settings):
    enabled: bool = tunable(True, meaning="whether to test")
    threshold_px: float = tunable(1.0, low=0.1, high=5.0, scale="log", unit="px", online=True, meaning="distance")
    wide: float = tunable(1.0, low=0.5, high=2.0, limits=(0.0, None), meaning="validated more widely than searched")


class Root(Settings):
    epipolar: Epipolar = Epipolar()
    features: int = tunable(1000, low=200, high=4000, meaning="keypoints")
    method: Literal["orb", "fast"] = tunable("orb", meaning="detector")
    name: str = "plain"
    maybe: float | None = None


def test_defaults_and_names():
    assert field_names(Root) == [
        "epipolar.enabled", "epipolar.threshold_px", "epipolar.wide", "features", "method", "name", "maybe",
    ]  # fmt: skip
    assert flatten(Root())["epipolar.threshold_px"] == 1.0
    assert build(Root, {"epipolar": {"threshold_px": 2}}).epipolar.threshold_px == 2.0


def test_parameters_describe_the_search_space():
    by_name = {p.name: p for p in parameters(Root)}
    assert list(by_name) == ["epipolar.enabled", "epipolar.threshold_px", "epipolar.wide", "features", "method"]
    threshold = by_name["epipolar.threshold_px"]
    assert (threshold.kind, threshold.low, threshold.high, threshold.scale) == ("float", 0.1, 5.0, "log")
    assert by_name["features"].kind == "int"
    assert by_name["epipolar.enabled"].choices == (False, True)
    assert by_name["method"].choices == ("orb", "fast")
    assert [p.name for p in parameters(Root, online_only=True)] == ["epipolar.threshold_px"]


@pytest.mark.parametrize(
    ("assignment", "name", "value"),
    [
        ("epipolar.threshold_px=1.5", "epipolar.threshold_px", 1.5),
        ("features=500", "features", 500),
        ("epipolar.enabled=false", "epipolar.enabled", False),
        ("method=fast", "method", "fast"),
        ("name=a=b", "name", "a=b"),
        ("maybe=null", "maybe", None),
        (" features = 300 ", "features", 300),
        ("epipolar.wide=9", "epipolar.wide", 9.0),
    ],
)
def test_assignments_of_the_command_line(assignment, name, value):
    settings = apply_overrides(Root(), parse_assignments([assignment]))
    assert flatten(settings)[name] == value
    untouched = {k: v for k, v in flatten(Root()).items() if k != name}
    assert {k: v for k, v in flatten(settings).items() if k != name} == untouched


@pytest.mark.parametrize(
    ("assignment", "expected"),
    [
        ("epipolar.treshold_px=1", r"unknown setting 'epipolar.treshold_px' \(did you mean 'epipolar.threshold_px'"),
        ("epipolar=1", r"setting 'epipolar' is a group \(set one of epipolar\.\*\)"),
        ("features.more=1", "unknown setting 'features.more'"),
        ("epipolar.threshold_px=9", r"setting 'epipolar.threshold_px' is 9: input should be less than or equal to 5"),
        ("epipolar.threshold_px=nan", "setting 'epipolar.threshold_px' is"),
        ("epipolar.threshold_px=wide", r"is 'wide': input should be a valid number"),
        ("features=2.5", "setting 'features' is 2.5"),
        ("method=sift", "setting 'method' is 'sift': input should be 'orb' or 'fast'"),
        ("epipolar.wide=-1", "setting 'epipolar.wide' is -1"),
        ("features", "'features' is not an assignment"),
        ("=3", "'=3' is not an assignment"),
    ],
)
def test_bad_assignments_are_one_clear_line(assignment, expected):
    with pytest.raises(SettingsError, match=expected) as caught:
        apply_overrides(Root(), parse_assignments([assignment]))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["34", "true", "null", "[1]", '"quoted"', "1e3", "", "NaN"])
def test_a_text_stays_the_text_that_it_is(text):
    class Texts(Settings):
        name: str = ""
        file: Path | None = None
        either: float | str = 1.0
        choice: Literal["true", "34", 2] = 2

    assert apply_overrides(Texts(), {"name": text}).name == text
    assert apply_overrides(Texts(), parse_assignments([f"name={text}"])).name == text
    assert apply_overrides(Texts(), {"either": text}).either == text
    assert apply_overrides(Texts(), {"file": text}).file == (None if text == "null" else Path(text))
    if text in ("34", "true"):
        assert apply_overrides(Texts(), {"choice": text}).choice == text
    assert apply_overrides(Texts(choice="34"), {"choice": "2"}).choice == 2


def test_settings_are_frozen_and_tables_hold_every_leaf():
    with pytest.raises(Exception, match="frozen"):
        Root().features = 5
    table = settings_table(Root)
    assert table.count("\n") == 2 + len(field_names(Root))
    assert "| `epipolar.threshold_px` | `1.0` | 0.1 to 5 (log) | px | yes | distance |" in table
    assert '| `method` | `"orb"` | `orb`, `fast` |' in table


def test_bad_annotations_are_bugs_of_the_author():
    with pytest.raises(ValueError, match="log scale needs low > 0"):
        tunable(1.0, low=0.0, high=1.0, scale="log", meaning="")

    with pytest.raises(TypeError, match=r"'value'.*needs low and high"):

        class NoRange(Settings):
            value: float = tunable(1.0, meaning="no range")


def test_a_default_outside_its_range_is_a_bug_of_the_author():
    with pytest.raises(TypeError, match=r"Outside: the default of 'value' is 1000.0, outside its range 0.2 to 10"):

        class Outside(Settings):
            value: float = tunable(1000.0, low=0.2, high=10.0, limits=(0.0, 1e4), meaning="x")

    with pytest.raises(TypeError, match=r"Other: the default of 'epipolar.wide' is 9.0, outside its range 0.5 to 2"):

        class Other(Root):
            epipolar: Epipolar = Epipolar(wide=9.0)


def test_a_group_with_other_defaults_is_described_with_them():
    class Other(Root):
        epipolar: Epipolar = Epipolar(threshold_px=2.5)

    assert {p.name: p.default for p in parameters(Other)}["epipolar.threshold_px"] == 2.5
    assert {p.name: p.default for p in parameters(Root)}["epipolar.threshold_px"] == 1.0
    assert "| `epipolar.threshold_px` | `2.5` |" in settings_table(Other)


def test_did_you_mean():
    assert did_you_mean("walkin", ["walking", "sitting"]) == "did you mean 'walking'?"
    assert did_you_mean("TUM", ["tum", "x"]) == "did you mean 'tum'?"
    assert did_you_mean("qqq", ["a", "b"]) == "known: a, b"
    assert did_you_mean("qqq", [f"name{i}" for i in range(30)]) == "30 are known, none is close"
    assert did_you_mean("a", []) == ""


def test_errors_survive_a_process_border():
    import pickle

    error = SettingsError("what", "how")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is SettingsError
    assert str(again) == str(error) == "what (how)"
    assert str(DynslamError("only")) == "only"
