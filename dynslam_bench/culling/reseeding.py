"""B12: extract more features than are used, so that culling leaves enough static ones (NGD-SLAM, Crowd-SLAM)."""

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import FilterResult, FilterState, FrameBundle, Need
from dynslam_bench.culling import BaseFilter
from dynslam_bench.culling.settings import ReseedingSettings
from dynslam_bench.features.fast import EDGE
from dynslam_bench.features.orb import level_quotas, spread
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.geometry import feature_scale

ORIGIN = EDGE - 3
"""Beginning of the extractor's cells, in pixels of a level."""


class ReseedingFilter(BaseFilter[ReseedingSettings]):
    """Uses the best `budget` of the features that earlier filters kept.

    The extractor finds more features than the budget (x1.5 in NGD-SLAM). The budget is divided
    among pyramid levels and image cells as in the extractor. A frame without dynamic objects thus
    gives exactly the features of an extractor with ``n_features = budget``, those of the other
    systems.

    It must be the last filter. The features that it drops are surplus, not dynamic.
    Stats: ``dropped`` (the surplus), ``static`` (kept by earlier filters), ``reseeded`` (used
    features that replace dynamic ones), ``missing`` (unused part of the budget).

    Args:
        settings: The budget.
        features: The extractor's settings: levels, scale and cells.
    """

    name = "reseeding"
    needs: frozenset[Need] = frozenset()
    stats_names = ("static", "reseeded", "missing", "dropped")

    def __init__(self, settings: ReseedingSettings, features: FeatureSettings) -> None:
        super().__init__(settings)
        self._features = features

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Choose the features that are used."""
        # what would be used of all features, and what is used of the static ones
        is_static = state.keep
        usual = self._choose(frame, np.ones(len(is_static), dtype=bool))
        used = self._choose(frame, is_static)
        # features that earlier filters dropped are not judged again
        return self.verdict(
            used | ~is_static,
            static=np.count_nonzero(is_static),
            reseeded=np.count_nonzero(used & ~usual),
            missing=max(self.settings.budget - int(np.count_nonzero(used)), 0),
        )

    def _choose(self, frame: FrameBundle, allowed: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """At most `budget` of the allowed features, bool ``[N]``, shared among levels and cells."""
        if np.count_nonzero(allowed) <= self.settings.budget:
            return allowed.copy()

        # from the coarsest level to the finest, each with its quota
        octave = frame.keypoints.octave
        scale = feature_scale(frame.gray.shape[1])
        chosen = np.zeros(len(allowed), dtype=bool)
        missing = 0
        levels = max(self._features.levels, int(octave.max()) + 1)
        quotas = level_quotas(self.settings.budget, levels, self._features.scale_factor)
        for level in range(levels - 1, -1, -1):
            rows = np.flatnonzero((octave == level) & allowed)
            quota = quotas[level] + missing

            # cell of each feature in its level
            at_level = frame.keypoints.xy[rows] / (scale * self._features.scale_factor**level)
            xy = np.rint(at_level - ORIGIN).clip(0)
            column, row = (xy / self._features.cell_px).astype(np.int64).T
            cells = row * (column.max(initial=0) + 1) + column

            # ranks of the responses, so that equal ones stay equal and keep their order
            _, rank = np.unique(frame.keypoints.response[rows], return_inverse=True)
            strength = rank.astype(np.int16)

            # the strongest of all cells
            everyone = np.ones(len(rows), dtype=bool)
            picked = rows[spread(cells, strength, everyone, quota)]
            # a coarse level's missing features are added to the next finer level
            missing = quota - len(picked)
            chosen[picked] = True
        return chosen
