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
    FamilyTest,
    family_test,
    may_be_best,
    resolution_floor,
)

Array = NDArray[np.float64]
Cells = Mapping[str, Mapping[str, Sequence[float]]]
"""Tracker to sequence to the errors of its runs there, in metres."""
Verdict = Literal["better", "better, but lost", "worse", "cannot tell", "reference", ""]
"""How a tracker stands to the reference; empty for one that is not ranked."""
Scope = Literal["", "on these families", "beyond these families"]
"""How far a verdict goes; empty where nothing is claimed."""

FLOOR_M = 1e-6
"""Errors below a micrometre count as one, so that their logarithm exists."""
FEWEST = 5
"""Sequences below which no interval is given and no two trackers are called different."""
FAMILY_ERROR = 0.04
"""Chance of any wrong claim in one family of tests; below 5 % since errors are only about log-normal."""


@dataclass(frozen=True)
class Interval:
    """A value with its 95 % interval; without one, `low` and `high` are nan."""

    value: float
    low: float
    high: float


class Sequences(NamedTuple):
    """The sequences of a board, in one order.

    Attributes:
        names: Their names ``[S]``.
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
    """Where a tracker stands.

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
    verdict: Verdict
    scope: Scope
    p_value: float | None
    sequences: int
    lost: tuple[int, int] = (0, 0)


class Claim(NamedTuple):
    """What is claimed of a tracker beside the reference; fields as in `Standing`."""

    verdict: Verdict
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
    groups = rank_groups(ranked_logs, sequences)
    best = candidates_for_best(ranked_logs, sequences)

    unordered = []
    for key, log in logs.items():
        claim = claims.get(key, Claim(""))
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
        log_ratios: Their logarithms ``[S]``.
        sequences: Their sequences.
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


def claims_against(
    logs: Mapping[str, Array],
    base: Array,
    sequences: Sequences,
    lost: Mapping[str, NDArray[np.bool_]],
    base_lost: NDArray[np.bool_],
) -> dict[str, Claim]:
    """Whether each tracker is better than the reference, Holm-corrected over the trackers.

    All claims of a board beyond its families are right together with a chance of at least 95 % (a
    family-wise error of `FAMILY_ERROR`), and so are all claims on these families.

    Args:
        logs: Tracker to the logarithms of its median errors ``[S]``.
        base: Those of the reference.
        sequences: The sequences.
        lost: Tracker to which sequences it lost ``[S]``.
        base_lost: Which the reference lost.
    """
    claims = dict.fromkeys(logs, Claim("cannot tell"))
    others = [key for key, log in logs.items() if not np.array_equal(log, base)]
    if not others or len(base) < FEWEST:
        return claims
    tests = {}
    for key in others:
        # where both succeed; on fewer than `FEWEST` sequences nothing is claimed
        ratios = np.where(lost[key] | base_lost, np.nan, logs[key] - base)
        tests[key] = sequences.test(ratios)
        if np.isfinite(ratios).sum() < FEWEST:
            tests[key] = tests[key]._replace(these_p=1.0, beyond_p=1.0)
    beyond = holm([tests[key].beyond_p for key in others]).tolist()
    these = holm([tests[key].these_p for key in others]).tolist()
    for key, p_beyond, p_these in zip(others, beyond, these, strict=True):
        loses_more = (lost[key] & ~base_lost).sum() > (base_lost & ~lost[key]).sum()
        if p_beyond <= FAMILY_ERROR:
            scope: Scope = "beyond these families"
            p_value = p_beyond
        elif p_these <= FAMILY_ERROR:
            scope = "on these families"
            p_value = p_these
        else:
            claims[key] = Claim("cannot tell", "", min(p_beyond, p_these))
            continue
        if tests[key].centre > 0:
            verdict: Verdict = "worse"
        else:
            verdict = "better, but lost" if loses_more else "better"
        claims[key] = Claim(verdict, scope, p_value)
    return claims


def resolution(logs: Mapping[str, Array], base: Array, sequences: Sequences) -> tuple[float, float]:
    """Smallest differences, as shares, that a board shows in four of five: on these families, and beyond them.

    Args:
        logs: Ranked trackers to the logarithms of their median errors ``[S]``.
        base: Those of the reference.
        sequences: The sequences.

    Returns:
        Of a typical (median) tracker; 1 where nothing can be shown.
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


def separable(
    logs: Mapping[str, Array], sequences: Sequences
) -> dict[tuple[str, str], tuple[bool, float]]:
    """Which trackers the sequences tell apart, Holm-corrected over all pairs.

    The order of all pairs that are called separable is right together with a chance of at least 95
    %: beyond these families where there are `FEWEST_FAMILIES`, else on these families.

    Args:
        logs: Tracker to the logarithms of its median errors ``[S]``, in the same order of
            sequences, none missing.
        sequences: The sequences.

    Returns:
        For every pair ``(a, b)``, a before b in `logs`, whether they differ, and the corrected p
        value.
    """
    pairs = list(combinations(logs, 2))
    if not pairs or len(sequences.names) < FEWEST:
        return dict.fromkeys(pairs, (False, 1.0))
    tests = [sequences.test(logs[a] - logs[b]) for a, b in pairs]
    p_values = [tested.beyond_p if sequences.can_go_beyond else tested.these_p for tested in tests]
    corrected = holm(p_values).tolist()
    return {pair: (p <= FAMILY_ERROR, p) for pair, p in zip(pairs, corrected, strict=True)}


def rank_groups(logs: Mapping[str, Array], sequences: Sequences) -> dict[str, tuple[int, int]]:
    """First and last rank that the data leave open to every tracker; arguments as in `separable`."""
    better = dict.fromkeys(logs, 0)
    worse = dict.fromkeys(logs, 0)
    means = {key: sequences.mean(log) for key, log in logs.items()}
    for (a, b), (apart, _) in separable(logs, sequences).items():
        if apart:
            first, second = (a, b) if means[a] < means[b] else (b, a)
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
        logs: As in `separable`.

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
