"""What a configuration must fulfil, whatever it gains."""

from __future__ import annotations

import math

import numpy as np

from .objectives import ACCURACY, Outcomes
from .study_file import StudySpec


def coverage(outcomes: Outcomes) -> float:
    """Mean coverage."""
    return float(np.mean([outcome.coverage for outcome in outcomes.values()]))


def fps(outcomes: Outcomes) -> float:
    """Frames a second: the inverse of the mean frame time."""
    return 1.0 / float(np.mean([outcome.frame_s for outcome in outcomes.values()]))


def violations(spec: StudySpec, outcomes: Outcomes, default: Outcomes | None = None) -> dict[str, float]:
    """How far each constraint is violated, relatively; <= 0 is fulfilled.

    Args:
        spec: The study. One of anything but error alone must not pay for its gain with accuracy: the ATE ratio has to
            stay below 1 + `StudySpec.ate_margin`; a front of several objectives holds the error itself.
        outcomes: Of a configuration.
        default: Of the default settings at the same places, for that ratio; None to leave it out.
    """
    found = {}
    if spec.min_coverage is not None:
        found["coverage"] = spec.min_coverage - coverage(outcomes)
    if spec.min_fps is not None:
        found["fps"] = (spec.min_fps - fps(outcomes)) / spec.min_fps
    if default is not None and spec.at_equal_accuracy and len(spec.objectives) == 1:
        found["ate"] = ACCURACY.value(outcomes, default) - math.log1p(spec.ate_margin)
    return found
