"""What the outcomes of a configuration amount to: the objectives' values and the constraints."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np

from .blocks import Block
from .evaluate import Outcome
from .statistics import by_scene, centre
from .study_file import StudySpec

Outcomes = Mapping[Block, Outcome]


def errors(outcomes: Outcomes) -> dict[Block, float]:
    """ATE in metres on each block."""
    return {block: outcome.ate_m for block, outcome in outcomes.items()}


def coverage(outcomes: Outcomes) -> float:
    """Mean coverage."""
    return float(np.mean([outcome.coverage for outcome in outcomes.values()]))


def fps(outcomes: Outcomes) -> float:
    """Frames a second: the inverse of the mean frame time."""
    return 1.0 / float(np.mean([outcome.frame_s for outcome in outcomes.values()]))


def real_time_factor(outcomes: Outcomes) -> float:
    """Geometric mean of the real-time factors."""
    return float(np.exp(np.mean([math.log(outcome.rtf) for outcome in outcomes.values()])))


def objective_values(objectives: Iterable[str], outcomes: Outcomes, default: Outcomes) -> list[float]:
    """The objectives' values, in their order.

    Args:
        objectives: ``accuracy`` or ``speed``, see `StudySpec`.
        outcomes: Of a configuration, on some blocks.
        default: Of the default settings, at every place of those.
    """
    accuracy = centre(by_scene(errors(outcomes), errors(default)).values())
    return [accuracy if objective == "accuracy" else real_time_factor(outcomes) for objective in objectives]


def violations(spec: StudySpec, outcomes: Outcomes) -> dict[str, float]:
    """How far each constraint is violated, relatively; <= 0 is fulfilled."""
    found = {}
    if spec.min_coverage is not None:
        found["coverage"] = spec.min_coverage - coverage(outcomes)
    if spec.min_fps is not None:
        found["fps"] = (spec.min_fps - fps(outcomes)) / spec.min_fps
    return found
