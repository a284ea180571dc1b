"""A ratio to the default settings, with its interval."""

from __future__ import annotations

import math
from typing import Any

from dynslam_bench.core.records import Record

from .objectives import ACCURACY, Objective, Outcomes
from .statistics import FEWEST_SCENES, bounds, centre, upper

_LARGEST_LOG = 700.0
"""Larger logarithms overflow."""
FALSE_CHOICES = 0.05
"""At most this share of the studies in which nothing is better may choose something."""


class Ratio(Record):
    """A ratio to the default settings, of the ATE or whatever a study is after, with its 95 % interval.

    Attributes:
        ratio: Geometric mean over the scenes, trimmed from ten on; below 1 is better than the default.
        low: Lower end of the interval over scenes (`statistics.bounds`); below three scenes over starts, which tells
            nothing of other scenes. None for a single run. Summaries of older versions hold a bootstrap interval, which
            was too narrow.
        high: Upper end.
        n: Paired runs.
        sequences: How many scenes they come from.
        bound: One-sided upper bound, wide enough for the number of candidates compared; None for a single run.
        what: What the ratio is one of.
    """

    ratio: float
    low: float | None
    high: float | None
    n: int
    sequences: int
    bound: float | None = None
    what: str = "ATE"

    @property
    def shows_gain(self) -> bool:
        """Whether the whole interval lies below 1, over enough scenes for an interval."""
        return self.high is not None and self.high < 1 and self.sequences >= FEWEST_SCENES

    @property
    def shows_loss(self) -> bool:
        """Whether the whole interval lies above 1, over enough scenes for an interval."""
        return self.low is not None and self.low > 1 and self.sequences >= FEWEST_SCENES

    @property
    def verdict(self) -> str:
        """What may be concluded."""
        if self.sequences < FEWEST_SCENES:
            return f"on {self.sequences} scene{'s' * (self.sequences > 1)} only, from which nothing follows for others"
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
        return f"{self.what} x {self.ratio:.3f} {self.interval or 'without an interval'}"


def compared(outcomes: Outcomes, default: Outcomes, *, objective: Objective = ACCURACY, candidates: int = 1) -> Ratio:
    """A configuration beside the default on the same blocks.

    Args:
        outcomes: Of the configuration.
        default: Of the default settings.
        objective: What is compared.
        candidates: How many configurations are compared for one choice; the bound allows for all of them (Bonferroni).
    """
    scenes = objective.ratios(outcomes, default)
    sample = list(scenes.values()) if len(scenes) >= FEWEST_SCENES else objective.by_start(outcomes, default)
    sample = objective.counted(sample)
    found, middle = bounds(sample), centre(sample)
    about: dict[str, Any] = {"n": len(outcomes), "sequences": len(scenes), "what": objective.what}
    if found is None:
        return Ratio(ratio=_ratio(middle), low=None, high=None, **about)
    bound = _ratio(upper(sample, 1 - FALSE_CHOICES / candidates))
    return Ratio(ratio=_ratio(middle), low=_ratio(found[0]), high=_ratio(found[1]), bound=bound, **about)


def _ratio(logarithm: float) -> float:
    return math.exp(min(logarithm, _LARGEST_LOG))
