"""Quality of masks: overlap with the true moving (or labelled) pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core import EvaluationError


@dataclass(frozen=True)
class MaskCounts:
    """Pixel counts of one or, added up, of many masks.

    Attributes:
        true_positive: Pixels in both masks.
        false_positive: Pixels in the predicted mask only.
        false_negative: Pixels in the true mask only.
        true_negative: Pixels in neither.
    """

    true_positive: int = 0
    false_positive: int = 0
    false_negative: int = 0
    true_negative: int = 0

    def __add__(self, other: MaskCounts) -> MaskCounts:
        return MaskCounts(
            self.true_positive + other.true_positive,
            self.false_positive + other.false_positive,
            self.false_negative + other.false_negative,
            self.true_negative + other.true_negative,
        )

    @property
    def iou(self) -> float | None:
        """Intersection over union; None where both masks are empty (nothing to find, nothing found)."""
        return _ratio(
            self.true_positive, self.true_positive + self.false_positive + self.false_negative
        )

    @property
    def precision(self) -> float | None:
        """Share of the predicted pixels that are true; None where nothing was predicted."""
        return _ratio(self.true_positive, self.true_positive + self.false_positive)

    @property
    def recall(self) -> float | None:
        """Share of the true pixels that were predicted; None where there are none."""
        return _ratio(self.true_positive, self.true_positive + self.false_negative)


def compare_masks(predicted: NDArray[np.bool_], truth: NDArray[np.bool_]) -> MaskCounts:
    """Count the pixels on which two masks ``[H, W]`` agree and differ; counts of frames can be added.

    Args:
        predicted: True where a pixel is held for dynamic.
        truth: True where it is.

    Raises:
        EvaluationError: The masks differ in shape.
    """
    p = np.asarray(predicted, dtype=bool)
    t = np.asarray(truth, dtype=bool)
    if p.shape != t.shape:
        raise EvaluationError(f"masks differ in shape: {p.shape} and {t.shape}")
    return MaskCounts(
        true_positive=int((p & t).sum()),
        false_positive=int((p & ~t).sum()),
        false_negative=int((~p & t).sum()),
        true_negative=int((~p & ~t).sum()),
    )


def _ratio(part: int, whole: int) -> float | None:
    """A share; None of nothing."""
    return part / whole if whole else None
