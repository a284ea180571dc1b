"""The systems, their search spaces and the instances that they were measured on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from numbers import Integral, Real
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Value = int | float


class SlamHpoError(ValueError):
    """What was asked for is not in the benchmark."""


class Range(NamedTuple):
    """Values of a setting.

    Attributes:
        low: The least.
        high: The greatest.
        default: What the system ships with.
        log: Whether it is searched on a logarithmic scale.
    """

    low: Value
    high: Value
    default: Value
    log: bool = False

    @property
    def whole(self) -> bool:
        """Whether it takes whole numbers only."""
        return isinstance(self.default, int)

    def at(self, unit: float) -> Value:
        """The value at a place in the unit interval."""
        low = np.log(self.low) if self.log else self.low
        high = np.log(self.high) if self.log else self.high
        value = low + unit * (high - low)
        value = float(np.exp(value) if self.log else value)
        return round(value) if self.whole else float(f"{value:.4g}")

    def unit(self, values: ArrayLike) -> NDArray[np.float64]:
        """Places of values in the unit interval."""
        values = np.asarray(values, dtype=float)
        low = np.asarray(self.low, dtype=float)
        high = np.asarray(self.high, dtype=float)
        if self.log:
            values = np.log(values)
            low = np.log(low)
            high = np.log(high)
        return np.asarray((values - low) / (high - low))


_SHARED = {
    "features.n_features": Range(300, 3000, 1000, log=True),
    "features.fast_threshold": Range(8, 40, 20),
    "backend.tracking.map_radius_px": Range(1.5, 12.0, 4.0),
    "backend.keyframes.tracked_share": Range(0.4, 0.95, 0.75),
    "backend.bundle_adjustment.window": Range(2, 20, 8),
}
SPACES: Mapping[str, Mapping[str, Range]] = {
    "mask-rcnn": _SHARED
    | {
        "backend.tracking.radius_px": Range(5.0, 40.0, 15.0),
        "segmentation.confidence": Range(0.1, 0.9, 0.3),
        "segmentation.mask_threshold": Range(0.2, 0.8, 0.5),
        "segmentation.dilation_px": Range(0, 30, 15),
        "segmentation.compensate": Range(0, 10, 3),
    },
    "emfoa-oft?masks=none": _SHARED
    | {
        "flow.forward_backward_px": Range(0.25, 8.0, 1.5, log=True),
        "flow.budget": Range(24, 384, 64, log=True),
        "epipolar.threshold_px": Range(0.2, 5.0, 1.0, log=True),
        "motion.threshold_px": Range(0.5, 10.0, 2.5, log=True),
        "motion.threshold_sigma": Range(1.0, 12.0, 4.0, log=True),
    },
}
"""Search spaces by system: settings of dynslam-bench by dotted name."""

_FAMILIES = ("walking_xyz", "walking_halfsphere", "walking_rpy", "sitting_halfsphere")
SPLITS: Mapping[str, tuple[str, ...]] = {
    split: tuple(f"synthetic/{family}?scene={scene}" for family in _FAMILIES)
    for split, scene in {"tune": 130, "test": 140}.items()
}
"""Sequences to tune on, and those that tell what the tuning was worth."""
SEQUENCES = SPLITS["tune"] + SPLITS["test"]
STARTS = (0, 4)
"""Frames of the sequence that are left out at its beginning: repeats, which differ by noise."""
STRIDE = 2
"""Runs take every second frame."""
FRAMES = (20, 40, 60)
"""Fidelities: lengths of a run, every second frame. A run sees no later frame, so a shorter one is its beginning."""


def known(name: str, value: Any, choices: Iterable[Any]) -> Any:
    """The choice that a value is.

    Raises:
        SlamHpoError: It is none; the message names those that there are.
    """
    every = list(choices)
    if not isinstance(value, Real | str) or value not in every:
        there = f"0 to {every[-1]}" if isinstance(choices, range) else ", ".join(map(str, every))
        raise SlamHpoError(f"{name} {value!r} is not in the benchmark, which has {there}")
    return every[every.index(value)]


def whole(name: str, value: Any, least: int = 0) -> int:
    """The value as an int.

    Raises:
        SlamHpoError: It is no whole number, or below the least.
    """
    if not isinstance(value, Integral) or value < least:
        raise SlamHpoError(f"{name} {value!r} is no whole number >= {least}")
    return int(value)


def defaults(system: str) -> dict[str, Value]:
    """The configuration that the system ships with.

    Raises:
        SlamHpoError: There is no such system.
    """
    space = SPACES[known("system", system, SPACES)]
    return {name: setting.default for name, setting in space.items()}
