"""What a configuration must fulfil, whatever it gains."""

from __future__ import annotations

import numpy as np

from .objectives import Outcomes
from .study_file import StudySpec


def coverage(outcomes: Outcomes) -> float:
    """Mean coverage."""
    return float(np.mean([outcome.coverage for outcome in outcomes.values()]))


def fps(outcomes: Outcomes) -> float:
    """Frames a second: the inverse of the mean frame time."""
    return 1.0 / float(np.mean([outcome.frame_s for outcome in outcomes.values()]))


def violations(spec: StudySpec, outcomes: Outcomes) -> dict[str, float]:
    """How far each constraint is violated, relatively; <= 0 is fulfilled."""
    found = {}
    if spec.min_coverage is not None:
        found["coverage"] = spec.min_coverage - coverage(outcomes)
    if spec.min_fps is not None:
        found["fps"] = (spec.min_fps - fps(outcomes)) / spec.min_fps
    return found
