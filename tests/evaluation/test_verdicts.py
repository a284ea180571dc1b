"""Verdicts on paired errors, compared with scipy's tests and with a prototype that nobody here ships."""

import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from dynslam_bench.evaluation.verdicts import (
    FEWEST,
    LOOKS,
    USUAL_SPREAD,
    ComparisonVerdict,
    PairedRatio,
    detectable,
    family_test,
    findings,
    hodges_lehmann,
    interval_with_ties,
    loses_more_p,
    may_be_best,
    paired_ratio,
    power,
    resolution_floor,
    scenes_needed,
    scenes_to_exclude,
    scenes_to_settle,
    verdict_of,
)

PROTOTYPE = Path(__file__).parents[3] / "shared/prototypes/statistics.py"


def named(values: list[float]) -> dict[str, float]:
    """Log ratios of scenes that are called by their number."""
    return {str(number): value for number, value in enumerate(values)}


def judged(
    ratios: list[float], lost: tuple[str, ...] = (), lost_baseline: tuple[str, ...] = ()
) -> PairedRatio:
    return paired_ratio(named([math.log(ratio) for ratio in ratios]), lost, lost_baseline)


@pytest.mark.parametrize("count", [6, 7, 12, 25])
@pytest.mark.parametrize("confidence", [0.95, 0.90, 0.80])
def test_the_interval_holds_what_the_signed_rank_test_of_scipy_does_not_reject(
    count: int, confidence: float
) -> None:
    values = np.random.default_rng(count).normal(0.1, 0.4, count)
    _, low, high = hodges_lehmann(values, confidence)

    def p_value(shift: float) -> float:
        return float(stats.wilcoxon(values - shift, method="exact").pvalue)

    for inside, outside in ((low + 1e-9, low - 1e-9), (high - 1e-9, high + 1e-9)):
        assert p_value(inside) > 1 - confidence + 1e-9
        assert p_value(outside) <= 1 - confidence + 1e-9


def test_five_scenes_have_no_interval_at_95_per_cent() -> None:
    assert hodges_lehmann([0.1, 0.2, 0.3, 0.4, 0.5]) == (pytest.approx(0.3), -math.inf, math.inf)


@pytest.mark.parametrize(
    ("ratios", "verdict"),
    [
        ([0.8, 0.82, 0.79, 0.85, 0.81, 0.8], ComparisonVerdict.PROVEN),
        ([1.2, 1.25, 1.3, 1.22, 1.4, 1.21], ComparisonVerdict.WORSE),
        ([1.0] * 9, ComparisonVerdict.NO_DIFFERENCE),
        ([1.0] * 8, ComparisonVerdict.CANNOT_TELL),
        ([0.97, 1.03, 1.01, 0.99, 1.02, 0.98, 1.0, 1.01], ComparisonVerdict.NO_DIFFERENCE),
        ([0.5, 0.6, 0.9, 0.7, 1.3, 0.8, 0.9], ComparisonVerdict.PROMISING),
        ([0.4, 1.9, 0.7, 1.5, 0.9, 1.2], ComparisonVerdict.CANNOT_TELL),
        ([0.1] * 5, ComparisonVerdict.CANNOT_TELL),
        ([0.1], ComparisonVerdict.CANNOT_TELL),
    ],
)
def test_verdicts(ratios: list[float], verdict: ComparisonVerdict) -> None:
    assert verdict_of(judged(ratios)) is verdict


def test_without_ties_differences_are_excluded_by_the_signed_rank_interval() -> None:
    values = np.random.default_rng(11).normal(0.0, 0.2, 14)
    assert interval_with_ties(values, 0.90) == hodges_lehmann(values, 0.90)


@pytest.mark.parametrize(
    ("ties", "others", "bounds"),
    [
        # too few of either to exclude anything
        (6, [0.01] * 3, (-math.inf, math.inf)),
        # the others alone, widened to contain 1
        (5, [0.01, 0.02, 0.03, 0.04, 0.05, 0.06], (0.0, 0.05)),
        # so many ties that the typical ratio is 1; the estimate of the others stays inside
        (9, [], (0.0, 0.0)),
        (38, [0.4, 0.5], (0.0, 0.45)),
    ],
)
def test_ties_exclude_by_the_other_scenes_or_by_their_number(
    ties: int, others: list[float], bounds: tuple[float, float]
) -> None:
    _, low, high = interval_with_ties([*[0.0] * ties, *others], 0.90)
    assert (low, high) == pytest.approx(bounds)


def test_a_setting_that_rarely_acts_and_matters_is_not_excluded() -> None:
    """In six of ten scenes nothing differs; the pseudo-median of all is at the margin."""
    rng = np.random.default_rng(12)
    wrong = 0
    for _ in range(400):
        acts = rng.random(12) >= 0.6
        logs = acts * rng.normal(0.2206, 0.05, 12)
        wrong += verdict_of(paired_ratio(named(logs.tolist()))) is ComparisonVerdict.NO_DIFFERENCE
    assert wrong / 400 <= 0.05


def test_equal_errors_are_said_with_the_scenes_that_settle_them() -> None:
    same = judged([1.0] * 7)
    assert verdict_of(same) is ComparisonVerdict.CANNOT_TELL
    assert "exactly the same error in 7 scenes" in " ".join(findings(same))
    needed = scenes_to_settle(same)
    assert needed == 9
    assert verdict_of(judged([1.0] * needed)) is ComparisonVerdict.NO_DIFFERENCE


def test_no_verdict_says_that_nothing_matters_where_nothing_is_known() -> None:
    """Both figures come from studies that were said not to matter here."""
    wide = PairedRatio(
        ratio=0.60, low=0.30, high=1.10, low_90=0.35, high_90=0.98, high_80=0.9, scenes=8
    )
    assert verdict_of(wide) is ComparisonVerdict.PROMISING
    wider = wide.model_copy(
        update={"ratio": 1.479, "low": 0.446, "high": 4.9, "high_90": 4.0, "high_80": 3.0}
    )
    assert verdict_of(wider) is ComparisonVerdict.CANNOT_TELL


def test_a_catastrophe_is_said_and_takes_the_proof_away() -> None:
    one_of_fourteen = judged([0.85 + 0.001 * number for number in range(13)] + [20.0])
    assert verdict_of(one_of_fourteen) is ComparisonVerdict.BUT_LOST
    sentence = ". ".join(findings(one_of_fourteen))
    assert "lost in 1 of 14 scenes" in sentence
    assert "x 20" in sentence
    assert "13" in sentence


def test_losses_on_both_sides_leave_the_proof_and_are_said() -> None:
    names = [f"scene {number}" for number in range(14)]
    logs = {name: math.log(0.8) + 0.001 * len(name) for name in names}
    comparison = paired_ratio(logs, ["scene 3"], ["scene 4", "scene 5"])
    assert verdict_of(comparison) is ComparisonVerdict.PROVEN
    assert "scene 3" in " ".join(findings(comparison))
    assert comparison.scenes == 11
    assert comparison.all_scenes == 14


def test_many_losses_are_worse_whatever_the_typical_error_is() -> None:
    lost = tuple(str(number) for number in range(7))
    comparison = judged([0.5] * 20, lost)
    assert verdict_of(comparison) is ComparisonVerdict.WORSE
    only_five = judged([0.5] * 20, lost[:5])
    assert stats.binomtest(5, 5, alternative="greater").pvalue > 0.025
    assert verdict_of(only_five) is ComparisonVerdict.BUT_LOST


@pytest.mark.parametrize(("lost", "lost_other"), [(0, 0), (1, 0), (5, 0), (6, 0), (9, 2), (3, 3)])
def test_more_losses_are_tested_as_scipy_does(lost: int, lost_other: int) -> None:
    expected = 1.0
    if lost:
        expected = stats.binomtest(lost, lost + lost_other, alternative="greater").pvalue
    assert loses_more_p(lost, lost_other) == pytest.approx(expected)


@pytest.mark.parametrize(("losses", "scenes"), [(0, 14), (1, 14), (3, 24), (6, 6)])
def test_the_share_of_losses_is_bounded_as_scipy_bounds_it(losses: int, scenes: int) -> None:
    comparison = judged([0.9] * scenes, tuple(str(number) for number in range(losses)))
    exact = stats.binomtest(losses, scenes).proportion_ci(confidence_level=0.90, method="exact")
    assert comparison.loss_share == pytest.approx(exact.high)


def test_all_lost_a_lost_baseline_and_no_scenes_cannot_tell() -> None:
    every = tuple(str(number) for number in range(8))
    for comparison in (
        judged([0.9] * 8, every, every),
        judged([0.9] * 8, (), every[:5]),
        judged([]),
    ):
        assert verdict_of(comparison) is ComparisonVerdict.CANNOT_TELL
        assert findings(comparison)
    assert verdict_of(judged([0.9] * 8, every)) is ComparisonVerdict.WORSE


@pytest.mark.slow
def test_rules_are_those_of_the_prototype() -> None:
    if not PROTOTYPE.is_file():
        pytest.skip("../shared/prototypes is not here")
    spec = importlib.util.spec_from_file_location("prototype_of_statistics", PROTOTYPE)
    assert spec is not None
    assert spec.loader is not None
    prototype = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(prototype)
    words = {"smaller typical error, but": "smaller typical error, but lost"}
    rng = np.random.default_rng(0)
    said = set()
    for _ in range(600):
        count = int(rng.integers(3, 30))
        logs = rng.normal(rng.choice([-0.4, -0.2, 0.0, 0.3]), rng.choice([0.05, 0.3, 0.8]), count)
        lost = rng.random(count) < rng.choice([0.0, 0.1, 0.3])
        lost_baseline = rng.random(count) < rng.choice([0.0, 0.1])
        expected, facts = prototype.verdict(logs, lost, lost_baseline)
        names = np.array([str(number) for number in range(count)])
        comparison = paired_ratio(named(logs.tolist()), names[lost], names[lost_baseline])
        verdict = verdict_of(comparison).value
        assert verdict == words.get(expected, expected)
        # the prototype divides by all scenes, those that both lost among them, as we do
        assert comparison.loss_share == pytest.approx(facts["share at most"])
        said.add(verdict)
    assert len(said) == len(ComparisonVerdict)
    families = ["a"] * 5 + ["b"] * 5 + ["c"] * 4 + ["d"] * 4
    logs = rng.normal(-0.1, 0.3, (5, len(families)))
    logs[1, 3] = math.nan
    these, beyond = prototype.board(logs, families)
    tests = [family_test(row, families) for row in logs]
    assert prototype.holm([test.these_p for test in tests]) == pytest.approx(these)
    assert prototype.holm([test.beyond_p for test in tests]) == pytest.approx(beyond)
    whole = rng.normal(0, 0.2, (5, len(families))) + np.linspace(0, 1, 5)[:, None]
    assert may_be_best(whole, families) == prototype.may_be_best(whole, families)


def test_runs_that_are_lost_in_no_whole_scene_are_said_and_take_the_proof_away() -> None:
    logs = named([math.log(0.73 + 0.001 * number) for number in range(28)])
    kept = paired_ratio(logs, runs=84)
    losing = paired_ratio(logs, runs=84, lost_runs=(28, 0))
    assert verdict_of(kept) is ComparisonVerdict.PROVEN
    assert verdict_of(losing) is ComparisonVerdict.BUT_LOST
    assert "lost in 28 of 84 runs" in findings(losing)[0]
    assert verdict_of(paired_ratio(logs, runs=84, lost_runs=(2, 2))) is ComparisonVerdict.PROVEN


def test_all_looks_together_exclude_at_the_level_of_one() -> None:
    """Each look's interval is as wide as its share of the level; naive ones are wrong in 12 %."""
    rng = np.random.default_rng(0)
    wrong = 0
    for _ in range(400):
        logs = rng.normal(math.log(1.1), 0.15, 48)
        wrong += any(
            verdict_of(paired_ratio(named(logs[:scenes].tolist()), one_sided=level))
            is ComparisonVerdict.NO_DIFFERENCE
            for scenes, level in LOOKS.items()
        )
    assert wrong / 400 <= 0.08


def test_what_is_no_number_is_lost() -> None:
    comparison = paired_ratio(named([0.1] * 6) | {"nan": math.nan, "endless": math.inf})
    assert set(comparison.lost) == {"nan", "endless"}
    assert comparison.scenes == 6


def test_power_agrees_with_simulated_studies() -> None:
    rng = np.random.default_rng(1)
    for scenes, spread, level in ((14, 0.3, 0.025), (28, 0.39, 0.025), (24, 0.34, LOOKS[24])):
        shown = 0
        for _ in range(400):
            logs = rng.normal(math.log(0.8), spread, scenes)
            shown += hodges_lehmann(logs, 1 - 2 * level).high < 0
        assert shown / 400 == pytest.approx(power(0.2, spread, scenes, level), abs=0.07)


def test_scenes_for_a_gain_and_for_an_exclusion() -> None:
    """The prototype's simulations ask for 21, 28 and 48 scenes, and for 24 and 90."""
    assert [scenes_needed(0.2, spread) for spread in (0.34, 0.39, 0.5)] == pytest.approx(
        [21, 28, 48], abs=4
    )
    assert [scenes_to_exclude(0.1, spread) for spread in (0.15, 0.3)] == pytest.approx(
        [24, 90], abs=4
    )
    assert detectable(0.3, FEWEST - 1) == 1.0
    assert power(0.2, 0.3, FEWEST - 1) == 0.0
    assert scenes_needed(0.2, 0.3, LOOKS[12]) > scenes_needed(0.2, 0.3)


def test_what_would_settle_a_comparison() -> None:
    promising = judged([0.5, 0.6, 0.9, 0.7, 1.3, 0.8, 0.9])
    assert promising.spread is not None
    assert promising.ratio is not None
    assert scenes_to_settle(promising) == scenes_needed(1 - promising.ratio, USUAL_SPREAD), (
        "seven scenes tell little of the scatter"
    )
    many = judged([0.7, 1.2, 0.8, 0.95] * 4)
    assert many.ratio is not None
    assert many.spread is not None
    assert scenes_to_settle(many) == max(17, scenes_needed(1 - many.ratio, many.spread))
    level = judged([0.7, 1.4, 1.01, 0.8, 1.25, 0.99, 1.02])
    assert level.spread is not None
    assert scenes_to_settle(level) == scenes_to_exclude(0.1, USUAL_SPREAD)
    assert scenes_to_settle(judged([0.7])) is None


def test_families_with_one_sequence_each_are_a_paired_t_test() -> None:
    logs = np.random.default_rng(3).normal(-0.3, 0.3, 9)
    tested = family_test(logs, [str(number) for number in range(9)])
    assert tested.beyond_p == pytest.approx(stats.ttest_1samp(logs, 0).pvalue)
    assert tested.these_p == 1.0


def test_three_families_say_nothing_beyond_them() -> None:
    logs = np.random.default_rng(4).normal(-0.5, 0.1, 12)
    tested = family_test(logs, ["a", "b", "c"] * 4)
    assert tested.these_p < 1e-4
    assert tested.beyond_p == 1.0


def test_the_floor_is_what_a_board_shows_in_four_of_five() -> None:
    tested = family_test(
        np.random.default_rng(5).normal(0, 0.3, 24), [str(n // 3) for n in range(24)]
    )
    floor = resolution_floor(tested.these_error, tested.these_free, 1, 0.05)
    noncentrality = -math.log1p(-floor) / tested.these_error
    critical = stats.t.isf(0.025, tested.these_free)
    assert stats.nct.sf(critical, tested.these_free, noncentrality) == pytest.approx(0.8, abs=0.02)
    assert resolution_floor(tested.these_error, tested.these_free, 8, 0.05) > floor
