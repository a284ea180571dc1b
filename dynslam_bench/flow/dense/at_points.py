"""Dense DAISY Filter Flow behind the interface of all flows: the field of every pixel, read at the points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.flow import FlowResult

from ..daisy.maps import OrientationMaps
from ..degenerate import STATS_NAMES, flow_stats, request, usable_points
from ..settings import FlowSettings
from .labels import DenseDaisyFlow


class DensePointFlow:
    """The paper's flow (Eq. 1-3 over every pixel), read at the points; see `contracts.flow.FlowEstimator`.

    The field is read at the pixel that a point lies in, never between two: across the border of a moving thing a mean
    of two motions is nobody's. A point is valid if its pixel is (`dense_forward_backward_px`), if its way back ends
    within `forward_backward_px`, and if its aggregated cost is below `max_cost`. On the processor, whatever the device.

    Args:
        settings: How.
        threads: Over which regions are divided; the result does not depend on it.
    """

    stats_names = STATS_NAMES

    def __init__(self, settings: FlowSettings | None = None, *, threads: int = 1) -> None:
        self._dense = DenseDaisyFlow(settings or FlowSettings(mode="dense"), threads=threads)

    @property
    def settings(self) -> FlowSettings:
        """The settings in force."""
        return self._dense.settings

    @settings.setter
    def settings(self, settings: FlowSettings) -> None:
        self.configure(settings)

    def configure(self, settings: FlowSettings) -> None:
        """Work by these settings from the next pair on."""
        self._dense.configure(settings)

    def prepare(self, gray: NDArray[np.uint8]) -> OrientationMaps:
        """The orientation maps of a uint8 ``[H, W]`` image."""
        return self._dense.prepare(gray)

    def track(
        self,
        reference: OrientationMaps,
        target: OrientationMaps,
        points: NDArray[np.float32],
        *,
        guess: NDArray[np.float32] | None = None,
        seed: int = 0,
    ) -> FlowResult:
        """Find points of the reference in the target; see `FlowEstimator.track`. The guess is not used."""
        asked = request(reference.gray, target.gray, points)
        if isinstance(asked, FlowResult):
            return asked
        clean, usable = asked
        dense = self._dense.flow(reference, target, seed=seed)
        column, row = _pixels(clean)
        xy = (clean + dense.flow[row, column]).astype(np.float32)
        cost = dense.cost[row, column]
        valid = usable & dense.valid[row, column] & usable_points(xy, target.gray.shape)
        valid &= cost < self.settings.max_cost
        if self.settings.forward_backward_px > 0 and dense.back is not None:
            ends = np.where(valid[:, None], xy, clean)
            column, row = _pixels(ends)
            distance = np.linalg.norm(ends + dense.back[row, column] - clean, axis=1)
            valid &= distance <= self.settings.forward_backward_px
        stats = flow_stats(len(clean), int(valid.sum()), int(dense.stats["evaluations"]))
        return FlowResult(xy, valid, cost, stats)


def _pixels(points: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Column and row of the pixels that points inside an image lie in."""
    column, row = np.rint(points).astype(np.intp).T
    return column, row
