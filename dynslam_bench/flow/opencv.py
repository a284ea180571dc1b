"""Pyramidal Lucas-Kanade (OpenCV) behind the interface of all flows."""

from __future__ import annotations

from copy import copy
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.flow import FlowResult
from dynslam_bench.flow.degenerate import STATS_NAMES, flow_stats, invalid_result, request, usable_points
from dynslam_bench.flow.settings import FlowSettings

_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01)
_MIN_EIGENVALUE = 1e-4


class LucasKanadeFlow:
    """Bouguet's pyramidal tracker, with its way back as a check; see `contracts.flow.FlowEstimator`."""

    stats_names = STATS_NAMES

    def __init__(self, settings: FlowSettings | None = None) -> None:
        self.settings = settings or FlowSettings(method="lucas-kanade")
        side = self.settings.window_px | 1
        self._window = (side, side)

    def configure(self, settings: FlowSettings) -> None:
        """Put other settings into force from the next call on."""
        self.settings = settings

    def prepare(self, gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image itself: OpenCV's Python binding takes no ready pyramid."""
        return np.ascontiguousarray(gray)

    def track(
        self,
        reference: NDArray[np.uint8],
        target: NDArray[np.uint8],
        points: NDArray[np.float32],
        *,
        guess: NDArray[np.float32] | None = None,
        seed: int = 0,
    ) -> FlowResult:
        """Find points of the reference in the target; see `FlowEstimator.track`."""
        asked = request(reference, target, points)
        if isinstance(asked, FlowResult):
            return asked
        clean, usable = asked
        initial = clean.copy()
        if guess is not None:
            predicted = np.asarray(guess, dtype=np.float32).reshape(-1, 2)
            initial = np.where(usable_points(predicted, target.shape)[:, None], predicted, clean)
        xy, found, error = self._follow(reference, target, clean, initial)
        valid = usable & found & usable_points(xy, target.shape)
        if self.settings.forward_backward_px > 0:
            back, returned, _ = self._follow(target, reference, np.where(valid[:, None], xy, clean), clean)
            valid &= returned & (np.hypot(*(back - clean).T) <= self.settings.forward_backward_px)
        xy = np.where(np.isfinite(xy), xy, clean).astype(np.float32)
        stats = flow_stats(len(clean), int(valid.sum()))
        return FlowResult(xy, valid, error, stats)

    def _follow(
        self,
        first: NDArray[np.uint8],
        second: NDArray[np.uint8],
        points: NDArray[np.float32],
        initial: NDArray[np.float32],
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32]]:
        xy, status, error = cv2.calcOpticalFlowPyrLK(
            first, second, points, initial.astype(np.float32).copy(), winSize=self._window,
            maxLevel=self.settings.levels - 1, criteria=_CRITERIA, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            minEigThreshold=_MIN_EIGENVALUE,
        )  # fmt: skip
        found = np.asarray(status).reshape(-1) > 0
        cost = np.where(found, np.asarray(error, dtype=np.float32).reshape(-1), 255.0)
        return np.asarray(xy, dtype=np.float32), found, np.asarray(cost, dtype=np.float32)


# Dense inverse search (OpenCV's DIS) behind the interface of all flows.

_PRESETS = {
    "ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
    "fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
    "medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
}
SMALLEST_SIDE = 32
"""DIS fails on images below its patch and pyramid sizes."""


class DisFlow:
    """Dense flow, read at the points; the way back is a check; see `contracts.flow.FlowEstimator`."""

    stats_names = STATS_NAMES

    def __init__(self, settings: FlowSettings | None = None) -> None:
        self.settings = settings or FlowSettings(method="dis")
        self._dis = cv2.DISOpticalFlow.create(_PRESETS[self.settings.dis_preset])

    def __deepcopy__(self, memo: dict[int, Any]) -> DisFlow:
        """A flow of the same settings: OpenCV's object cannot be copied, and holds nothing of an image."""
        return copy(self)

    def configure(self, settings: FlowSettings) -> None:
        """Put other settings into force from the next call on."""
        self.settings = settings

    def prepare(self, gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image itself."""
        return np.ascontiguousarray(gray)

    def dense(self, reference: NDArray[np.uint8], target: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Flow of every pixel, float32 ``[H, W, 2]``."""
        # None, not zeros: given a flow, DIS starts from it instead of from its coarsest level
        found = self._dis.calc(reference, target, None)  # type: ignore[call-overload]
        return np.asarray(found, dtype=np.float32)

    def track(
        self,
        reference: NDArray[np.uint8],
        target: NDArray[np.uint8],
        points: NDArray[np.float32],
        *,
        guess: NDArray[np.float32] | None = None,
        seed: int = 0,
    ) -> FlowResult:
        """Find points of the reference in the target; see `FlowEstimator.track`. The guess is not used."""
        asked = request(reference, target, points)
        if isinstance(asked, FlowResult):
            return asked
        clean, usable = asked
        if min(reference.shape) < SMALLEST_SIDE:
            return invalid_result(clean)
        xy = clean + _read(self.dense(reference, target), clean)
        valid = usable & usable_points(xy, target.shape)
        cost = np.zeros(len(clean), dtype=np.float32)
        if self.settings.forward_backward_px > 0:
            seen = np.where(valid[:, None], xy, clean).astype(np.float32)
            back = seen + _read(self.dense(target, reference), seen)
            cost = np.hypot(*(back - clean).T).astype(np.float32)
            valid &= cost <= self.settings.forward_backward_px
        xy = np.where(np.isfinite(xy), xy, clean).astype(np.float32)
        return FlowResult(xy, valid, cost, flow_stats(len(clean), int(valid.sum())))


def _read(flow: NDArray[np.float32], points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Bilinear values ``[N, 2]`` of a flow field at points inside it."""
    height, width = flow.shape[:2]
    corner = np.minimum(points.astype(np.int64), (width - 2, height - 2))
    fx, fy = (points - corner).T[:, :, None]
    x, y = corner.T
    upper = flow[y, x] * (1 - fx) + flow[y, x + 1] * fx
    lower = flow[y + 1, x] * (1 - fx) + flow[y + 1, x + 1] * fx
    return np.asarray(upper * (1 - fy) + lower * fy, dtype=np.float32)
