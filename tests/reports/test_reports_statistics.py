"""The leaderboard's statistics against scipy and against constructed cases with known answers."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from dynslam_bench.reports.model.statistics import (
    attainable_p,
    holm,
    paired_p_value,
    ratio_interval,
    separable,
    standings,
)

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
from rank_groups import simulate


def cells(rng, trackers, sequences=6, runs=4, spread=0.1):
    hardness = rng.uniform(0.01, 0.5, sequences)
    return {
        name: {f"s{i}": list(hardness[i] * size * np.exp(rng.normal(0, spread, runs))) for i in range(sequences)}
        for name, size in trackers.items()
    }


def test_ratio_is_the_geometric_mean_of_medians():
    data = cells(np.random.default_rng(0), {"a": 0.5, "ref": 1.0})
    (a, ref) = standings(data, data["ref"], ["a", "ref"])
    expected = stats.gmean([np.median(data["a"][s]) / np.median(data["ref"][s]) for s in data["a"]])
    assert a.key == "a"
    assert a.ratio.value == pytest.approx(expected)
    assert a.ratio.low < a.ratio.value < a.ratio.high
    assert (ref.ratio.value, ref.ratio.low, ref.ratio.high) == (1, 1, 1)
    assert (a.rank, ref.rank) == (1, 2)
    assert (a.wins, ref.wins) == (6, 0)
    assert a.better == pytest.approx(
        np.mean([stats.mannwhitneyu(data["ref"][s], data["a"][s]).statistic / 16 for s in data["a"]])
    )


def test_the_interval_of_a_ratio_is_students():
    values = np.random.default_rng(1).normal(-0.3, 0.5, 12)
    found = ratio_interval(np.append(values, np.nan))
    low, high = np.exp(stats.ttest_1samp(values, 0).confidence_interval(0.95))
    assert (found.low, found.high) == (pytest.approx(low), pytest.approx(high))
    few = ratio_interval(values[:4])
    assert few.value == pytest.approx(np.exp(values[:4].mean())) and np.isnan([few.low, few.high]).all()


def test_ranks_groups_and_mean_ranks():
    data = cells(np.random.default_rng(2), {"best": 0.1, "middle": 0.5, "worst": 5.0}, spread=0.01)
    places = [(s.key, s.group, s.mean_rank) for s in standings(data, data["middle"], ["worst", "middle", "best"])]
    assert places == [("best", (1, 1), 1.0), ("middle", (2, 2), 2.0), ("worst", (3, 3), 3.0)]


def test_below_five_sequences_there_is_one_group_and_from_five_on_clear_differences_show():
    rng = np.random.default_rng(3)
    for sequences, groups in ((4, [(1, 2), (1, 2)]), (5, [(1, 1), (2, 2)])):
        data = cells(rng, {"a": 0.1, "b": 1.0}, sequences=sequences)
        assert [s.group for s in standings(data, data["b"], ["a", "b"])] == groups


def test_a_difference_that_one_sequence_decides_is_none():
    data = {"a": {f"s{i}": [0.1] for i in range(6)}, "b": {f"s{i}": [0.1] for i in range(5)} | {"s5": [3.0]}}
    assert [s.group for s in standings(data, data["b"], ["a", "b"])] == [(1, 2), (1, 2)]


def test_pairs_are_tested_as_scipy_does_and_corrected_together():
    rng = np.random.default_rng(4)
    logs = {"a": rng.normal(0, 0.2, 7), "b": rng.normal(0.35, 0.2, 7), "c": rng.normal(2, 0.2, 7)}
    p = {pair: stats.ttest_rel(logs[pair[0]], logs[pair[1]]).pvalue for pair in separable(logs)}
    assert separable(logs) == dict(zip(p, holm([*p.values()]) <= 0.04, strict=True))
    assert separable(logs)["a", "c"]


def test_equal_trackers_share_their_rank():
    one = cells(np.random.default_rng(3), {"a": 1.0})["a"]
    found = standings({"a": one, "b": dict(one)}, one, ["a", "b"])
    assert [(s.rank, s.group, s.mean_rank) for s in found] == [(1, (1, 2), 1.5)] * 2


def test_unranked_and_incomplete_trackers_come_last_and_take_no_rank():
    data = cells(np.random.default_rng(4), {"a": 0.5, "ref": 1.0, "oracle": 0.01})
    data["partial"] = {"s0": data["a"]["s0"]}
    found = standings(data, data["ref"], ["a", "ref"])
    assert [s.key for s in found] == ["a", "ref", "oracle", "partial"]
    assert [s.rank is None for s in found] == [False, False, True, True]
    assert found[3].sequences == 1 and found[3].ratio.value == pytest.approx(
        np.median(data["a"]["s0"]) / np.median(data["ref"]["s0"])
    )


def test_an_error_of_zero_has_a_ratio():
    data = {"exact": {"s0": [0.0]}, "ref": {"s0": [0.01]}}
    found = standings(data, data["ref"], ["exact", "ref"])
    assert found[0].key == "exact"
    assert found[0].ratio.value == pytest.approx(1e-4)


def test_paired_test_is_scipys():
    rng = np.random.default_rng(6)
    a, b = rng.normal(0, 1, 12), rng.normal(0.5, 1, 12)
    assert paired_p_value(a, b) == pytest.approx(stats.wilcoxon(a, b).pvalue)
    assert paired_p_value(a, a) is None


def test_no_p_is_given_where_it_could_never_be_significant():
    assert attainable_p(5) == pytest.approx(stats.wilcoxon([1, 2, 3, 4, 5]).pvalue)
    rng = np.random.default_rng(7)
    for sequences, trackers, shown in ((5, 2, False), (6, 2, True), (6, 3, False), (7, 3, True)):
        data = cells(rng, {"ref": 1.0} | {f"t{i}": 0.1 for i in range(trackers - 1)}, sequences=sequences)
        found = {s.key: s.p_value for s in standings(data, data["ref"], list(data))}
        assert (found["t0"] is not None) == shown, (sequences, trackers)


@pytest.mark.parametrize(
    ("p_values", "corrected"),
    [
        ([0.01, 0.04, 0.03], [0.03, 0.06, 0.06]),
        ([0.6, 0.7], [1, 1]),
        ([], []),
    ],
)
def test_holm(p_values, corrected):
    assert holm(p_values) == pytest.approx(corrected)


@pytest.mark.parametrize("shape", ["normal", "heavy tails", "unequal spread", "skewed"])
@pytest.mark.parametrize("sequences", [3, 5, 8, 20])
def test_groups_hold_the_true_order(shape, sequences):
    right, _ = simulate(shape, np.sort(np.random.default_rng(0).normal(0, 0.25, 5)), sequences, 200)
    assert right >= 0.95
