"""Statistics of a leaderboard: ratios to a reference, who is better than it, and which trackers can be told apart.

Errors of different sequences are never averaged as they are (a hard sequence would drown the rest);
they are compared as ratios on the same sequence and averaged geometrically. Sequences are the
sample: the repeats of a cell give its median, and are no further evidence about other sequences.
Sequences may have weights, so that a mean over categories does not depend on how many sequences
each category has; with equal weights all formulas are Student's.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]
Cells = Mapping[str, Mapping[str, Sequence[float]]]
"""Tracker to sequence to the errors of its runs there, in metres."""
Verdict = Literal["better", "worse", "cannot tell", "reference", ""]
"""How a tracker stands to the reference; empty for one that is not ranked."""

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


@dataclass(frozen=True)
class Standing:
    """Where a tracker stands.

    Attributes:
        key: The tracker.
        ratio: Geometric mean over sequences of its median error over the reference's; with a 95 %
            interval from `FEWEST` sequences on.
        rank: Rank by that ratio among the ranked trackers, 1 is best; None for an unranked one.
        group: First and last rank that the data leave open; None for an unranked tracker.
        mean_rank: Mean over sequences of its rank there; None for an unranked one.
        wins: Sequences on which its median error is smaller than the reference's.
        verdict: Whether it is better than the reference.
        p_value: Two-sided paired t test of the log errors against the reference's, Holm-corrected
            over the ranked trackers; None where there is no verdict.
        sequences: Sequences it was run on.
    """

    key: str
    ratio: Interval
    rank: int | None
    group: tuple[int, int] | None
    mean_rank: float | None
    wins: int
    verdict: Verdict
    p_value: float | None
    sequences: int


def standings(
    cells: Cells,
    reference: Mapping[str, Sequence[float]],
    ranked: Sequence[str],
    weights: Mapping[str, float] | None = None,
) -> list[Standing]:
    """Compare trackers over sequences.

    Args:
        cells: Errors of the trackers; a tracker may lack sequences if it is not ranked.
        reference: The reference's errors on every sequence.
        ranked: Trackers that take part in the ranking; each needs a value on every sequence.
        weights: Weight of each sequence; all the same where there are none.

    Returns:
        The ranked trackers from the best to the worst, then the others by their ratio.
    """
    # logarithms of the median errors [S] of the reference and of every tracker
    names = list(reference)
    base = log_medians(reference, names)
    share = np.array([1.0 if weights is None else weights[name] for name in names])
    logs = {key: log_medians(cell, names) for key, cell in cells.items()}
    ranked_logs = {key: logs[key] for key in ranked}

    # ranks by the mean; equal up to rounding, they share the better one
    means = [round(float(np.average(log, weights=share)), 12) for log in ranked_logs.values()]
    ranks_of_means = scipy.stats.rankdata(means, method="min").astype(int)
    ranks = dict(zip(ranked, ranks_of_means.tolist(), strict=True))

    # mean over sequences of the ranks [K, S] there
    errors = np.reshape([*ranked_logs.values()], (len(ranked), len(names)))
    ranks_by_sequence = scipy.stats.rankdata(errors, axis=0)
    mean_ranks = dict(zip(ranked, ranks_by_sequence.mean(axis=1).tolist(), strict=True))

    # verdicts against the reference, and ranks that the data leave open
    verdicts = verdicts_against(ranked_logs, base, share)
    groups = rank_groups(ranked_logs, share)
    unordered = [
        Standing(
            key=key,
            ratio=ratio_interval(log - base, share),
            rank=ranks.get(key),
            group=groups.get(key),
            mean_rank=mean_ranks.get(key),
            wins=int((log < base).sum()),
            verdict=verdicts.get(key, ("", None))[0],
            p_value=verdicts.get(key, ("", None))[1],
            sequences=int(np.isfinite(log).sum()),
        )
        for key, log in logs.items()
    ]
    return sorted(unordered, key=lambda s: (s.rank is None, s.rank or 0, s.ratio.value))


def ratio_interval(log_ratios: Array, weights: Array | None = None) -> Interval:
    """Geometric mean of ratios, with a 95 % interval where there are `FEWEST` or more; nan values are left out.

    Args:
        log_ratios: Their logarithms ``[S]``.
        weights: Their weights ``[S]``; all the same where there are none.
    """
    finite = np.isfinite(log_ratios)
    values = log_ratios[finite]
    share = np.ones(finite.sum()) if weights is None else weights[finite]
    if len(values) < FEWEST:
        few = float(np.exp(np.average(values, weights=share))) if len(values) else math.nan
        return Interval(few, math.nan, math.nan)
    mean, error, freedom = _weighted_mean(values, share)
    half = float(scipy.special.stdtrit(freedom, 0.975) * error)
    return Interval(float(np.exp(mean)), float(np.exp(mean - half)), float(np.exp(mean + half)))


def _weighted_mean(values: Array, weights: Array) -> tuple[Array, Array, float]:
    """Weighted mean of ``[..., S]``, its standard error, and the degrees of freedom (of Kish's effective sample)."""
    share = weights / weights.sum()
    effective = 1.0 / float((share**2).sum())
    mean = values @ share
    spread = ((share * (values - mean[..., None])) ** 2).sum(axis=-1)
    return mean, np.sqrt(spread * effective / (effective - 1.0)), effective - 1.0


def p_values(differences: Array, weights: Array) -> Array:
    """Two-sided one-sample t tests of log ratios ``[K, S]`` against 0; below `FEWEST` sequences all are 1."""
    if not len(differences) or differences.shape[1] < FEWEST:
        return np.ones(len(differences))
    means, errors, freedom = _weighted_mean(differences, weights)
    # the same ratio on every sequence: certain, without a spread to divide by
    constant = np.ptp(differences, axis=1) == 0
    with np.errstate(divide="ignore", invalid="ignore"):
        p = 2.0 * scipy.stats.t.sf(np.abs(means / errors), freedom)
    return np.where(constant, np.where(differences[:, 0] == 0, 1.0, 0.0), p)


def verdicts_against(
    logs: Mapping[str, Array], base: Array, weights: Array
) -> dict[str, tuple[Verdict, float | None]]:
    """Whether each tracker is better than the reference, Holm-corrected over the trackers.

    All claims of a board are right together with a chance of at least 95 % (a family-wise error of
    `FAMILY_ERROR`).

    Args:
        logs: Tracker to the logarithms of its median errors ``[S]``.
        base: Those of the reference.
        weights: Weights ``[S]`` of the sequences.

    Returns:
        Verdict and corrected p value of every tracker.
    """
    verdicts: dict[str, tuple[Verdict, float | None]] = dict.fromkeys(logs, ("cannot tell", None))
    # all but the reference itself
    others = [key for key, log in logs.items() if not np.array_equal(log, base)]
    differences = np.reshape([logs[key] - base for key in others], (-1, len(base)))
    corrected = holm(p_values(differences, weights))
    for key, p in zip(others, corrected.tolist(), strict=True):
        if p > FAMILY_ERROR:
            verdicts[key] = ("cannot tell", p)
        elif np.average(logs[key] - base, weights=weights) < 0:
            verdicts[key] = ("better", p)
        else:
            verdicts[key] = ("worse", p)
    return verdicts


def separable(
    logs: Mapping[str, Array], weights: Array
) -> dict[tuple[str, str], tuple[bool, float]]:
    """Which trackers the sequences tell apart: paired t tests of the log errors, Holm-corrected over all pairs.

    The order of all pairs that are called separable is right together with a chance of at least 95
    %.

    Args:
        logs: Tracker to the logarithms of its median errors ``[S]``, in the same order of
            sequences, none missing.
        weights: Weights ``[S]`` of the sequences.

    Returns:
        For every pair ``(a, b)``, a before b in `logs`, whether they differ, and the corrected p
        value.
    """
    pairs = list(combinations(logs, 2))
    differences = np.reshape([logs[a] - logs[b] for a, b in pairs], (-1, len(weights)))
    corrected = holm(p_values(differences, weights)).tolist()
    return {pair: (p <= FAMILY_ERROR, p) for pair, p in zip(pairs, corrected, strict=True)}


def rank_groups(logs: Mapping[str, Array], weights: Array) -> dict[str, tuple[int, int]]:
    """First and last rank that the data leave open to every tracker; arguments as in `separable`.

    As many trackers as are shown to be better come before it, as many as are shown to be worse
    behind it.
    """
    better = dict.fromkeys(logs, 0)
    worse = dict.fromkeys(logs, 0)
    means = {key: np.average(log, weights=weights) for key, log in logs.items()}
    for (a, b), (apart, _) in separable(logs, weights).items():
        if apart:
            first, second = (a, b) if means[a] < means[b] else (b, a)
            worse[first] += 1
            better[second] += 1
    return {key: (1 + better[key], len(logs) - worse[key]) for key in logs}


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
    # the smallest of K times K, the next times K - 1, and so on; never below an earlier one
    order = np.argsort(p_values, kind="stable")
    steps = np.minimum(1.0, np.asarray(p_values)[order] * np.arange(len(order), 0, -1))
    return np.asarray(np.maximum.accumulate(steps)[np.argsort(order)])


def log_medians(cell: Mapping[str, Sequence[float]], names: Sequence[str]) -> Array:
    """Logarithms of the median errors ``[S]``; nan where there is no run."""
    medians = [float(np.median(cell[name])) if cell.get(name) else np.nan for name in names]
    return np.asarray(np.log(np.maximum(np.asarray(medians, dtype=np.float64), FLOOR_M)))
