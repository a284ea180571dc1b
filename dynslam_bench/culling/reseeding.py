"""B12: more features are sought than are used, so that culling leaves the static budget full (NGD-SLAM, Crowd-SLAM)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import DynamicFilter, FilterResult, FilterState, FrameBundle, Need, Provenance
from dynslam_bench.culling.settings import ReseedingSettings
from dynslam_bench.features.orb import EDGE, level_quotas, spread
from dynslam_bench.features.settings import FeatureSettings
from dynslam_bench.geometry.camera import Camera

ORIGIN = EDGE - 3
"""Where the extractor's cells begin, pixels of a level."""


class ReseedingFilter(DynamicFilter):
    """Of the features that earlier filters kept, uses the best `budget`: what fell to a mask is replaced elsewhere.

    The extractor seeks more features than the budget (x1.5 in NGD-SLAM). The budget is shared among the pyramid's
    levels and the cells of the image as the extractor shares its own, so that a frame without anything dynamic gives
    exactly the features that the extractor finds when asked for `budget` of them: other systems' features.

    It must be the last filter. What it leaves out is surplus, not dynamic: it has no part in a mask.
    Stats: ``dropped`` (the surplus), ``static`` (what earlier filters left), ``reseeded`` (used features that are
    there only because others fell), ``missing`` (by how much the budget is not filled).

    Args:
        settings: The budget.
        features: The extractor's settings: levels, scale and cells.
    """

    name = "reseeding"
    needs: frozenset[Need] = frozenset()
    provenance: Provenance = "inspired"
    stats_names = ("dropped", "static", "reseeded", "missing")

    def __init__(self, settings: ReseedingSettings, features: FeatureSettings) -> None:
        self.settings = settings
        self._features = features

    def reset(self, camera: Camera) -> None:
        """Nothing to forget."""

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Choose the features that are used."""
        static = state.keep
        used = self._choose(frame, static)
        usual = self._choose(frame, np.ones(len(frame), dtype=bool))
        stats = {
            "static": float(np.count_nonzero(static)),
            "reseeded": float(np.count_nonzero(used & ~usual)),
            "missing": float(max(self.settings.budget - int(np.count_nonzero(used)), 0)),
            "dropped": float(np.count_nonzero(static & ~used)),
        }
        keep = used | ~static  # only what was still in use is judged here
        return FilterResult(keep, keep.astype(np.float32), stats)

    def _choose(self, frame: FrameBundle, allowed: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """At most `budget` of the allowed features, bool ``[N]``, shared among levels and cells."""
        if np.count_nonzero(allowed) <= self.settings.budget:
            return allowed.copy()
        chosen = np.zeros(len(frame), dtype=bool)
        octave = frame.keypoints.octave
        levels = max(self._features.levels, int(octave.max()) + 1)
        quotas = level_quotas(self.settings.budget, levels, self._features.scale_factor)
        missing = 0
        for level in range(levels - 1, -1, -1):
            rows = np.flatnonzero((octave == level) & allowed)
            quota = quotas[level] + missing
            picked = rows[self._spread(frame, rows, level, quota)]
            missing = quota - len(picked)  # what a coarse level cannot give is sought in the next finer one
            chosen[picked] = True
        return chosen

    def _spread(self, frame: FrameBundle, rows: NDArray[np.intp], level: int, quota: int) -> NDArray[np.int64]:
        """Indices into `rows`, the strongest of every cell first."""
        xy = np.rint(frame.keypoints.xy[rows] / self._features.scale_factor**level - ORIGIN).clip(0)
        cell = (xy / self._features.cell_px).astype(np.int64)
        # ranks of the responses, so that equal ones stay equal and keep their order
        strength = np.unique(frame.keypoints.response[rows], return_inverse=True)[1].astype(np.int16)
        home = cell[:, 1] * (1 << 20) + cell[:, 0]
        return spread(home, strength, np.ones(len(rows), dtype=bool), quota)
