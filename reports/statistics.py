"""Statistics of a leaderboard: ratios to a reference with bootstrap intervals, ranks, paired tests, power.

Errors of different sequences are never averaged as they are (a hard sequence would drown the rest); they are compared
as ratios to a reference on the same sequence and averaged geometrically.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dynslam_bench.core.seeding import stream

Array = NDArray[np.float64]
Cells = Mapping[str, Mapping[str, Sequence[float]]]
"""Tracker to sequence to the errors of its runs there, in metres."""

FLOOR_M = 1e-6
"""Errors below a micrometre count as one, so that their logarithm exists."""
REPLICATES = 2000


@dataclass(frozen=True)
class Interval:
    """A value with its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Standing:
    """Where a tracker stands.

    Attributes:
        key: The tracker.
        ratio: Geometric mean over sequences of its median error over the reference's.
        rank: Rank by that ratio among the ranked trackers, 1 is best; None for an unranked one.
        mean_rank: Mean over sequences of its rank there; None for an unranked one.
        best_probability: Share of the bootstrap replicates in which it has rank 1.
        improvement: Probability that a run of it has a smaller error than a run of the reference.
        p_value: Two-sided Wilcoxon signed-rank test of its medians against the reference's over sequences,
            Holm-corrected over the ranked trackers; None for others and for the reference itself.
        sequences: Sequences it was run on.
    """

    key: str
    ratio: Interval
    rank: Interval | None
    mean_rank: float | None
    best_probability: float | None
    improvement: Interval
    p_value: float | None
    sequences: int


def standings(
    cells: Cells, reference: Mapping[str, Sequence[float]], ranked: Sequence[str], *, seed: int = 0
) -> list[Standing]:
    """Compare trackers over sequences.

    The bootstrap draws sequences with replacement (the same for all trackers, as they are paired) and within each
    sequence the runs of each tracker.

    Args:
        cells: Errors of the trackers; a tracker may lack sequences if it is not ranked.
        reference: The reference's errors on every sequence.
        ranked: Trackers that take part in the ranking; each needs a value on every sequence.
        seed: Seed of the bootstrap.

    Returns:
        The ranked trackers from the best to the worst, then the others by their ratio.
    """
    sequences = list(reference)
    rng = stream(seed, "report bootstrap")
    picks = rng.integers(0, len(sequences), (REPLICATES, len(sequences)))
    reference_log, reference_draws = _medians(reference, sequences, rng)
    ratios: dict[str, tuple[float, Array]] = {}
    improvements: dict[str, Interval] = {}
    p_values: dict[str, float | None] = {}
    medians: dict[str, Array] = {}
    for key, cell in cells.items():
        if all(list(cell.get(name, ())) == list(reference[name]) for name in sequences):
            point, draws = reference_log, reference_draws  # the reference itself: a ratio of exactly 1
        else:
            point, draws = _medians(cell, sequences, rng)
        medians[key] = np.exp(point)
        difference = draws - reference_draws
        chosen = difference[picks, np.arange(REPLICATES)[:, None]]
        ratios[key] = (float(np.nanmean(point - reference_log)), _nanmean(chosen))
        improvements[key] = _improvement(cell, reference, sequences, picks)
        p_values[key] = paired_p_value(point, reference_log)
    corrected = holm({key: p for key in ranked if (p := p_values[key]) is not None})
    ranks, best, mean_ranks = _ranks({key: ratios[key] for key in ranked}, {key: medians[key] for key in ranked})
    found = [
        Standing(
            key=key,
            ratio=Interval(float(np.exp(point)), *np.exp(_percentiles(draws)).tolist()),
            rank=ranks.get(key),
            mean_rank=mean_ranks.get(key),
            best_probability=best.get(key),
            improvement=improvements[key],
            p_value=corrected.get(key),
            sequences=sum(1 for name in sequences if cells[key].get(name)),
        )
        for key, (point, draws) in ratios.items()
    ]
    return sorted(found, key=lambda s: (s.rank is None, s.rank.value if s.rank else 0.0, s.ratio.value))


def paired_p_value(log_a: Array, log_b: Array) -> float | None:
    """Two-sided Wilcoxon signed-rank test of paired logarithms; None for no pair that differs."""
    difference = (log_a - log_b)[np.isfinite(log_a) & np.isfinite(log_b)]
    difference = difference[difference != 0]
    if not len(difference):
        return None
    return float(stats.wilcoxon(difference).pvalue)


def holm(p_values: Mapping[str, float]) -> dict[str, float]:
    """Holm's step-down correction for several comparisons."""
    corrected: dict[str, float] = {}
    running = 0.0
    for position, (key, p) in enumerate(sorted(p_values.items(), key=lambda item: item[1])):
        running = max(running, min(1.0, p * (len(p_values) - position)))
        corrected[key] = running
    return corrected


def critical_difference(trackers: int, sequences: int, alpha: float = 0.05) -> float:
    """Nemenyi's critical difference of mean ranks."""
    q = float(stats.studentized_range.ppf(1 - alpha, trackers, np.inf)) / np.sqrt(2)
    return float(q * np.sqrt(trackers * (trackers + 1) / (6 * sequences)))


def power_note(trackers: int, sequences: int, fewest_runs: int) -> str:
    """One paragraph on what a sample of this size can show."""
    if not sequences:
        return "No sequence has ground truth, so nothing can be compared."
    parts = []
    smallest = 2.0 / 2**sequences
    count = f"{sequences} sequence{'s' if sequences != 1 else ''}"
    if smallest > 0.05:
        parts.append(
            f"With {count} a paired signed-rank test can never reach p < 0.05 (the smallest possible p is "
            f"{smallest:.3g}): read the order as a description of these sequences, not as evidence about others."
        )
    if trackers >= 2 and sequences >= 2:
        need = critical_difference(trackers, sequences)
        most = trackers - 1
        verdict = " (more than can occur)" if need > most else ""
        parts.append(
            f"With {count} and {trackers} ranked trackers, mean ranks must differ by {need:.2f}{verdict} to count as "
            "different (Nemenyi, 5 %)."
        )
    if fewest_runs < 3:
        parts.append(
            f"Some cells hold only {fewest_runs} run{'s' if fewest_runs != 1 else ''}: the spread from run to run is "
            "unknown there and the intervals are too narrow."
        )
    return " ".join(parts) or f"{count}, {trackers} ranked trackers, at least {fewest_runs} runs a cell."


def _medians(
    cell: Mapping[str, Sequence[float]], sequences: Sequence[str], rng: np.random.Generator
) -> tuple[Array, Array]:
    """Logarithms of the median errors ``[S]`` and of bootstrapped medians ``[S, B]``; nan where there is no run."""
    point = np.full(len(sequences), np.nan)
    draws = np.full((len(sequences), REPLICATES), np.nan)
    for i, name in enumerate(sequences):
        values = np.maximum(np.asarray(cell.get(name, ()), dtype=np.float64), FLOOR_M)
        if not len(values):
            continue
        point[i] = np.log(np.median(values))
        drawn = values[rng.integers(0, len(values), (REPLICATES, len(values)))]
        draws[i] = np.log(np.median(drawn, axis=1))
    return point, draws


def _nanmean(values: Array) -> Array:
    """Mean over sequences ``[B]`` of ``[B, S]``, leaving out missing ones; replicates with none are dropped."""
    count = np.isfinite(values).sum(axis=1)
    total = np.nansum(values, axis=1)
    return np.asarray(total[count > 0] / count[count > 0])


def _percentiles(draws: Array) -> Array:
    return np.percentile(draws, [2.5, 97.5]) if len(draws) else np.array([np.nan, np.nan])


def _improvement(
    cell: Mapping[str, Sequence[float]],
    reference: Mapping[str, Sequence[float]],
    sequences: Sequence[str],
    picks: NDArray[np.int64],
) -> Interval:
    share = np.full(len(sequences), np.nan)
    for i, name in enumerate(sequences):
        a, b = np.asarray(cell.get(name, ())), np.asarray(reference[name])
        if len(a) and len(b):
            share[i] = (a[:, None] < b).mean() + 0.5 * (a[:, None] == b).mean()
    return Interval(float(np.nanmean(share)), *_percentiles(_nanmean(share[picks])).tolist())


def _ranks(
    ratios: Mapping[str, tuple[float, Array]], medians: Mapping[str, Array]
) -> tuple[dict[str, Interval], dict[str, float], dict[str, float]]:
    if not ratios:
        return {}, {}, {}
    keys = list(ratios)
    point = stats.rankdata([ratios[key][0] for key in keys], method="min")
    draws = stats.rankdata(np.stack([ratios[key][1] for key in keys]), method="min", axis=0)
    per_sequence = stats.rankdata(np.stack([medians[key] for key in keys]), method="average", axis=0)
    ranks, best, mean_ranks = {}, {}, {}
    for i, key in enumerate(keys):
        low, high = np.percentile(draws[i], [2.5, 97.5], method="nearest").tolist()
        ranks[key] = Interval(float(point[i]), low, high)
        best[key] = float((draws[i] == 1).mean())
        mean_ranks[key] = float(per_sequence[i].mean())
    return ranks, best, mean_ranks
