"""Pyramidal Lucas-Kanade (OpenCV) behind the interface of all flows."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.flow import FlowResult

from .degenerate import STATS_NAMES, flow_stats, request, usable_points
from .settings import FlowSettings

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
