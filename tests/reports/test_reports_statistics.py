"""The leaderboard's statistics against scipy and against constructed cases with known answers."""

import sys
from pathlib import Path

import numpy as np
import pytest
import scikit_posthocs as posthocs
from scipy import stats

from dynslam_bench.reports.model.statistics import (
    holm,
    mean_rank_test,
    ratio_interval,
    separable,
    standings,
    verdicts_against,
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
    assert (a.verdict, ref.verdict) == ("better", "cannot tell")


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
    found = separable(logs, np.ones(7))
    p = holm([stats.ttest_rel(logs[a], logs[b]).pvalue for a, b in found])
    assert [p_value for _, p_value in found.values()] == pytest.approx(p)
    assert [apart for apart, _ in found.values()] == [*(p <= 0.04)] and found["a", "c"][0]


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


def test_who_is_better_than_the_reference_is_tested_as_scipy_does_and_corrected_over_the_trackers():
    rng = np.random.default_rng(7)
    base = rng.normal(0, 1, 9)
    logs = {f"t{i}": base + rng.normal(shift, 0.2, 9) for i, shift in enumerate((-1.0, 0.02, 0.0, 1.0))}
    found = verdicts_against(logs | {"ref": base}, base, np.ones(9))
    expected = holm([stats.ttest_rel(log, base).pvalue for log in logs.values()])
    assert [found[key][1] for key in logs] == pytest.approx(expected)
    assert [found[key][0] for key in logs] == ["better", "cannot tell", "cannot tell", "worse"]
    assert found["ref"] == ("cannot tell", None)


def test_weights_make_categories_count_alike_and_one_sequence_of_many_weights_is_no_evidence():
    logs = np.concatenate([np.full(2, -1.0), np.full(20, 1.0)]) + np.random.default_rng(8).normal(0, 0.01, 22)
    weights = np.concatenate([np.full(2, 1 / 2), np.full(20, 1 / 20)])
    found = ratio_interval(logs, weights)
    assert found.value == pytest.approx(np.exp((logs[:2].mean() + logs[2:].mean()) / 2))
    assert found.low < 0.4 and found.high > 2.5, "two sequences carry half of the weight"
    equal = ratio_interval(logs, np.full(22, 0.25))
    assert (equal.low, equal.high) == pytest.approx(np.exp(stats.ttest_1samp(logs, 0).confidence_interval(0.95)))


def test_the_critical_difference_is_demsars_and_the_ranks_are_those_of_friedmans_test():
    rng = np.random.default_rng(9)
    logs = {name: rng.normal(shift, 0.3, 12) for name, shift in (("a", 0.0), ("b", 1.0), ("c", 2.0), ("d", 3.0))}
    found = mean_rank_test(logs)
    assert list(found.ranks) == ["a", "b", "c", "d"] and sum(found.ranks.values()) == 10
    assert found.p_value == pytest.approx(stats.friedmanchisquare(*logs.values()).pvalue)
    assert found.critical_difference == pytest.approx(2.569 * np.sqrt(4 * 5 / (6 * 12)), rel=1e-3)  # his table 5
    assert mean_rank_test({"a": logs["a"], "b": logs["b"]}) is None


def test_nemenyis_differences_are_those_of_scikit_posthocs():
    rng = np.random.default_rng(10)
    logs = {str(i): rng.normal(0.4 * i, 0.5, 10) for i in range(6)}
    found = mean_rank_test(logs)
    p = posthocs.posthoc_nemenyi_friedman(np.stack(list(logs.values()), axis=1)).to_numpy()
    ranks = np.array([found.ranks[str(i)] for i in range(6)])
    apart = np.abs(ranks[:, None] - ranks) > found.critical_difference
    assert (apart == (p < 0.05)).all() and apart.any() and not apart.all()


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
def test_claims_of_simulated_boards_are_right(shape, sequences):
    right, _ = simulate(shape, np.sort(np.random.default_rng(0).normal(0, 0.25, 5)), sequences, 200)
    assert right.min() >= 0.95
