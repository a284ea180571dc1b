"""Which configuration for whom: the fast, the balanced and the accurate one of a study's best trials.

All three are chosen by upper confidence bounds on blocks that no trial has seen; where no bound lies below that of the
default, which is 1, the default is the pick.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

PickName = Literal["fast", "balanced", "accurate"]
PICKS: tuple[PickName, ...] = get_args(PickName)


@dataclass(frozen=True)
class Bounds:
    """What may be said of a candidate: upper bounds of its ratios to the default.

    Attributes:
        trial: Its number.
        ate: Of the ATE.
        time: Of the processor time a frame.
        both: Of the geometric mean of the two.
    """

    trial: int
    ate: float
    time: float
    both: float


def pick(name: PickName, candidates: Sequence[Bounds], margin: float) -> Bounds | None:
    """A study's pick; None stands for the default.

    Args:
        name: ``fast``: the least processor time at (nearly) the default's accuracy; ``accurate``: the least ATE;
            ``balanced``: the least geometric mean of both, at (nearly) the default's accuracy.
        candidates: The trials to choose from, feasible ones.
        margin: What may be lost of accuracy, as a share.
    """
    equal = [each for each in candidates if each.ate < 1 + margin]
    chosen = {
        "fast": min(equal, key=lambda each: each.time, default=None),
        "balanced": min(equal, key=lambda each: each.both, default=None),
        "accurate": min(candidates, key=lambda each: each.ate, default=None),
    }[name]
    if chosen is None:
        return None
    bound = {"fast": chosen.time, "balanced": chosen.both, "accurate": chosen.ate}[name]
    return chosen if bound < 1 else None


def mean_ratios(ate: Mapping[str, float], time: Mapping[str, float]) -> list[float]:
    """By scene the mean of two log ratios, so that its exponential is the geometric mean of both."""
    return [(ate[scene] + time[scene]) / 2 for scene in ate]


def nothing_lost(bound: float | None, margin: float) -> bool:
    """Whether an upper bound of the ATE ratio shows that a configuration is not worse by more than a margin."""
    return bound is not None and math.isfinite(bound) and bound < 1 + margin
