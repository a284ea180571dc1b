"""The rigid-motion test: which points do not move as the camera's motion explains.

The test finds motion along epipolar lines, and any motion while the camera only rotates or stands
still.
"""

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import FilterResult, FilterState, FrameBundle, Need
from dynslam_bench.core.compiled import kernel
from dynslam_bench.culling import BaseFilter
from dynslam_bench.culling.ego_motion import PATCH_3X3, Array, Floats, depth_sigma, rigid_flow
from dynslam_bench.culling.moving_regions import in_moving_region
from dynslam_bench.culling.settings import RigidMotionSettings
from dynslam_bench.geometry import Camera, at_width, pixel_index

THRESHOLD_SHARE = 0.05
"""Added to the pixel threshold, as a share of the flow that the camera's motion explains (rolling shutter)."""
MEAN_S = 0.07
"""Time constant of the mean residual, which finds slow steady motion."""
MEMORY_S = 1.65
"""Time constant with which the count of a point's failures decays."""
NEARBY_PX = 24.0
"""Points within this distance along both axes, at an image width of 640, share their counts if their depths are
similar."""
SIMILAR_DEPTH = 0.1
"""Depths are similar if they differ by no more than this share."""
MAX_FAILURES = 2.5
"""Above this count a point is dropped although it passes now: from the third failure in a row on, and for some seconds
after an object has stopped. It would otherwise become a part of the map, and take the camera along when it moves on.
A whole image that fails in a frame or two, as after a wrong stamp, stays below."""


class RigidMotionFilter(BaseFilter[RigidMotionSettings]):
    """Drops points whose flow or depth does not fit the camera's rigid motion since the previous frame.

    A point fails by its residual in this frame, or by the mean of the last few, in which slow
    motion adds up and noise does not. Points are dropped that fail now, or failed more than
    `MAX_FAILURES` times before, so that people and objects that pause stay culled. Mean and count
    decay and follow the flow; points nearby share them at similar depth. Stats: ``dropped``,
    ``tested``, ``failed`` (in this frame alone).
    """

    name = "motion"
    needs: frozenset[Need] = frozenset({"flow", "previous", "prediction", "depth"})
    stats_names = ("dropped", "tested", "failed")

    def reset(self, camera: Camera | None = None) -> None:
        """Forget the previous sequence."""
        # [N, 3] of the previous points: failures, mean residual over its limit
        self._memory: Array | None = None

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Test the points that have flow and depth."""
        flow = state.flow
        xy = frame.keypoints.xy
        shape = frame.gray.shape
        if (
            flow is None
            or state.previous is None
            or state.T_world_prev is None
            or state.T_world_pred is None
        ):
            self._memory = None
            return self.verdict(np.ones(len(xy), dtype=bool))

        # test flow and depth of this frame
        tested = flow.valid & (frame.z > 0)
        failed = np.zeros(len(xy), dtype=bool)
        residual = np.zeros((len(xy), 2))
        failed[tested], residual[tested], allowed = self._test(frame, state, tested)

        # what is remembered around the points' origins in the previous frame
        before = np.zeros((len(xy), 3))
        dt = frame.timestamp - state.previous.timestamp
        if self._memory is not None:
            origin = np.where(flow.valid[:, None], flow.xy, xy)
            before = nearby_mean(
                state.previous.keypoints.xy,
                state.previous.z,
                self._memory,
                origin,
                frame.z,
                at_width(NEARBY_PX, shape[1]),
            )

        # mean residual over its limit; the mean's noise is this share of one residual's
        carried = np.exp(-dt / MEAN_S)
        noise = np.sqrt((1 - carried) / (1 + carried))
        step = (1 - carried) * residual
        step[tested] /= (noise * self.settings.threshold_px + allowed)[:, None]
        # after one bad frame the mean passes
        step /= np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1)
        mean = step + carried * before[:, 1:]
        failed |= tested & (np.linalg.norm(mean, axis=1) > 1)

        # lone failures are noise; failures are counted, and the count decays
        failed = in_moving_region(failed, tested, xy, self.settings.min_share, shape)
        failures = failed + np.exp(-dt / MEMORY_S) * before[:, 0]
        self._memory = np.column_stack([failures, mean])
        keep = ~failed & (failures <= MAX_FAILURES)
        return self.verdict(keep, tested=np.count_nonzero(tested), failed=np.count_nonzero(failed))

    def _test(
        self, frame: FrameBundle, state: FilterState, tested: NDArray[np.bool_]
    ) -> tuple[NDArray[np.bool_], Array, Array]:
        """Compare K tested points with the camera's motion.

        Returns:
            Flags ``[K]`` of points that fail now, residuals ``[K, 2]`` in pixels, and additions
            ``[K]`` to the threshold in pixels.
        """
        assert state.flow is not None
        assert state.previous is not None

        # flow: distance from where the camera's motion takes the point
        moved, expected = rigid_flow(frame, state, tested)
        residual = expected - state.flow_xy[tested]
        distance = np.linalg.norm(residual, axis=1)
        allowed = THRESHOLD_SHARE * np.linalg.norm(expected - frame.xy[tested], axis=1)

        # depth: what was measured there must be the point; both measurements are noisy
        measured = nearest_depth(state.previous.depth, state.flow.xy[tested], moved[:, 2])
        limit = self.settings.threshold_sigma * np.sqrt(2) * depth_sigma(moved[:, 2])
        off_depth = (measured > 0) & (np.abs(measured - moved[:, 2]) > limit)
        return ~(distance <= self.settings.threshold_px + allowed) | off_depth, residual, allowed


def nearby_mean(
    xy: Floats, z: Floats, values: Array, at: Floats, at_z: Floats, nearby_px: float
) -> Array:
    """Mean value of the points around each pixel whose depth is similar, so that an object's edge is not averaged away.

    Args:
        xy: Raw pixels of the points ``[N, 2]``.
        z: Depths of the points ``[N]``, metres, 0 missing.
        values: ``[N, K]``, whose means are taken.
        at: Raw pixels ``[M, 2]`` around which they are taken.
        at_z: Depths there ``[M]``, metres; where 0, points of any depth count.
        nearby_px: Largest distance along either axis, pixels.

    Returns:
        Means ``[M, K]``; 0 where there is no such point.
    """
    # sorted by rows, so that few points are compared: from the first row that may be near
    order = np.argsort(xy[:, 1], kind="stable")
    first = np.searchsorted(xy[order, 1], at[:, 1].astype(np.float64) - nearby_px)
    means = np.zeros((len(at), values.shape[1]))
    _fill_nearby_mean(xy[order], z[order], values[order], at, at_z, first, nearby_px, means)
    return means


@kernel
def _fill_nearby_mean(
    xy: Floats,
    z: Floats,
    values: Array,
    at: Floats,
    at_z: Floats,
    first: NDArray[np.int64],
    nearby_px: float,
    means: Array,
) -> None:
    """Add the means ``[M, K]`` of the values of nearby points.

    Args:
        xy: Raw pixels ``[N, 2]``, sorted by rows.
        z: Depths ``[N]``, metres, 0 missing.
        values: ``[N, K]``, whose means are taken.
        at: Raw pixels ``[M, 2]`` around which they are taken.
        at_z: Depths there ``[M]``, metres, 0 missing.
        first: For each of these ``[M]`` the first point that may be near.
        nearby_px: Largest distance along either axis, pixels.
        means: Filled; zeros before.
    """
    for i in range(len(at)):
        # what counts as near: columns to either side, a last row, a share of the depth
        column = at[i, 0]
        depth = at_z[i]
        tolerance = SIMILAR_DEPTH * at_z[i]
        last = at[i, 1] + nearby_px
        count = 0
        for k in range(first[i], len(xy)):
            if xy[k, 1] > last:
                break
            # add up those that are near in the image and in depth
            if abs(xy[k, 0] - column) <= nearby_px and (
                depth <= 0 or abs(z[k] - depth) <= tolerance
            ):
                for j in range(means.shape[1]):
                    means[i, j] += values[k, j]
                count += 1
        # from sums to means
        if count > 0:
            for j in range(means.shape[1]):
                means[i, j] /= count


def nearest_depth(
    depth: NDArray[np.float32], xy: NDArray[np.floating], expected: NDArray[np.floating]
) -> NDArray[np.float64]:
    """The depth closest to `expected` in the 3x3 patch around each raw pixel.

    Thus depth edges and sub-pixel flow errors do not count as motion.

    Args:
        depth: float32 ``[H, W]`` metres, 0 or not finite where missing.
        xy: Raw pixels ``[N, 2]``.
        expected: Depths ``[N]``, metres.

    Returns:
        Depths ``[N]``, metres; 0 where the patch has none or lies outside the image.
    """
    at, visible = pixel_index(np.rint(xy)[:, None] + PATCH_3X3, depth.shape)
    patch = depth[at].astype(np.float64)
    patch[~visible | ~np.isfinite(patch)] = 0
    gap = np.where(patch > 0, np.abs(patch - np.asarray(expected)[:, None]), np.inf)
    return np.asarray(np.take_along_axis(patch, gap.argmin(axis=1)[:, None], axis=1)[:, 0])
