"""B8: the probability that a feature moves, accumulated over frames (RDS-SLAM, Detect-SLAM)."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dynslam_bench.contracts import FilterResult, FilterState, FrameBundle, Need
from dynslam_bench.culling import ObjectFilter
from dynslam_bench.culling.semantic import dynamic_boxes, in_boxes
from dynslam_bench.culling.settings import ProbabilitySettings
from dynslam_bench.geometry import Camera, at_width, inside
from dynslam_bench.segmentation.postprocess import dynamic_mask
from dynslam_bench.segmentation.settings import SegmentationSettings

UNKNOWN = 0.5
"""Probability of a new feature."""
CERTAIN = (0.25, 0.75)
"""Probabilities: below the first a feature is certainly static, above the second certainly dynamic (Detect-SLAM)."""
HIT = 0.9
"""Probability that a moving point lies on a mask, and a static one off it (Bayes rule; our assumption)."""
RATE = 0.3
"""Weight of the new observation (moving average; our assumption)."""


class ProbabilityFilter(ObjectFilter[ProbabilitySettings]):
    """Drops features whose moving probability exceeds the threshold; the probability follows the flow.

    Args:
        settings: Accumulation rule and threshold.
        segmentation: Which objects count as dynamic.
        evidence: Whether lying on a mask or in a box counts.

    Stats: ``dropped``, ``linked``, ``mean_probability``.
    """

    name = "probability"
    needs: frozenset[Need] = frozenset({"masks", "flow", "previous"})
    stats_names = ("dropped", "linked", "mean_probability")

    def __init__(
        self,
        settings: ProbabilitySettings,
        segmentation: SegmentationSettings,
        evidence: str = "masks",
    ) -> None:
        super().__init__(settings, segmentation)
        self._boxes = evidence == "boxes"

    def reset(self, camera: Camera | None = None) -> None:
        """Forget all probabilities."""
        self._probability = np.zeros(0)

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Update the probabilities by this frame's masks."""
        settings = self.settings
        xy = frame.keypoints.xy

        # features that continue one of the previous frame take over its probability
        link = link_to_previous(frame, state, settings.link_px)
        if state.previous is None or len(self._probability) != len(state.previous.xy):
            link[:] = -1
        linked = link >= 0
        moving = np.full(len(link), UNKNOWN)
        moving[linked] = self._probability[link[linked]]
        if settings.expand_px > 0:
            radius = at_width(settings.expand_px, frame.gray.shape[1])
            moving = expand(xy, moving, linked, radius)

        # update by whether they lie on a dynamic object: moving average, or Bayes' rule
        if frame.instances is not None:
            if self._boxes:
                on_object = in_boxes(xy, dynamic_boxes(frame, self.segmentation)).any(axis=0)
            else:
                mask = dynamic_mask(frame.instances, self.segmentation, frame.depth)
                on_object = inside(mask, xy)
            if settings.rule == "average":
                moving = (1 - RATE) * moving + RATE * on_object
            else:
                likelihood = np.where(on_object, HIT, 1 - HIT)
                evidence = likelihood * moving
                moving = (evidence / (evidence + (1 - likelihood) * (1 - moving))).clip(0.01, 0.99)
        self._probability = moving

        # drop above the threshold; softly, static features weigh by their probability
        mean = moving.mean() if len(moving) else UNKNOWN
        verdict = self.verdict(
            moving <= settings.threshold, linked=np.count_nonzero(linked), mean_probability=mean
        )
        if settings.soft:
            return replace(verdict, weight=np.where(verdict.keep, 1 - moving, 0).astype(np.float32))
        return verdict


def link_to_previous(
    frame: FrameBundle, state: FilterState, radius_px: float = 2.5
) -> NDArray[np.intp]:
    """Index of the previous frame's keypoint that each keypoint continues, ``[N]``; -1 for none.

    Args:
        frame: The current frame.
        state: With the flow to the previous image.
        radius_px: Largest distance between the end of the flow and an earlier keypoint.
    """
    link = np.full(len(frame.xy), -1, dtype=np.intp)
    if state.flow is None or state.previous is None or not len(state.previous.xy):
        return link
    # the previous keypoint nearest to the end of each point's flow
    rows = np.flatnonzero(state.flow.valid & np.isfinite(state.flow.xy).all(axis=1))
    previous = cKDTree(state.previous.keypoints.xy)
    distance, nearest = previous.query(state.flow.xy[rows], distance_upper_bound=radius_px)
    near = np.isfinite(distance)
    link[rows[near]] = np.asarray(nearest)[near]
    return link


def expand(
    xy: NDArray[np.floating],
    probability: NDArray[np.float64],
    linked: NDArray[np.bool_],
    radius_px: float,
) -> NDArray[np.float64]:
    """Matching point expansion: a new feature takes a share of the nearest certain feature's probability.

    Args:
        xy: Pixels of all features ``[N, 2]``.
        probability: Moving probabilities of these features ``[N]``.
        linked: bool ``[N]``, which of them have a history.
        radius_px: Largest distance to that feature; its influence is a Gaussian of half this width.

    Returns:
        Probabilities ``[N]``; those with a history unchanged.
    """
    # the nearest certain feature of each new one
    expanded = probability.copy()
    certain = np.flatnonzero(linked & ((probability < CERTAIN[0]) | (probability > CERTAIN[1])))
    new = np.flatnonzero(~linked)
    distance, nearest = cKDTree(xy[certain]).query(xy[new], distance_upper_bound=radius_px)
    near = np.isfinite(distance)

    # pulled from "unknown" towards that one's probability, by a Gaussian of the distance
    influence = np.exp(-0.5 * np.square(np.asarray(distance)[near] / (0.5 * radius_px)))
    of_nearest = probability[certain[np.asarray(nearest)[near]]]
    expanded[new[near]] = UNKNOWN + influence * (of_nearest - UNKNOWN)
    return expanded
