"""Rigid-motion test in 3-D: detects motion along epipolar lines, and motion under pure rotation of the camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import FilterResult, FilterState, FrameBundle, Need, Provenance
from dynslam_bench.culling import Rule
from dynslam_bench.culling.ego_motion import CELL, cell_index, coherent, depth_sigma, rigid_flow
from dynslam_bench.culling.settings import RigidMotionSettings
from dynslam_bench.geometry.camera import Camera

THRESHOLD_SHARE = 0.05
"""Added to the pixel threshold, as a share of the flow that the camera's motion explains (rolling shutter)."""
MEMORY = 0.6
"""Share of a point's evidence that is carried over from the previous frame."""


class RigidMotionFilter(Rule[RigidMotionSettings]):
    """Drops points whose flow or depth does not fit the camera's rigid motion since the previous frame.

    A point's evidence is 1 where it fails in the image or in depth. The evidence follows the flow and decays over the
    next frames (`MEMORY`), so that people who pause for a moment stay culled.
    Stats: ``dropped``, ``tested``, ``failed`` (in this frame alone).
    """

    name = "motion"
    needs: frozenset[Need] = frozenset({"flow", "previous", "prediction", "depth"})
    provenance: Provenance = "assumed"
    stats_names = ("dropped", "tested", "failed")

    def __init__(self, settings: RigidMotionSettings) -> None:
        super().__init__(settings)
        self._evidence: NDArray[np.float64] | None = None

    def reset(self, camera: Camera) -> None:
        """Forget the evidence of the previous sequence."""
        self._evidence = None

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Test the points that have flow and depth."""
        keep = np.ones(len(frame), dtype=bool)
        flow = state.flow
        if flow is None or state.previous is None or state.T_world_prev is None or state.T_world_pred is None:
            self._evidence = None
            return FilterResult.of(keep, {"tested": 0.0, "failed": 0.0})
        tested = flow.valid & (frame.z > 0)
        failed = np.zeros(len(frame), dtype=bool)
        failed[tested] = self._fails(frame, state, tested)
        failed = coherent(failed, tested, frame.keypoints.xy, self.settings.min_share, frame.gray.shape)
        evidence = failed.astype(np.float64)
        evidence[flow.valid] += MEMORY * self._past_evidence(frame, flow.xy[flow.valid])
        evidence = evidence.clip(0, 1)
        self._evidence = _pool(evidence, frame)
        return FilterResult.of(
            evidence < 0.5, {"tested": float(np.count_nonzero(tested)), "failed": float(np.count_nonzero(failed))}
        )

    def _fails(self, frame: FrameBundle, state: FilterState, tested: NDArray[np.bool_]) -> NDArray[np.bool_]:
        assert state.flow is not None and state.previous is not None
        moved, expected = rigid_flow(frame, state, tested)
        before = state.camera.undistort_points(state.flow.xy[tested])
        distance = np.linalg.norm(expected - before, axis=1)
        explained = np.linalg.norm(expected - frame.xy[tested], axis=1)
        limit_px = self.settings.threshold_px + THRESHOLD_SHARE * explained
        measured = nearest_depth(state.previous.depth, state.flow.xy[tested], moved[:, 2])
        limit = self.settings.threshold_sigma * np.sqrt(2) * depth_sigma(moved[:, 2])
        off_depth = (measured > 0) & (np.abs(measured - moved[:, 2]) > limit)
        return np.asarray(~(distance <= limit_px) | off_depth)

    def _past_evidence(self, frame: FrameBundle, before: NDArray[np.floating]) -> NDArray[np.float64]:
        if self._evidence is None:
            return np.zeros(len(before))
        return self._evidence[cell_index(before, CELL // 2, frame.gray.shape)[0]]


def nearest_depth(
    depth: NDArray[np.float32], xy: NDArray[np.floating], expected: NDArray[np.floating]
) -> NDArray[np.float64]:
    """The depth in the 3x3 patch around each raw pixel that is nearest to the expected depth.

    Thus depth edges and sub-pixel flow errors do not count as motion.

    Args:
        depth: float32 ``[H, W]`` metres, 0 or not finite where missing.
        xy: Raw pixels ``[N, 2]``.
        expected: Depths ``[N]``, metres.

    Returns:
        Depths ``[N]``, metres; 0 where the patch has none or lies outside the image.
    """
    height, width = depth.shape
    offsets = np.array([(dx, dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
    pixels = np.rint(xy)[:, None, :].astype(np.intp) + offsets
    column, row = pixels[..., 0], pixels[..., 1]
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    patch = np.where(inside, depth[row.clip(0, height - 1), column.clip(0, width - 1)], 0).astype(np.float64)
    patch[~np.isfinite(patch)] = 0
    gap = np.where(patch > 0, np.abs(patch - np.asarray(expected)[:, None]), np.inf)
    return np.asarray(np.take_along_axis(patch, gap.argmin(axis=1)[:, None], axis=1)[:, 0])


def _pool(evidence: NDArray[np.float64], frame: FrameBundle) -> NDArray[np.float64]:
    """Mean evidence of the keypoints in cells of half `CELL`, row by row; 0 where there are none."""
    index, (rows, columns) = cell_index(frame.keypoints.xy, CELL // 2, frame.gray.shape)
    total = np.bincount(index, weights=evidence, minlength=rows * columns)
    count = np.bincount(index, minlength=rows * columns)
    return np.asarray(total / np.maximum(count, 1))
