"""Comparing a configuration with the default: paired by place, robust to single runs, with intervals that cover."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from .blocks import Block

FLOOR_M = 1e-4
"""Errors below a tenth of a millimetre count as that: a ratio of two perfect runs is no news."""
FEWEST_SCENES = 3
"""With fewer scenes an interval over scenes means nothing."""
TRIMMED = 0.1
"""This share of the scenes is left out at either end (none below ten): one catastrophe decides nothing."""

Errors = Mapping[Block, float]
"""ATE in metres on each block, lost frames held."""


def place_of(block: Block) -> Block:
    """The block without its start and seed: all runs there are repeats of each other."""
    return replace(block, offset=0, seed=0)


def log_errors(errors: Errors) -> dict[Block, list[float]]:
    """Natural logarithms of the errors in metres, by place."""
    found: dict[Block, list[float]] = {}
    for block, error in errors.items():
        found.setdefault(place_of(block), []).append(math.log(max(error, FLOOR_M)))
    return found


def by_scene(errors: Errors, default: Errors) -> dict[str, float]:
    """Log ATE ratio of a configuration to the default in each scene.

    At each place the median over the configuration's starts is compared with the median over all of the default's, so
    that neither's luck with one start decides; a scene is the mean of its places.

    Args:
        errors: Of the configuration.
        default: Of the default settings, at every place of `errors`; more starts make it steadier.

    Returns:
        Natural logarithm by scene, below 0 is better than the default.
    """
    reference = log_errors(default)
    found: dict[str, list[float]] = {}
    for place, values in log_errors(errors).items():
        ratio = float(np.median(values) - np.median(reference[place]))
        found.setdefault(place.scene, []).append(ratio)
    return {scene: float(np.mean(values)) for scene, values in found.items()}


def by_start(errors: Errors, default: Errors) -> list[float]:
    """Log ATE ratio on each block that both ran: what one or two scenes can tell, of themselves alone."""
    return [
        math.log(max(error, FLOOR_M) / max(default[block], FLOOR_M))
        for block, error in errors.items()
        if block in default
    ]


def centre(values: Iterable[float]) -> float:
    """Trimmed mean; the mean of fewer than ten."""
    sample = np.sort(_array(values))
    cut = int(TRIMMED * len(sample))
    return float(sample[cut : len(sample) - cut].mean())


def bounds(values: Iterable[float], confidence: float = 0.95) -> tuple[float, float] | None:
    """Confidence interval of the centre: Student's, of the trimmed mean (Tukey and McLaughlin 1963) from ten on.

    Args:
        values: One a scene, taken as independent.
        confidence: Of both sides together; a one-sided bound of confidence c is the end of the interval of 2 c - 1.

    Returns:
        Lower and upper end; None for fewer than two values.
    """
    sample = np.sort(_array(values))
    count = len(sample)
    if count < 2:
        return None
    cut = int(TRIMMED * count)
    kept = count - 2 * cut
    winsorised = np.clip(sample, sample[cut], sample[count - 1 - cut])
    error = float(winsorised.std(ddof=1)) * math.sqrt(count) / kept
    half = float(stdtrit(kept - 1, 0.5 + confidence / 2)) * error
    middle = centre(sample)
    return middle - half, middle + half


def upper(values: Iterable[float], confidence: float) -> float:
    """One-sided upper confidence bound of the centre; infinite for fewer than two values."""
    found = bounds(values, 2 * confidence - 1)
    return math.inf if found is None else found[1]


def _array(values: Iterable[float]) -> NDArray[np.float64]:
    return np.array(list(values), dtype=np.float64)
