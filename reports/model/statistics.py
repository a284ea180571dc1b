"""Statistics of a leaderboard: ratios to a reference, who is better than it, and which trackers can be told apart.

Errors of different sequences are never averaged as they are (a hard sequence would drown the rest);
they are compared as ratios on the same sequence and averaged geometrically. Sequences of one family
go together, so claims are made twice: on these families, and beyond them (`evaluation.verdicts`). The
repeats of a cell give its median, and are no further evidence. Cells that a side lost are counted, and
take no part in a claim. Families may have weights, so that a mean over categories does not depend on
how many sequences each category has.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from dynslam_bench.evaluation.verdicts import (
    FEWEST_FAMILIES,
    FEWEST_FREE,
    FLOOR_M,
    FamilyTest,
    family_test,
    loses_more_p,
    may_be_best,
    resolution_floor,
)

Array = NDArray[np.float64]
Cells = Mapping[str, Mapping[str, Sequence[float]]]
"""Tracker to sequence to the errors of its runs there, in metres."""
RankingVerdict = Literal["better", "better, but lost", "worse", "cannot tell", "reference", ""]
"""Standing of a tracker to the reference; empty for one that is not ranked."""
Scope = Literal["", "on these families", "beyond these families", "by lost sequences"]
"""Scope of a verdict, or that losses alone show it; empty where nothing is claimed."""

FEWEST = 5
"""Sequences below which no interval is given and no two trackers are called different."""
FAMILY_ERROR = 0.04
"""Chance of any wrong claim in one family of tests; below 5 % since errors are only about log-normal."""
LOSS_ERROR = 0.01
"""Chance of any wrong claim by losses alone: with `FAMILY_ERROR` 5 % for all that is said of these families."""


@dataclass(frozen=True)
class Interval:
    """A value with its 95 % interval; without one, `low` and `high` are nan."""

    value: float
    low: float
    high: float


class Sequences(NamedTuple):
    """The sequences of a board, in one order.

    Attributes:
        names: Names of the sequences ``[S]``.
        families: The family of each ``[S]``.
        weights: Weight of each family.
    """

    names: Sequence[str]
    families: Sequence[str]
    weights: Mapping[str, float]

    def test(self, log_ratios: Array) -> FamilyTest:
        """Test log ratios ``[S]`` on these families and beyond them; nan values do not count."""
        return family_test(log_ratios, self.families, self.weights)

    def mean(self, values: Array) -> float:
        """Mean over families of their means of values ``[S]``; nan values do not count."""
        return self.test(values).centre

    @property
    def can_go_beyond(self) -> bool:
        """Whether there are enough families for claims beyond them."""
        return len(set(self.families)) >= FEWEST_FAMILIES

    @property
    def can_stay(self) -> bool:
        """Whether there are enough sequences within the families for claims on these."""
        return len(self.families) - len(set(self.families)) >= FEWEST_FREE


@dataclass(frozen=True)
class Standing:
    """Standing of a tracker on a board: its errors beside the reference, rank and verdict.

    Attributes:
        key: The tracker.
        ratio: Geometric mean over families of its median error over the reference's; its 95 %
            interval goes beyond these families where there are `FEWEST_FAMILIES`.
        rank: Rank by that ratio among the ranked trackers, 1 is best; None for an unranked one.
        group: First and last rank that the data leave open; None for an unranked tracker.
        may_be_best: Whether no rival is shown to be better (Hsu's procedure).
        mean_rank: Mean over sequences of its rank there; None for an unranked one.
        wins: Sequences on which its median error is smaller than the reference's.
        verdict: Whether it is better than the reference.
        scope: How far that goes.
        p_value: Two-sided p value of that scope, Holm-corrected over the ranked trackers; None
            where there is no verdict.
        sequences: Sequences it was run on.
        lost: Sequences that it lost and the reference did not, and the reverse.
    """

    key: str
    ratio: Interval
    rank: int | None
    group: tuple[int, int] | None
    may_be_best: bool
    mean_rank: float | None
    wins: int
    verdict: RankingVerdict
    scope: Scope
    p_value: float | None
    sequences: int
    lost: tuple[int, int] = (0, 0)


class RankingClaim(NamedTuple):
    """A claim on a tracker beside the reference; fields as in `Standing`."""

    verdict: RankingVerdict
    scope: Scope = ""
    p_value: float | None = None


def standings(
    cells: Cells,
    reference: Mapping[str, Sequence[float]],
    ranked: Sequence[str],
    *,
    families: Mapping[str, str] | None = None,
    weights: Mapping[str, float] | None = None,
    lost: Mapping[str, set[str]] | None = None,
    reference_lost: set[str] | None = None,
) -> list[Standing]:
    """Compare trackers over sequences.

    Args:
        cells: Errors of the trackers, those of failures imputed; a tracker may lack sequences if it
            is not ranked.
        reference: The reference's errors on every sequence.
        ranked: Trackers that take part in the ranking; each needs a value on every sequence.
        families: Family of each sequence; each its own where there are none.
        weights: Weight of each sequence; all the same where there are none.
        lost: Tracker to the sequences that it lost.
        reference_lost: Sequences that the reference lost.

    Returns:
        The ranked trackers from the best to the worst, then the others by their ratio.
    """
    if not cells or not reference:
        return []
    names = list(reference)
    sequences = sequences_of(names, families, weights)
    base = log_medians(reference, names)
    logs = {key: log_medians(cell, names) for key, cell in cells.items()}
    ranked_logs = {key: logs[key] for key in ranked}

    # what is claimed: from the sequences where both succeed
    is_lost = {
        key: np.array([name in (lost or {}).get(key, ()) for name in names], dtype=bool)
        for key in cells
    }
    base_lost = np.array([name in (reference_lost or ()) for name in names], dtype=bool)
    claims = claims_against(
        ranked_logs, base, sequences, {key: is_lost[key] for key in ranked}, base_lost
    )

    # the order: from all sequences, so that losing one never pays
    means = [round(sequences.mean(log), 12) for log in ranked_logs.values()]
    ranks = dict(
        zip(ranked, scipy.stats.rankdata(means, method="min").astype(int).tolist(), strict=True)
    )
    by_sequence = scipy.stats.rankdata(
        np.reshape([*ranked_logs.values()], (len(ranked), len(names))), axis=0
    )
    mean_ranks = dict(zip(ranked, by_sequence.mean(axis=1).tolist(), strict=True))
    succeeded = {key: np.where(is_lost[key], np.nan, log) for key, log in ranked_logs.items()}
    groups = rank_groups(succeeded, sequences)
    best = candidates_for_best(succeeded, sequences)

    unordered = []
    for key, log in logs.items():
        claim = claims.get(key, RankingClaim(""))
        ran = np.isfinite(log)
        alone = (
            int((is_lost[key] & ~base_lost & ran).sum()),
            int((base_lost & ~is_lost[key] & ran).sum()),
        )
        unordered.append(
            Standing(
                key=key,
                ratio=ratio_interval(log - base, sequences),
                rank=ranks.get(key),
                group=groups.get(key),
                may_be_best=key in best,
                mean_rank=mean_ranks.get(key),
                wins=int((log < base).sum()),
                verdict=claim.verdict,
                scope=claim.scope,
                p_value=claim.p_value,
                sequences=int(ran.sum()),
                lost=alone,
            )
        )
    return sorted(unordered, key=lambda s: (s.rank is None, s.rank or 0, s.ratio.value))


def sequences_of(
    names: Sequence[str],
    families: Mapping[str, str] | None = None,
    weights: Mapping[str, float] | None = None,
) -> Sequences:
    """Sequences with their families; the weight of a family is the sum of its sequences' weights.

    Args:
        names: The sequences.
        families: Family of each; each its own where there are none.
        weights: Weight of each; where there are none all families weigh the same.
    """
    of_each = [name if families is None else families[name] for name in names]
    if weights is None:
        return Sequences(names, of_each, dict.fromkeys(of_each, 1.0))
    totals = dict.fromkeys(of_each, 0.0)
    for name, family in zip(names, of_each, strict=True):
        totals[family] += weights[name]
    return Sequences(names, of_each, totals)


def ratio_interval(log_ratios: Array, sequences: Sequences) -> Interval:
    """Geometric mean of ratios, with its 95 % interval; nan values are left out.

    The interval goes beyond these families where there are `FEWEST_FAMILIES` or more, else it is of these
    families alone where their scatter has `FEWEST_FREE` degrees of freedom, else there is none.

    Args:
        log_ratios: Natural logarithms of the ratios ``[S]``.
        sequences: Sequences of the ratios.
    """
    tested = sequences.test(log_ratios)
    mean = float(np.exp(tested.centre))
    if np.isfinite(log_ratios).sum() < FEWEST:
        return Interval(mean, math.nan, math.nan)
    if tested.families >= FEWEST_FAMILIES:
        half = scipy.special.stdtrit(tested.beyond_free, 0.975) * tested.beyond_error
    elif tested.these_free >= FEWEST_FREE:
        half = scipy.special.stdtrit(tested.these_free, 0.975) * tested.these_error
    else:
        return Interval(mean, math.nan, math.nan)
    low = float(np.exp(tested.centre - half))
    high = float(np.exp(tested.centre + half))
    return Interval(mean, low, high)


class PairTest(NamedTuple):
    """Two trackers on the sequences where both succeed, and what they lost.

    Attributes:
        test: Test of the log ratios, first over second.
        lost: Sequences that the first alone lost, and the second alone.
    """

    test: FamilyTest
    lost: tuple[int, int]

    @property
    def loses_more_p(self) -> float:
        """One-sided p value of the first losing no more sequences than the second."""
        return loses_more_p(*self.lost)

    @property
    def difference_by_losses_p(self) -> float:
        """Two-sided p value of both losing as many."""
        return min(1.0, 2.0 * min(loses_more_p(*self.lost), loses_more_p(*self.lost[::-1])))


def pair_test(log: Array, other: Array, sequences: Sequences) -> PairTest:
    """Compare two trackers; with fewer than `FEWEST` sequences where both succeed only their losses tell.

    Args:
        log: Log errors of the first tracker ``[S]``; nan where it lost.
        other: Log errors of the second tracker ``[S]``; nan where it lost.
        sequences: The sequences.
    """
    differences = log - other
    tested = sequences.test(differences)
    if np.isfinite(differences).sum() < FEWEST:
        tested = tested._replace(these_p=1.0, beyond_p=1.0)
    is_lost = ~np.isfinite(log)
    other_is_lost = ~np.isfinite(other)
    lost = int((is_lost & ~other_is_lost).sum())
    lost_by_other = int((other_is_lost & ~is_lost).sum())
    return PairTest(tested, (lost, lost_by_other))


def claims_against(
    logs: Mapping[str, Array],
    base: Array,
    sequences: Sequences,
    lost: Mapping[str, NDArray[np.bool_]],
    base_lost: NDArray[np.bool_],
) -> dict[str, RankingClaim]:
    """Whether each tracker is better than the reference, Holm-corrected over the trackers.

    All claims of a board beyond its families are right together with a chance of at least 95 % (a
    family-wise error of `FAMILY_ERROR`), and so are all claims on these families, where claims by lost
    sequences alone (McNemar's exact test) have `LOSS_ERROR`.

    Args:
        logs: Tracker to the logarithms of its median errors ``[S]``.
        base: Logarithms of the reference's median errors ``[S]``.
        sequences: The sequences.
        lost: Tracker to which sequences it lost, bool ``[S]``.
        base_lost: Which sequences the reference lost, bool ``[S]``.
    """
    claims = dict.fromkeys(logs, RankingClaim("cannot tell"))
    others = [key for key, log in logs.items() if not np.array_equal(log, base)]
    if not others or len(base) < FEWEST:
        return claims
    reference = np.where(base_lost, np.nan, base)
    pair_tests = [
        pair_test(np.where(lost[key], np.nan, logs[key]), reference, sequences) for key in others
    ]
    beyond = holm([one.test.beyond_p for one in pair_tests]).tolist()
    these = holm([one.test.these_p for one in pair_tests]).tolist()
    by_losses = holm([one.loses_more_p for one in pair_tests]).tolist()
    for key, one, p_beyond, p_these, p_losses in zip(
        others, pair_tests, beyond, these, by_losses, strict=True
    ):
        # more losses than the reference's, beyond chance, whatever the errors are elsewhere
        if p_losses <= LOSS_ERROR:
            claims[key] = RankingClaim("worse", "by lost sequences", p_losses)
            continue
        if p_beyond <= FAMILY_ERROR:
            scope: Scope = "beyond these families"
            p_value = p_beyond
        elif p_these <= FAMILY_ERROR:
            scope = "on these families"
            p_value = p_these
        else:
            claims[key] = RankingClaim("cannot tell", "", min(p_beyond, p_these))
            continue
        if one.test.centre > 0:
            verdict: RankingVerdict = "worse"
        else:
            verdict = "better, but lost" if one.lost[0] > one.lost[1] else "better"
        claims[key] = RankingClaim(verdict, scope, p_value)
    return claims


def resolution(logs: Mapping[str, Array], base: Array, sequences: Sequences) -> tuple[float, float]:
    """Smallest differences, as shares, that a board shows in four of five: on these families, and beyond them.

    Args:
        logs: Ranked trackers to the logarithms of their median errors ``[S]``.
        base: Logarithms of the reference's median errors ``[S]``.
        sequences: The sequences.

    Returns:
        Both differences of a typical (median) tracker; 1 where nothing can be shown.
    """
    others = [log for log in logs.values() if not np.array_equal(log, base)]
    tests = [sequences.test(log - base) for log in others]
    if not tests or len(base) < FEWEST:
        return 1.0, 1.0
    these = []
    beyond = []
    for tested in tests:
        if tested.these_free >= FEWEST_FREE:
            these.append(
                resolution_floor(tested.these_error, tested.these_free, len(tests), FAMILY_ERROR)
            )
        if tested.families >= FEWEST_FAMILIES:
            beyond.append(
                resolution_floor(tested.beyond_error, tested.beyond_free, len(tests), FAMILY_ERROR)
            )
    return (
        float(np.median(these)) if these else 1.0,
        float(np.median(beyond)) if beyond else 1.0,
    )


class PairwiseResult(NamedTuple):
    """Result of the test of one tracker against another.

    Attributes:
        first_by: Below 0 where the first is shown to be better, above 0 where the second is, else 0.
        p_value: Holm-corrected over all pairs.
        scope: How far that goes.
    """

    first_by: float
    p_value: float
    scope: Scope = ""


def separable(
    logs: Mapping[str, Array], sequences: Sequences
) -> dict[tuple[str, str], PairwiseResult]:
    """Test which pairs of trackers the sequences tell apart, Holm-corrected over all pairs.

    The order of all pairs that are called separable is right together with a chance of at least
    95 %: beyond these families where there are `FEWEST_FAMILIES`, else on these families. Two
    trackers are compared where both succeed. A tracker that is better there and lost more sequences
    is not called better; one that lost more beyond chance (McNemar's exact test) is worse.

    Args:
        logs: Tracker to the logarithms of its median errors ``[S]``, in the same order of
            sequences; nan where it lost.
        sequences: The sequences.

    Returns:
        For every pair ``(a, b)``, a before b in `logs`.
    """
    pairs = list(combinations(logs, 2))
    if not pairs or len(sequences.names) < FEWEST:
        return dict.fromkeys(pairs, PairwiseResult(0.0, 1.0))
    pair_tests = [pair_test(logs[a], logs[b], sequences) for a, b in pairs]
    by_error = holm(
        [one.test.beyond_p if sequences.can_go_beyond else one.test.these_p for one in pair_tests]
    ).tolist()
    by_losses = holm([one.difference_by_losses_p for one in pair_tests]).tolist()
    scope: Scope = "beyond these families" if sequences.can_go_beyond else "on these families"
    orders = {}
    for pair, one, p_error, p_losses in zip(pairs, pair_tests, by_error, by_losses, strict=True):
        surplus = one.lost[0] - one.lost[1]
        orders[pair] = PairwiseResult(0.0, p_error)
        if p_losses <= LOSS_ERROR:
            orders[pair] = PairwiseResult(float(surplus), p_losses, "by lost sequences")
        elif p_error <= FAMILY_ERROR and one.test.centre * surplus >= 0:
            orders[pair] = PairwiseResult(one.test.centre, p_error, scope)
    return orders


def rank_groups(logs: Mapping[str, Array], sequences: Sequences) -> dict[str, tuple[int, int]]:
    """First and last rank that the data leave open to every tracker; arguments as in `separable`."""
    better = dict.fromkeys(logs, 0)
    worse = dict.fromkeys(logs, 0)
    for (a, b), order in separable(logs, sequences).items():
        if order.first_by:
            first, second = (a, b) if order.first_by < 0 else (b, a)
            worse[first] += 1
            better[second] += 1
    return {key: (1 + better[key], len(logs) - worse[key]) for key in logs}


def candidates_for_best(logs: Mapping[str, Array], sequences: Sequences) -> set[str]:
    """Trackers of which no rival is shown to be better; arguments as in `separable`."""
    keys = list(logs)
    if not keys or len(sequences.names) < FEWEST:
        return set(keys)
    return {
        keys[at]
        for at in may_be_best(
            np.array([*logs.values()]), sequences.families, weights=sequences.weights
        )
    }


def mean_rank_test(logs: Mapping[str, Array]) -> tuple[float, float] | None:
    """Friedman's test with Nemenyi's critical difference (Demsar 2006): ranks on every sequence, weights do not count.

    Args:
        logs: Tracker to the logarithms of its median errors ``[S]``; nan where it lost.

    Returns:
        The p value of all trackers being alike, and the difference above which two mean ranks are
        different at 5 %; None for fewer than three trackers or `FEWEST` sequences.
    """
    trackers = len(logs)
    sequences = len(next(iter(logs.values()), ()))
    if trackers < 3 or sequences < FEWEST:
        return None
    quantile = scipy.stats.studentized_range.ppf(0.95, trackers, np.inf) / math.sqrt(2.0)
    difference = float(quantile * math.sqrt(trackers * (trackers + 1) / (6.0 * sequences)))
    return float(scipy.stats.friedmanchisquare(*logs.values()).pvalue), difference


def holm(p_values: Sequence[float] | Array) -> Array:
    """Holm's step-down correction of several p values ``[K]``."""
    order = np.argsort(p_values, kind="stable")
    steps = np.minimum(1.0, np.asarray(p_values)[order] * np.arange(len(order), 0, -1))
    return np.asarray(np.maximum.accumulate(steps)[np.argsort(order)])


def log_medians(cell: Mapping[str, Sequence[float]], names: Sequence[str]) -> Array:
    """Logarithms of the median errors ``[S]``; nan where there is no run."""
    medians = [float(np.median(cell[name])) if cell.get(name) else np.nan for name in names]
    return np.asarray(np.log(np.maximum(np.asarray(medians, dtype=np.float64), FLOOR_M)))
