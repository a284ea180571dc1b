"""B8: the probability that a feature moves, accumulated over frames (RDS-SLAM, Detect-SLAM)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dynslam_bench.contracts.filter import FilterResult, FilterState, FrameBundle, Need, Provenance
from dynslam_bench.culling import ObjectRule
from dynslam_bench.culling.matches import link_to_previous
from dynslam_bench.culling.semantic import dynamic_boxes, in_boxes
from dynslam_bench.culling.settings import ProbabilitySettings
from dynslam_bench.geometry.camera import Camera, inside
from dynslam_bench.segmentation.postprocess import dynamic_mask
from dynslam_bench.segmentation.settings import SegmentationSettings

UNKNOWN = 0.5
CERTAIN = (0.25, 0.75)
"""Below the first a feature is certainly static, above the second certainly dynamic (Detect-SLAM)."""
HIT = 0.9
"""Probability that a moving point lies on a mask, and a static one off it (Bayes rule; our assumption)."""
RATE = 0.3
"""Weight of the new observation (moving average; our assumption)."""


class ProbabilityFilter(ObjectRule[ProbabilitySettings]):
    """Drops features whose moving probability exceeds the threshold; the probability follows the flow.

    Args:
        settings: Accumulation rule and threshold.
        segmentation: Which objects count as dynamic.
        evidence: Whether lying on a mask or in a box counts.

    Stats: ``dropped``, ``linked``, ``mean_probability``.
    """

    name = "probability"
    needs: frozenset[Need] = frozenset({"masks", "flow", "previous"})
    provenance: Provenance = "inspired"
    stats_names = ("dropped", "linked", "mean_probability")

    def __init__(
        self, settings: ProbabilitySettings, segmentation: SegmentationSettings, evidence: str = "masks"
    ) -> None:
        super().__init__(settings, segmentation)
        self._boxes = evidence == "boxes"
        self._probability = np.zeros(0)

    def reset(self, camera: Camera) -> None:
        """Forget all probabilities."""
        self._probability = np.zeros(0)

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Update the probabilities by this frame's masks."""
        link = link_to_previous(frame, state, self.settings.link_px)
        if state.previous is None or len(self._probability) != len(state.previous):
            link[:] = -1
        prior = np.full(len(link), UNKNOWN)
        prior[link >= 0] = self._probability[link[link >= 0]]
        if self.settings.expand_px > 0:
            prior = expand(frame.keypoints.xy, prior, link >= 0, self.settings.expand_px)
        if frame.instances is not None:
            prior = self._update(prior, self._observe(frame))
        self._probability = prior
        mean = float(prior.mean()) if len(prior) else UNKNOWN
        verdict = FilterResult.of(
            prior <= self.settings.threshold,
            {"linked": float(np.count_nonzero(link >= 0)), "mean_probability": mean},
        )
        if self.settings.soft:
            return replace(verdict, weight=np.where(verdict.keep, 1 - prior, 0).astype(np.float32))
        return verdict

    def _observe(self, frame: FrameBundle) -> NDArray[np.bool_]:
        assert frame.instances is not None
        if self._boxes:
            return np.asarray(in_boxes(frame.keypoints.xy, dynamic_boxes(frame, self.segmentation)).any(axis=0))
        return inside(dynamic_mask(frame.instances, self.segmentation, frame.depth), frame.keypoints.xy)

    def _update(self, prior: NDArray[np.float64], on_mask: NDArray[np.bool_]) -> NDArray[np.float64]:
        if self.settings.rule == "average":
            return (1 - RATE) * prior + RATE * on_mask
        moving = np.where(on_mask, HIT, 1 - HIT)
        posterior = moving * prior / (moving * prior + (1 - moving) * (1 - prior))
        return np.asarray(posterior.clip(0.01, 0.99))


def expand(
    xy: NDArray[np.floating], probability: NDArray[np.float64], linked: NDArray[np.bool_], radius_px: float
) -> NDArray[np.float64]:
    """Matching point expansion: a new feature takes a share of the nearest certain feature's probability.

    Args:
        xy: Pixels of all features ``[N, 2]``.
        probability: Their moving probabilities ``[N]``.
        linked: bool ``[N]``, which of them have a history.
        radius_px: Largest distance to that feature; its influence is a Gaussian of half this width.

    Returns:
        Probabilities ``[N]``; those with a history unchanged.
    """
    expanded = probability.copy()
    certain = np.flatnonzero(linked & ((probability < CERTAIN[0]) | (probability > CERTAIN[1])))
    new = np.flatnonzero(~linked)
    if not len(certain) or not len(new):
        return expanded
    distance, nearest = cKDTree(xy[certain]).query(xy[new], distance_upper_bound=radius_px)
    near = np.isfinite(distance)
    influence = np.exp(-0.5 * np.square(np.asarray(distance)[near] / (0.5 * radius_px)))
    expanded[new[near]] = UNKNOWN + influence * (probability[certain[np.asarray(nearest)[near]]] - UNKNOWN)
    return expanded
