"""Pyramidal Lucas-Kanade and dense inverse search (DIS) of OpenCV, with a forward-backward check."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.flow import FlowResult
from dynslam_bench.flow.degenerate import (
    STATS_NAMES,
    clean_points,
    flow_stats,
    invalid_result,
    usable_points,
)
from dynslam_bench.flow.settings import FlowMethodSettings

Image = NDArray[np.uint8]
Points = NDArray[np.float32]

LEVELS = 4
"""Pyramid levels of Lucas-Kanade, the full image included."""
CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01)
"""Lucas-Kanade stops after 30 iterations, or at a step below 0.01 pixels."""
MIN_EIGENVALUE = 1e-4
"""Lucas-Kanade loses a point whose gradient matrix has a smaller eigenvalue (normalised as OpenCV does)."""
PRESETS = {
    "ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
    "fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
    "medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
}
"""OpenCV's presets of DIS by the value of the setting ``dis_preset``."""
SMALLEST_SIDE = 32
"""DIS fails on images below its patch and pyramid sizes."""


class LucasKanadeFlow:
    """Bouguet's pyramidal tracker; see `contracts.flow.FlowEstimator`.

    Args:
        settings: Window and forward-backward check.
        device: Not used: OpenCV computes on the processor.
        threads: Not used: OpenCV has its own threads.
    """

    stats_names = STATS_NAMES
    smallest_side = 1

    def __init__(
        self, settings: FlowMethodSettings | None = None, *, device: str = "cpu", threads: int = 1
    ) -> None:
        self.settings = settings or FlowMethodSettings()

    def configure(self, settings: FlowMethodSettings) -> None:
        """Use other settings from the next call on."""
        self.settings = settings

    def prepare(self, gray: Image) -> Image:
        """The image itself: OpenCV's Python binding takes no prepared pyramid."""
        return np.ascontiguousarray(gray)

    def track(
        self,
        reference: Image,
        target: Image,
        points: Points,
        *,
        guess: Points | None = None,
        seed: int = 0,
    ) -> FlowResult:
        """Find points of the reference in the target; see `FlowEstimator.track`."""
        cleaned = clean_points(reference, target, points)
        if isinstance(cleaned, FlowResult):
            return cleaned
        clean, usable = cleaned
        if min(reference.shape) < self.smallest_side:
            return invalid_result(clean, degenerate=True)

        # track from the predicted positions, where they are usable
        initial = clean
        if guess is not None:
            predicted = np.asarray(guess, dtype=np.float32).reshape(-1, 2)
            initial = np.where(usable_points(predicted, target.shape)[:, None], predicted, clean)
        xy, tracked, cost = self._follow(reference, target, clean, initial)
        valid = usable & tracked & usable_points(xy, target.shape)

        # forward-backward check: track back, and compare with where the points were
        if self.settings.forward_backward_px > 0:
            ends = np.where(valid[:, None], xy, clean)
            back, returned, _ = self._follow(target, reference, ends, clean)
            error = np.hypot(*(back - clean).T)
            valid &= returned & (error <= self.settings.forward_backward_px)
        xy = np.where(np.isfinite(xy), xy, clean).astype(np.float32)
        return FlowResult(xy, valid, cost, flow_stats(len(clean), int(valid.sum())))

    def _follow(
        self, first: Image, second: Image, points: Points, initial: Points
    ) -> tuple[Points, NDArray[np.bool_], Points]:
        """Positions in the second image, whether the tracker found them, and its cost."""
        # windows have an odd side
        side = self.settings.window_px | 1
        xy, status, error = cv2.calcOpticalFlowPyrLK(
            first,
            second,
            points,
            initial.astype(np.float32).copy(),
            winSize=(side, side),
            maxLevel=LEVELS - 1,
            criteria=CRITERIA,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            minEigThreshold=MIN_EIGENVALUE,
        )
        tracked = np.asarray(status).reshape(-1) > 0
        cost = np.where(tracked, np.asarray(error, dtype=np.float32).reshape(-1), 255.0)
        return np.asarray(xy, dtype=np.float32), tracked, np.asarray(cost, dtype=np.float32)


class DisFlow(LucasKanadeFlow):
    """Dense inverse search, read at the points; the guess is not used and the cost is 0."""

    smallest_side = SMALLEST_SIDE

    def __init__(
        self, settings: FlowMethodSettings | None = None, *, device: str = "cpu", threads: int = 1
    ) -> None:
        super().__init__(settings)
        self._dis = cv2.DISOpticalFlow.create(PRESETS[self.settings.dis_preset])

    def __reduce__(self) -> tuple[Any, ...]:
        """Copied and pickled by its settings: OpenCV's object cannot be, and stores nothing of an image."""
        return DisFlow, (self.settings,)

    def dense(self, reference: Image, target: Image) -> NDArray[np.float32]:
        """Flow of every pixel, float32 ``[H, W, 2]``."""
        # None, not zeros: given a flow, DIS starts from it instead of from its coarsest level
        return np.asarray(self._dis.calc(reference, target, None), dtype=np.float32)  # type: ignore[call-overload]

    def _follow(
        self, first: Image, second: Image, points: Points, initial: Points
    ) -> tuple[Points, NDArray[np.bool_], Points]:
        """Positions in the second image by the dense flow, interpolated bilinearly at the points."""
        flow = self.dense(first, second)
        height, width = flow.shape[:2]
        # the four pixels around each point, and where the point lies between them
        corner = np.minimum(points.astype(np.int64), (width - 2, height - 2))
        fx, fy = (points - corner).T[:, :, None]
        x, y = corner.T
        upper = flow[y, x] * (1 - fx) + flow[y, x + 1] * fx
        lower = flow[y + 1, x] * (1 - fx) + flow[y + 1, x + 1] * fx
        xy = points + np.asarray(upper * (1 - fy) + lower * fy, dtype=np.float32)
        return xy, np.ones(len(points), np.bool_), np.zeros(len(points), np.float32)
