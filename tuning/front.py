"""Which configuration for whom: the fast, the balanced and the accurate one of a study's best trials.

All three are chosen by upper confidence bounds on blocks that no trial has seen; where no bound lies below that of the
default, which is 1, the default is the pick.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, get_args

from .ratio import Ratio
from .summary import Candidate

PickName = Literal["fast", "balanced", "accurate"]
PICKS: tuple[PickName, ...] = get_args(PickName)


def pick(name: PickName, candidates: Sequence[Candidate], margin: float) -> Candidate | None:
    """A study's pick; None stands for the default.

    Args:
        name: ``fast``: the least processor time at (nearly) the default's accuracy; ``accurate``: the least ATE;
            ``balanced``: the least of the study's objectives together, at (nearly) the default's accuracy.
        candidates: The trials to choose from, feasible ones.
        margin: What may be lost of accuracy, as a share.
    """
    asked = 1 + margin if name != "accurate" else math.inf
    equal = [each for each in candidates if _bound(each.on_confirm["accuracy"]) < asked]
    best = min(equal, key=lambda each: _decides(name, each), default=None)
    return best if best is not None and _decides(name, best) < 1 else None


def _decides(name: PickName, candidate: Candidate) -> float:
    """The upper bound that a pick is chosen by."""
    if name == "balanced":
        return _bound(candidate.confirm)
    return _bound(candidate.on_confirm["speed" if name == "fast" else "accuracy"])


def _bound(ratio: Ratio | None) -> float:
    return math.inf if ratio is None or ratio.bound is None else ratio.bound
