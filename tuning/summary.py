"""What came out of a study, and what may be concluded from it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import Field
from scipy import stats

from dynslam_bench.core.records import Record

from .objective import Instance, Outcome, log_ratio

FEWEST_SEQUENCES = 3
"""With fewer sequences an interval over sequences means nothing."""
_LARGEST_LOG = 700.0
"""Larger logarithms overflow."""


class Ratio(Record):
    """A geometric-mean ATE ratio to the default settings, with its 95 % interval.

    Attributes:
        ratio: Below 1 is better than the default.
        low: Lower end of Student's interval over sequences (of the logarithms, n - 1 degrees of freedom); None for one
            sequence. Summaries of older versions hold a bootstrap interval, which was too narrow.
        high: Upper end; None for one sequence.
        n: Paired runs.
        sequences: How many sequences they come from.
    """

    ratio: float
    low: float | None
    high: float | None
    n: int
    sequences: int

    @property
    def shows_gain(self) -> bool:
        """Whether the whole interval lies below 1, over enough sequences for an interval."""
        return self.high is not None and self.high < 1 and self.sequences >= FEWEST_SEQUENCES

    @property
    def shows_loss(self) -> bool:
        """Whether the whole interval lies above 1, over enough sequences for an interval."""
        return self.low is not None and self.low > 1 and self.sequences >= FEWEST_SEQUENCES

    @property
    def verdict(self) -> str:
        """What may be concluded."""
        if self.sequences < FEWEST_SEQUENCES:
            return (
                f"on {self.sequences} sequence{'s' * (self.sequences > 1)} only, from which nothing follows for others"
            )
        if self.shows_gain:
            return f"better than the default by {100 * (1 - self.ratio):.1f} %"
        if self.shows_loss:
            return f"worse than the default by {100 * (self.ratio - 1):.1f} %"
        return "no difference to the default that these runs could show"

    @property
    def interval(self) -> str:
        """The interval in brackets; empty without one."""
        return "" if self.low is None or self.high is None else f"[{self.low:.3f}, {self.high:.3f}]"

    def __str__(self) -> str:
        return f"ATE x {self.ratio:.3f} {self.interval or 'without an interval'}"


class Candidate(Record):
    """One of the best configurations, run again.

    Attributes:
        trial: Its number.
        params: The tuned settings.
        values: What its trial had been worth.
        tune: On the tune split in fresh repeats.
        held_out: On the held-out split; None without one.
        frame_ms: Mean milliseconds a frame, timed without the stage cache.
        default_frame_ms: The same of the default settings.
        feasible: Whether the constraints hold in the new runs.
        failed: Why it could not be run again; empty if it could.
    """

    trial: int
    params: dict[str, Any]
    values: list[float]
    tune: Ratio | None = None
    held_out: Ratio | None = None
    frame_ms: float | None = None
    default_frame_ms: float | None = None
    feasible: bool = True
    failed: str = ""


class StudySummary(Record):
    """What came out of a study; `summary.json` in its folder.

    Attributes:
        name: The study.
        tracker: The tracker.
        protocol: Description of the protocol.
        trials: Trials by state.
        candidates: The best configurations, run again; the chosen one first.
        chosen: Number of the trial whose settings became the preset.
        improves: Whether the chosen settings beat the default on the held-out split: the whole interval below 1, and
            the splits are apart.
        conclusion: One sentence, see `conclude`.
        importances: Shares of the parameters that matter more than chance, see `importance`.
        inert: Parameters that changed nothing, or never took part.
        held_out: The held-out sequences.
        tune: The tune sequences.
        repeats: What the fresh repeats were, in words.
        split_notes: How the splits are not apart, where the study accepts that; to be shown beside every number.
    """

    name: str
    tracker: str
    protocol: str
    trials: dict[str, int]
    candidates: list[Candidate]
    chosen: int
    improves: bool
    conclusion: str
    importances: dict[str, float] = Field(default_factory=dict)
    inert: list[str] = Field(default_factory=list)
    held_out: list[str] = Field(default_factory=list)
    tune: list[str] = Field(default_factory=list)
    repeats: str = ""
    split_notes: list[str] = Field(default_factory=list)

    @property
    def verdict(self) -> str:
        """One sentence: better or not on the held-out split, by how much, how sure, and whether to keep the default."""
        return conclude(self.candidates[0], self.split_notes)


def paired_ratio(
    outcomes: Mapping[Instance, Outcome], default: Mapping[Instance, Outcome], instances: Sequence[Instance]
) -> Ratio:
    """Geometric-mean ATE ratio over paired runs, with Student's 95 % interval over sequences.

    The sample are the sequences: the repeats of one give its mean logarithm, and are no further evidence about others.
    """
    by_sequence: dict[str, list[float]] = {}
    for instance in instances:
        ratio = log_ratio(outcomes[instance].ate_m, default[instance].ate_m)
        by_sequence.setdefault(instance.sequence, []).append(ratio)
    means = np.array([np.mean(values) for values in by_sequence.values()])
    centre, count = float(means.mean()), len(means)
    low = high = None
    if count > 1:
        half = float(stats.t.ppf(0.975, count - 1) * means.std(ddof=1) / math.sqrt(count))
        low, high = math.exp(centre - half), math.exp(min(centre + half, _LARGEST_LOG))
    return Ratio(ratio=math.exp(centre), low=low, high=high, n=len(instances), sequences=count)


def conclude(chosen: Candidate, split_notes: Sequence[str]) -> str:
    """One sentence: better or not on the held-out split, by how much, how sure, and whether to keep the default."""
    text = _conclude(chosen, bool(split_notes))
    return text + (f" THE SPLITS ARE NOT APART: {'; '.join(split_notes)}." if split_notes else "")


def _conclude(chosen: Candidate, overlapping: bool) -> str:
    if chosen.failed:
        return f"Keep the default: trial {chosen.trial} was best, but failed when run again: {chosen.failed}."
    if not chosen.feasible:
        return f"Keep the default: trial {chosen.trial} was best, but violates a constraint when run again."
    held, tune = chosen.held_out, chosen.tune
    if held is None or tune is None:
        return (
            f"Not judged, keep the default: no held-out split was given, and what trial {chosen.trial} reaches on the "
            f"sequences that it was chosen on ({tune}) says nothing about others."
        )
    on = f"on {held.sequences} held-out sequence{'s' * (held.sequences != 1)}"
    if held.sequences < FEWEST_SEQUENCES:
        return f"Not judged, keep the default: {held} {on} only, from which nothing follows for others (tune: {tune})."
    sure = "95 % interval over sequences" + (", rough below five" if held.sequences < 5 else "")
    if held.shows_gain and not overlapping:
        return (
            f"Better: trial {chosen.trial} has {100 * (1 - held.ratio):.1f} % less error {on} ({held}, {sure}; tune: "
            f"{tune}), so its settings may replace the default there."
        )
    if held.shows_loss:
        return (
            f"Worse, keep the default: {100 * (held.ratio - 1):.1f} % more error {on} ({held}, {sure}; tune: {tune})."
        )
    return f"Not better, keep the default: {held} {on} shows no gain ({sure}; tune: {tune})."
