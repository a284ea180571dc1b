"""Dynamic feature filters: published rejection rules.

The building blocks are numbered as in `docs/explanation/baselines.md` (B1 to B15). All filters
receive the same keypoints and share the starvation guard (`guard`).
"""

from typing import Any, Generic, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import DynamicFilter, FilterResult
from dynslam_bench.core.settings import Settings
from dynslam_bench.geometry import Camera
from dynslam_bench.segmentation.settings import SegmentationSettings

S = TypeVar("S", bound=Settings)
Number: TypeAlias = "float | np.number[Any] | np.bool_"
"""A value of a filter's stats."""


class BaseFilter(DynamicFilter, Generic[S]):
    """A filter with settings and stats; one that keeps something between frames forgets it in its `reset`.

    Args:
        settings: Its thresholds.
    """

    def __init__(self, settings: S) -> None:
        self.settings = settings
        self.reset()

    def reset(self, camera: Camera | None = None) -> None:
        """A filter without memory has nothing to reset."""

    def verdict(
        self, keep: NDArray[np.bool_], mask: NDArray[np.bool_] | None = None, /, **stats: Number
    ) -> FilterResult:
        """A verdict of weights 1 and 0 with every stat of `stats_names`: 0 where it is not given."""
        stats["dropped"] = np.count_nonzero(~keep)
        counts = {name: float(stats.get(name, 0.0)) for name in self.stats_names}
        return FilterResult(keep, keep.astype(np.float32), counts, mask)


class ObjectFilter(BaseFilter[S]):
    """A filter that uses segmented objects.

    Args:
        settings: Its thresholds.
        segmentation: Which objects count as dynamic.
    """

    def __init__(self, settings: S, segmentation: SegmentationSettings) -> None:
        super().__init__(settings)
        self.segmentation = segmentation
