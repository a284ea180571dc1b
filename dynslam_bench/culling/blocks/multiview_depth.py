"""B4 and B5: DynaSLAM's multi-view geometry: what keyframes saw and something nearer hides now, moves."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.filter import (
    DynamicFilter,
    FilterResult,
    FilterState,
    FrameBundle,
    KeyframeView,
    Need,
    Provenance,
)
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.pixels import inside
from dynslam_bench.segmentation.masks.postprocess import dilate

from ..tools.light_track import light_track
from .multiview_depth_settings import MultiViewSettings
from .multiview_kernels import BIN_M, grow, hidden

MAX_REFERENCE_DEPTH_M = 6.0
MAX_PROJECTED_DEPTH_M = 7.0
MAX_DEPTH_M = 40.0
"""Measured depth beyond this counts as missing, as in the back end."""
MARGIN_PX = 20
"""Half side of the window around a projected point; points nearer to the image's border are not judged."""


class MultiViewFilter(DynamicFilter):
    """Drops what lies on something that hides points which earlier keyframes saw there.

    A region of like depth grows around every hidden point; features go on the region and within `border_px` of it.
    Difference from the authors' code: the parallax angle is taken between the camera centres (the code uses a
    translation in the wrong frame). Stats: ``dropped``, ``references``, ``seeds`` (hidden points), ``mask_fraction``.
    """

    name = "multiview"
    needs: frozenset[Need] = frozenset({"keyframes", "prediction", "depth"})
    provenance: Provenance = "faithful-code"
    stats_names = ("dropped", "references", "seeds", "mask_fraction")

    def __init__(self, settings: MultiViewSettings) -> None:
        self.settings = settings

    def reset(self, camera: Camera) -> None:
        """Nothing to forget."""

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Project the references' points into the frame and look for what hides them."""
        keep = np.ones(len(frame), dtype=bool)
        stats = {"references": 0.0, "seeds": 0.0, "mask_fraction": 0.0}
        if state.T_world_pred is None or len(state.keyframes) < self.settings.min_keyframes:
            return FilterResult.of(keep, stats)
        pose = light_track(frame, state)
        assert pose is not None
        references = self._choose(state.keyframes, pose)
        depth = np.nan_to_num(frame.depth, posinf=0.0, neginf=0.0)
        depth = np.ascontiguousarray(np.where((depth > 0) & (depth < MAX_DEPTH_M), depth, 0), dtype=np.float32)
        seeds = self._hiding(references, depth, pose, state.camera)
        stats |= {"references": float(len(references)), "seeds": float(len(seeds))}
        if not len(seeds):
            return FilterResult.of(keep, stats)
        mask = self._region(seeds, depth)
        stats["mask_fraction"] = float(mask.mean())
        dropped = inside(dilate(mask, self.settings.border_px), frame.keypoints.xy)
        return FilterResult.of(~dropped, stats, mask)

    def _choose(self, views: tuple[KeyframeView, ...], pose: NDArray[np.float64]) -> list[KeyframeView]:
        """At most `references` keyframes by 0.7 normalised distance + 0.3 normalised rotation."""
        relative = np.stack([se3.inverse(view.T_world_cam) @ pose for view in views])
        distance = np.linalg.norm(relative[:, :3, 3], axis=1)
        angle = se3.rotation_angle(relative)
        score = 0.7 * distance / max(distance.max(), 1e-9) + 0.3 * angle / max(angle.max(), 1e-9)
        ranked = np.argsort(score if self.settings.order == "nearest" else -score, kind="stable")
        return [views[i] for i in ranked[: self.settings.references]]

    def _hiding(
        self, views: list[KeyframeView], depth: NDArray[np.float32], pose: NDArray[np.float64], camera: Camera
    ) -> NDArray[np.int64]:
        """Pixels ``[M, 2]`` at which something hides the references' points now, reference by reference."""
        world, then = [], []
        for view in views:
            usable = (view.z > 0) & (view.z <= MAX_REFERENCE_DEPTH_M)
            world.append(se3.transform(view.T_world_cam, camera.unproject(view.xy[usable], view.z[usable])))
            then.append(world[-1] - view.T_world_cam[:3, 3])
        points = np.concatenate(world)
        now = points - pose[:3, 3]
        cosine = _cosine(np.concatenate(then), now)
        local = now @ pose[:3, :3]
        pixels = np.full((len(local), 2), -1.0)
        ahead = local[:, 2] > 0.1
        pixels[ahead] = camera.distort_points(camera.project(local[ahead]))
        shown = ahead & (cosine > np.cos(np.deg2rad(self.settings.max_parallax_deg)))
        shown &= local[:, 2] < MAX_PROJECTED_DEPTH_M
        size = (camera.width - MARGIN_PX - 2, camera.height - MARGIN_PX - 2)
        shown &= ((pixels >= MARGIN_PX) & (pixels <= size)).all(axis=1)
        if not shown.any():
            return np.zeros((0, 2), np.int64)
        centre = np.ceil(pixels[shown]).astype(np.int64)
        seeds = centre[hidden(depth, centre, local[shown, 2], self.settings.tau_m, MARGIN_PX)]
        return np.asarray(seeds[_depth_variance(depth, seeds) < self.settings.max_variance])

    def _region(self, seeds: NDArray[np.int64], depth: NDArray[np.float32]) -> NDArray[np.bool_]:
        if self.settings.grow:
            mask = grow(depth, np.ascontiguousarray(seeds), self.settings.grow_m, BIN_M)
        else:
            mask = np.zeros(depth.shape, np.uint8)
        mask[seeds[:, 1], seeds[:, 0]] = 1
        return dilate(mask.astype(bool), self.settings.dilation_px)


def _cosine(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cosines ``[N]`` of the angles between vectors ``[N, 3]``."""
    norms = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    return np.asarray((first * second).sum(axis=1) / np.maximum(norms, 1e-12))


def _depth_variance(depth: NDArray[np.float32], xy: NDArray[np.int64]) -> NDArray[np.float64]:
    """Variance ``[N]`` of the depth in the 41x41 neighbourhoods of pixels ``[N, 2]``, m^2.

    Missing depth counts as the 0 that it is stored as, as in the authors' code: beside it nothing is a seed.
    """
    if not len(xy):
        return np.zeros(0)
    height, width = depth.shape
    total, squares = cv2.integral2(depth, sdepth=cv2.CV_64F, sqdepth=cv2.CV_64F)
    (x0, y0), (x1, y1) = (xy - MARGIN_PX).clip(0).T, np.minimum(xy + MARGIN_PX + 1, (width, height)).T

    def within(table: NDArray[np.floating | np.integer]) -> NDArray[np.float64]:
        return np.asarray(table[y1, x1] - table[y0, x1] - table[y1, x0] + table[y0, x0], dtype=np.float64)

    n = (x1 - x0) * (y1 - y0)
    return np.asarray(within(squares) / n - np.square(within(total) / n))
