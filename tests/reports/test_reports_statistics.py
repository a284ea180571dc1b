"""The leaderboard's statistics against scipy and against constructed cases with known answers."""

import numpy as np
import pytest
from scipy import stats

from dynslam_bench.reports.statistics import critical_difference, holm, paired_p_value, power_note, standings


def cells(rng, trackers, sequences=6, runs=4, spread=0.1):
    hardness = rng.uniform(0.01, 0.5, sequences)
    return {
        name: {f"s{i}": list(hardness[i] * size * np.exp(rng.normal(0, spread, runs))) for i in range(sequences)}
        for name, size in trackers.items()
    }


def test_ratio_is_the_geometric_mean_of_medians():
    rng = np.random.default_rng(0)
    data = cells(rng, {"a": 0.5, "ref": 1.0})
    (a, ref) = standings(data, data["ref"], ["a", "ref"])
    expected = stats.gmean([np.median(data["a"][s]) / np.median(data["ref"][s]) for s in data["a"]])
    assert a.key == "a"
    assert a.ratio.value == pytest.approx(expected)
    assert a.ratio.low < a.ratio.value < a.ratio.high
    assert (ref.ratio.value, ref.ratio.low, ref.ratio.high) == (1, 1, 1)
    assert (a.rank.value, ref.rank.value) == (1, 2)
    assert a.improvement.value == pytest.approx(
        np.mean([stats.mannwhitneyu(data["ref"][s], data["a"][s]).statistic / 16 for s in data["a"]])
    )


def test_bootstrap_interval_agrees_with_scipy_where_there_is_one_run_a_cell():
    rng = np.random.default_rng(1)
    n = 40
    log_ratio = rng.normal(-0.3, 0.5, n)
    reference = {f"s{i}": [1.0] for i in range(n)}
    data = {"a": {f"s{i}": [float(np.exp(log_ratio[i]))] for i in range(n)}}
    (a,) = standings(data, reference, ["a"])
    other = stats.bootstrap((log_ratio,), np.mean, method="percentile", n_resamples=20000, rng=np.random.default_rng(0))
    low, high = np.exp(other.confidence_interval)
    assert a.ratio.low == pytest.approx(low, rel=0.02)
    assert a.ratio.high == pytest.approx(high, rel=0.02)


def test_intervals_cover_the_truth_about_as_often_as_they_say():
    hits = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        log_ratio = rng.normal(np.log(0.8), 0.3, 25)
        data = {"a": {f"s{i}": [float(np.exp(v))] for i, v in enumerate(log_ratio)}}
        (a,) = standings(data, {f"s{i}": [1.0] for i in range(25)}, ["a"])
        hits += a.ratio.low <= 0.8 <= a.ratio.high
    assert 50 <= hits <= 60


def test_ranks_mean_ranks_and_certainty():
    rng = np.random.default_rng(2)
    data = cells(rng, {"best": 0.1, "middle": 0.5, "worst": 5.0}, spread=0.01)
    found = standings(data, data["middle"], ["worst", "middle", "best"])
    assert [s.key for s in found] == ["best", "middle", "worst"]
    assert [(s.rank.low, s.rank.high) for s in found] == [(1, 1), (2, 2), (3, 3)]
    assert [s.mean_rank for s in found] == [1.0, 2.0, 3.0]
    assert [s.best_probability for s in found] == [1.0, 0.0, 0.0]


def test_equal_trackers_share_their_rank_and_their_certainty():
    rng = np.random.default_rng(3)
    one = cells(rng, {"a": 1.0})["a"]
    found = standings({"a": one, "b": {s: list(v) for s, v in one.items()}}, one, ["a", "b"])
    assert [s.rank.value for s in found] == [1, 1]
    assert [s.mean_rank for s in found] == [1.5, 1.5]


def test_unranked_and_incomplete_trackers_come_last_and_take_no_rank():
    rng = np.random.default_rng(4)
    data = cells(rng, {"a": 0.5, "ref": 1.0, "oracle": 0.01})
    data["partial"] = {"s0": data["a"]["s0"]}
    found = standings(data, data["ref"], ["a", "ref"])
    assert [s.key for s in found] == ["a", "ref", "oracle", "partial"]
    assert [s.rank is None for s in found] == [False, False, True, True]
    assert found[3].sequences == 1
    assert found[3].ratio.value == pytest.approx(np.median(data["a"]["s0"]) / np.median(data["ref"]["s0"]))


def test_the_same_seed_gives_the_same_intervals_and_order_does_not_matter():
    rng = np.random.default_rng(5)
    data = cells(rng, {"a": 0.5, "ref": 1.0})
    assert standings(data, data["ref"], ["a", "ref"]) == standings(data, data["ref"], ["a", "ref"])
    assert standings(data, data["ref"], ["a", "ref"], seed=1) != standings(data, data["ref"], ["a", "ref"])


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
    with_missing = a.copy()
    with_missing[3] = np.nan
    assert paired_p_value(with_missing, b) == pytest.approx(stats.wilcoxon(np.delete(a, 3), np.delete(b, 3)).pvalue)


def test_holm():
    assert holm({"a": 0.01, "b": 0.04, "c": 0.03}) == {
        "a": pytest.approx(0.03),
        "c": pytest.approx(0.06),
        "b": pytest.approx(0.06),
    }
    assert holm({"a": 0.6, "b": 0.7}) == {"a": 1.0, "b": 1.0}
    assert holm({}) == {}


def test_critical_difference_is_the_published_one():
    assert critical_difference(5, 8) == pytest.approx(2.16, abs=0.005)  # 2.728 sqrt(5*6 / (6*8))


def test_power_notes():
    small = power_note(5, 5, 1)
    assert "can never reach p < 0.05 (the smallest possible p is 0.0625)" in small
    assert "only 1 run:" in small
    assert "2.16" in power_note(5, 8, 3)
    assert "never reach" not in power_note(5, 8, 3)
    assert "(more than can occur)" in power_note(3, 2, 3)
    assert "nothing can be compared" in power_note(0, 0, 0)
    assert power_note(1, 8, 5) == "8 sequences, 1 ranked trackers, at least 5 runs a cell."
