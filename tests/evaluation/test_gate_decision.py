"""The gate's statistics against a prototype, against arithmetic, and against noise in which nothing differs."""

import importlib.util
import math

import numpy as np
import pytest
from helpers.sequence_folders import SHARED
from scipy import stats

from dynslam_bench.evaluation.gate import (
    CLIP,
    LOOKS,
    ONE_LOOK,
    GateVerdict,
    decide,
    is_lost_more,
    log_ratios,
    mean_ratio,
)

PROTOTYPE = SHARED / "prototypes" / "statistics.py"


def test_ratios_are_cut_off_and_lost_runs_count_as_the_limit() -> None:
    candidate = [[1.0, 10.0, 0.01, math.nan, 1.0, math.nan, 0.0]]
    baseline = [[0.5, 1.0, 1.0, 1.0, math.nan, math.nan, 0.0]]
    expected = [math.log(2.0), CLIP, -CLIP, CLIP, -CLIP, 0.0, 0.0]
    assert log_ratios(candidate, baseline)[0].tolist() == pytest.approx(expected)


def test_the_interval_of_one_sequence_is_that_of_student() -> None:
    estimate = mean_ratio([[0.1, 0.2, 0.3]], 0.05)
    # the mean and t[0.975, 2] = 4.30265 standard errors of 0.1 / sqrt(3)
    assert estimate.centre == pytest.approx(0.2)
    assert estimate.high - estimate.centre == pytest.approx(
        4.30265 * 0.1 / math.sqrt(3.0), rel=1e-5
    )


def test_one_noisy_sequence_has_its_own_degrees_of_freedom() -> None:
    noisy = [0.5, -0.5, 0.4, -0.4]
    calm = [[0.0, 0.0, 0.0, 0.0]] * 7
    together = mean_ratio([noisy, *calm], 0.05)
    alone = mean_ratio([noisy], 0.05)
    assert together.high == pytest.approx(alone.high / 8.0)


def test_no_scatter_is_no_doubt_and_one_round_is_all_doubt() -> None:
    assert mean_ratio([[0.1, 0.1], [0.1, 0.1]]) == pytest.approx((0.1, 0.1, 0.1))
    assert mean_ratio([[0.1], [0.2]], 0.04).high == math.inf


def test_only_planned_looks_have_a_level() -> None:
    with pytest.raises(ValueError, match="after 5 rounds"):
        mean_ratio(np.zeros((8, 5)))


@pytest.mark.parametrize(
    ("lost", "of_baseline", "more"), [(5, 0, False), (6, 0, True), (6, 6, False), (20, 6, True)]
)
def test_more_losses_than_chance_explains(lost, of_baseline, more) -> None:
    assert is_lost_more(lost, of_baseline, 0.04) is more


def verdict_at_looks(ratios, lost=(0, 0)):
    """The verdict of a gate, and the rounds until then."""
    for rounds in LOOKS:
        verdict = decide(mean_ratio(ratios[:, :rounds]), lost)
        if verdict is not GateVerdict.UNDECIDED:
            return verdict, rounds
    return GateVerdict.UNDECIDED, max(LOOKS)


@pytest.mark.parametrize("spreads", [np.linspace(0.05, 0.3, 8), np.array([0.3, *[0.02] * 7])])
def test_nothing_is_claimed_where_nothing_changed(spreads) -> None:
    rng = np.random.default_rng(1)
    wrong = 0
    for _ in range(200):
        runs = spreads[:, None] * rng.normal(size=(2, 8, 10))
        verdict, _ = verdict_at_looks(np.clip(runs[0] - runs[1], -CLIP, CLIP))
        wrong += verdict in (GateVerdict.REGRESSED, GateVerdict.IMPROVED)
    assert wrong <= 16


def test_a_regression_of_ten_percent_is_found_in_most_gates() -> None:
    rng = np.random.default_rng(2)
    results = []
    for _ in range(100):
        # 2 sides, 16 sequences, 10 rounds; scatter 18 %
        runs = 0.18 * rng.normal(size=(2, 16, 10))
        results.append(verdict_at_looks(runs[0] - runs[1] + math.log(1.1)))
    verdicts = [verdict for verdict, _ in results]
    assert verdicts.count(GateVerdict.REGRESSED) >= 95
    assert GateVerdict.IMPROVED not in verdicts
    assert np.mean([rounds for _, rounds in results]) < 7


@pytest.mark.skipif(not PROTOTYPE.is_file(), reason="needs the prototype in ../shared")
def test_no_claim_is_bolder_than_the_prototype_s() -> None:
    spec = importlib.util.spec_from_file_location("prototype", PROTOTYPE)
    prototype = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(prototype)
    assert prototype.LOOKS == LOOKS
    rng = np.random.default_rng(3)
    names = {"no difference above the margin": "no difference"}
    same = 0
    for number in range(300):
        rounds = list(LOOKS)[number % len(LOOKS)]
        shift = rng.uniform(-0.2, 0.2)
        ratios = np.clip(shift + 0.2 * rng.normal(size=(8, rounds)), -CLIP, CLIP)
        lost = (int(rng.integers(0, 2)), int(rng.integers(0, 2)))
        before = prototype.gate(ratios, lost)
        after = decide(mean_ratio(ratios), lost).value
        # the pooled variance of the prototype is believed more than it is known
        assert after in (names.get(before, before), "undecided")
        same += after == names.get(before, before)
    assert same >= 270


def test_the_looks_spend_four_percent_by_the_square_of_the_share_of_rounds() -> None:
    paths = 400_000
    rng = np.random.default_rng(0)
    sums = rng.normal(size=(paths, max(LOOKS))).cumsum(axis=1)
    is_inside = np.ones(paths, dtype=bool)
    for rounds, level in LOOKS.items():
        score = np.abs(sums[:, rounds - 1]) / math.sqrt(rounds)
        is_inside &= score <= stats.norm.isf(level / 2.0)
        spent = 1.0 - is_inside.mean()
        share = ONE_LOOK * (rounds / max(LOOKS)) ** 2
        # three standard errors of the simulation, and levels of four digits
        assert spent == pytest.approx(share, abs=3.0 * math.sqrt(share / paths) + 1e-4)
