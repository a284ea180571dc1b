"""Statistics of a leaderboard: ratios to a reference, groups of trackers that the data can separate, paired tests.

Errors of different sequences are never averaged as they are (a hard sequence would drown the rest); they are compared
as ratios to a reference on the same sequence and averaged geometrically. Sequences are the sample: the repeats of a
cell give its median, and are no further evidence about other sequences.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]
Cells = Mapping[str, Mapping[str, Sequence[float]]]
"""Tracker to sequence to the errors of its runs there, in metres."""

FLOOR_M = 1e-6
"""Errors below a micrometre count as one, so that their logarithm exists."""
FEWEST = 5
"""Sequences below which no interval is given and no two trackers are called different."""
FAMILY_ERROR = 0.04
"""Chance that any pair of trackers is put into a wrong order; below 5 % since errors are only about log-normal."""


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
        ratio: Geometric mean over sequences of its median error over the reference's; with Student's interval from
            `FEWEST` sequences on.
        rank: Rank by that ratio among the ranked trackers, 1 is best; None for an unranked one.
        group: First and last rank that the data leave open; None for an unranked tracker.
        mean_rank: Mean over sequences of its rank there; None for an unranked one.
        wins: Sequences on which its median error is smaller than the reference's.
        better: Probability that a run of it has a smaller error than a run of the reference.
        p_value: Two-sided Wilcoxon signed-rank test of its medians against the reference's over sequences,
            Holm-corrected over the ranked trackers; None for others, for the reference itself, and where so few
            sequences can never give 0.05.
        sequences: Sequences it was run on.
    """

    key: str
    ratio: Interval
    rank: int | None
    group: tuple[int, int] | None
    mean_rank: float | None
    wins: int
    better: float
    p_value: float | None
    sequences: int


def standings(cells: Cells, reference: Mapping[str, Sequence[float]], ranked: Sequence[str]) -> list[Standing]:
    """Compare trackers over sequences.

    Args:
        cells: Errors of the trackers; a tracker may lack sequences if it is not ranked.
        reference: The reference's errors on every sequence.
        ranked: Trackers that take part in the ranking; each needs a value on every sequence.

    Returns:
        The ranked trackers from the best to the worst, then the others by their ratio.
    """
    names = list(reference)
    base = _log_medians(reference, names)
    logs = {key: _log_medians(cell, names) for key, cell in cells.items()}
    p_values = {key: paired_p_value(logs[key], base) for key in ranked}
    tested = {key: p for key, p in p_values.items() if p is not None}
    shown = attainable_p(len(names), len(tested)) <= 0.05
    corrected = dict(zip(tested, holm([*tested.values()]).tolist(), strict=True)) if shown else {}
    ranked_logs = {key: logs[key] for key in ranked}
    means = [round(float(np.mean(log)), 12) for log in ranked_logs.values()]
    ranks = dict(zip(ranked, scipy.stats.rankdata(means, method="min").astype(int).tolist(), strict=True))
    by_sequence = scipy.stats.rankdata(np.reshape([*ranked_logs.values()], (-1, len(names))), axis=0)
    mean_ranks = dict(zip(ranked, by_sequence.mean(axis=1).tolist(), strict=True))
    groups = rank_groups(ranked_logs)
    unordered = [
        Standing(
            key=key,
            ratio=ratio_interval(log - base),
            rank=ranks.get(key),
            group=groups.get(key),
            mean_rank=mean_ranks.get(key),
            wins=int((log < base).sum()),
            better=_better(cells[key], reference),
            p_value=corrected.get(key),
            sequences=int(np.isfinite(log).sum()),
        )
        for key, log in logs.items()
    ]
    return sorted(unordered, key=lambda s: (s.rank is None, s.rank or 0, s.ratio.value))


def ratio_interval(log_ratios: Array) -> Interval:
    """Geometric mean of ratios, with Student's 95 % interval where there are `FEWEST` or more; nan values are left out.

    Args:
        log_ratios: Their logarithms ``[S]``.
    """
    values = log_ratios[np.isfinite(log_ratios)]
    if not len(values):
        return Interval(np.nan, np.nan, np.nan)
    mean = float(values.mean())
    if len(values) < FEWEST:
        return Interval(float(np.exp(mean)), np.nan, np.nan)
    half = float(scipy.stats.t.ppf(0.975, len(values) - 1) * scipy.stats.sem(values))
    return Interval(float(np.exp(mean)), float(np.exp(mean - half)), float(np.exp(mean + half)))


def separable(logs: Mapping[str, Array]) -> dict[tuple[str, str], bool]:
    """Which trackers the sequences tell apart: paired t tests of the log errors, Holm-corrected over all pairs.

    The order of all pairs that are called separable is right together with a chance of at least 95 % (a family-wise
    error of `FAMILY_ERROR`). Below `FEWEST` sequences nothing is separable.

    Args:
        logs: Tracker to the logarithms of its median errors ``[S]``, in the same order of sequences, none missing.

    Returns:
        For every pair ``(a, b)``, a before b in `logs`, whether they differ.
    """
    pairs = list(combinations(logs, 2))
    if not pairs:
        return {}
    differences = np.stack([logs[a] - logs[b] for a, b in pairs])
    p_values = np.ones(len(pairs))
    if differences.shape[1] >= FEWEST:
        varied = np.ptp(differences, axis=1) > 0
        p_values[varied] = scipy.stats.ttest_1samp(differences[varied], 0.0, axis=1).pvalue
        p_values[~varied & (differences[:, 0] != 0)] = 0.0  # the same ratio on every sequence
    return dict(zip(pairs, (holm(p_values) <= FAMILY_ERROR).tolist(), strict=True))


def rank_groups(logs: Mapping[str, Array]) -> dict[str, tuple[int, int]]:
    """First and last rank that the data leave open to every tracker.

    Args:
        logs: As in `separable`.
    """
    better, worse = dict.fromkeys(logs, 0), dict.fromkeys(logs, 0)
    for (a, b), apart in separable(logs).items():
        if apart:
            first, second = (a, b) if logs[a].mean() < logs[b].mean() else (b, a)
            worse[first] += 1
            better[second] += 1
    return {key: (1 + better[key], len(logs) - worse[key]) for key in logs}


def paired_p_value(log_a: Array, log_b: Array) -> float | None:
    """Two-sided Wilcoxon signed-rank test of paired logarithms; None for no pair that differs."""
    difference = (log_a - log_b)[log_a != log_b]
    return float(scipy.stats.wilcoxon(difference).pvalue) if len(difference) else None


def attainable_p(sequences: int, tests: int = 1) -> float:
    """The smallest Holm-corrected p that a signed-rank test can give."""
    return min(1.0, max(tests, 1) * 2.0 / 2.0**sequences)


def holm(p_values: Sequence[float] | Array) -> Array:
    """Holm's step-down correction of several p values ``[K]``."""
    order = np.argsort(p_values, kind="stable")
    steps = np.minimum(1.0, np.asarray(p_values)[order] * np.arange(len(order), 0, -1))
    return np.asarray(np.maximum.accumulate(steps)[np.argsort(order)])


def power_note(standings: Sequence[Standing], sequences: int, fewest_repeats: int) -> str:
    """One paragraph on what a sample of this size can show.

    Args:
        standings: The ranked ones count.
        sequences: Sequences that they are ranked on.
        fewest_repeats: Repeats that count in the smallest of their cells, 0 if there is none.
    """
    if not sequences:
        return "No sequence has ground truth, so nothing can be compared."
    groups = [s.group for s in standings if s.group is not None]
    count = f"{sequences} sequence{'s' if sequences != 1 else ''}"
    pairs = len(groups) * (len(groups) - 1) // 2
    apart = sum(len(groups) - (last - first + 1) for first, last in groups) // 2
    smallest_p = attainable_p(sequences, len(groups))
    sentences = {
        f"With {count} no two trackers are called different (below {FEWEST} there are no intervals): read the order "
        "as a description of these sequences, not as evidence about others.": sequences < FEWEST,
        f"{count}, {len(groups)} ranked trackers: {apart} of {pairs} pairs can be told apart (paired t tests of "
        "the log errors over sequences, Holm).": sequences >= FEWEST and pairs,
        f"The smallest p that a signed-rank test can reach is {smallest_p:.3g}, so none is shown.": smallest_p > 0.05,
        f"Some cells hold only {fewest_repeats} run{'s' if fewest_repeats != 1 else ''} that count: the spread "
        "from run to run is unknown there.": 0 < fewest_repeats < 3,
    }
    shown = [sentence for sentence, holds in sentences.items() if holds]
    return " ".join(shown) or f"{count}, {len(groups)} ranked trackers, at least {fewest_repeats} runs a cell."


def _log_medians(cell: Mapping[str, Sequence[float]], names: Sequence[str]) -> Array:
    """Logarithms of the median errors ``[S]``; nan where there is no run."""
    medians = [float(np.median(cell[name])) if cell.get(name) else np.nan for name in names]
    return np.asarray(np.log(np.maximum(np.asarray(medians, dtype=np.float64), FLOOR_M)))


def _better(cell: Mapping[str, Sequence[float]], reference: Mapping[str, Sequence[float]]) -> float:
    shares = []
    for name, others in reference.items():
        a, b = np.asarray(cell.get(name, ())), np.asarray(others)
        if len(a) and len(b):
            shares.append(float((a[:, None] < b).mean() + 0.5 * (a[:, None] == b).mean()))
    return float(np.mean(shares)) if shares else np.nan
