"""B4 and B5: DynaSLAM's multi-view geometry: what keyframes saw and something nearer hides now, moves."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.segmentation.postprocess import dilate

from .baseline_settings import MultiViewSettings
from .filter import DynamicFilter, FilterResult, FilterState, FrameBundle, KeyframeView, Need, Provenance
from .light_track import light_track
from .semantic import inside

MAX_REFERENCE_DEPTH_M = 6.0
MAX_PROJECTED_DEPTH_M = 7.0
MARGIN_PX = 20
WINDOW = np.array([(dx, dy) for dy in range(-20, 21, 4) for dx in range(-20, 21, 4)])
"""Offsets searched around a projected point: DynaSLAM's 41x41 window on every fourth pixel, for speed."""


class MultiViewFilter(DynamicFilter):
    """Drops what lies on something that hides points which earlier keyframes saw there.

    Differences from the authors' code: the parallax angle is taken between the camera centres (the code uses a
    translation in the wrong frame), and a region grows around the depth of its seed instead of its running mean.
    Stats: ``dropped``, ``references``, ``seeds`` (hidden points), ``mask_fraction``.
    """

    name = "multiview"
    needs: frozenset[Need] = frozenset({"keyframes", "prediction", "depth"})
    provenance: Provenance = "faithful-code"

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
        depth = np.nan_to_num(frame.depth)
        flat = _flat(depth, self.settings.max_variance)
        found = [self._hiding(view, depth, flat, pose, state.camera) for view in references]
        seeds = np.concatenate(found)
        stats |= {"references": float(len(references)), "seeds": float(len(seeds))}
        if not len(seeds):
            return FilterResult.of(keep, stats)
        mask = self._region(seeds, depth)
        stats["mask_fraction"] = float(mask.mean())
        return FilterResult.of(~inside(mask, frame.keypoints.xy), stats, mask)

    def _choose(self, views: tuple[KeyframeView, ...], pose: NDArray[np.float64]) -> list[KeyframeView]:
        """At most `references` keyframes by 0.7 normalised distance + 0.3 normalised rotation."""
        relative = np.stack([se3.inverse(view.T_world_cam) @ pose for view in views])
        distance = np.linalg.norm(relative[:, :3, 3], axis=1)
        angle = se3.rotation_angle(relative)
        score = 0.7 * distance / max(distance.max(), 1e-9) + 0.3 * angle / max(angle.max(), 1e-9)
        ranked = np.argsort(score if self.settings.order == "nearest" else -score, kind="stable")
        return [views[i] for i in ranked[: self.settings.references]]

    def _hiding(
        self, view: KeyframeView, depth: NDArray[np.float32], flat: NDArray[np.bool_], pose: NDArray[np.float64],
        camera: Camera,
    ) -> NDArray[np.intp]:  # fmt: skip
        """Pixels ``[M, 2]`` of the surfaces that hide the reference's points now."""
        usable = (view.z > 0) & (view.z <= MAX_REFERENCE_DEPTH_M)
        world = se3.transform(view.T_world_cam, camera.unproject(view.xy[usable], view.z[usable]))
        then, now = world - view.T_world_cam[:3, 3], world - pose[:3, 3]
        norms = np.linalg.norm(then, axis=1) * np.linalg.norm(now, axis=1)
        cosine = (then * now).sum(axis=1) / np.maximum(norms, 1e-12)
        local = se3.transform(se3.inverse(pose), world)
        pixels = np.full((len(local), 2), -1.0)
        ahead = local[:, 2] > 0.1
        pixels[ahead] = camera.distort_points(camera.project(local[ahead]))
        shown = ahead & (cosine > np.cos(np.deg2rad(self.settings.max_parallax_deg)))
        shown &= local[:, 2] < MAX_PROJECTED_DEPTH_M
        size = (camera.width - MARGIN_PX - 1, camera.height - MARGIN_PX - 1)
        shown &= ((pixels >= MARGIN_PX) & (pixels <= size)).all(axis=1)
        if not shown.any():
            return np.zeros((0, 2), np.intp)
        around = np.rint(pixels[shown]).astype(np.intp)[:, None] + WINDOW
        measured = depth[around[..., 1], around[..., 0]].astype(np.float64)
        gap = local[shown, 2, None] - measured
        gap = np.where((measured > 0) & (gap > 0), gap, np.inf)
        best = gap.argmin(axis=1)
        smallest = np.take_along_axis(gap, best[:, None], axis=1)[:, 0]
        where = np.take_along_axis(around, best[:, None, None], axis=1)[:, 0]
        hides = np.isfinite(smallest) & (smallest > self.settings.tau_m) & flat[where[:, 1], where[:, 0]]
        return np.asarray(where[hides])

    def _region(self, seeds: NDArray[np.intp], depth: NDArray[np.float32]) -> NDArray[np.bool_]:
        height, width = depth.shape
        mask: NDArray[np.integer | np.floating] = np.zeros((height, width), np.uint8)
        if self.settings.grow:
            small = np.ascontiguousarray(depth[::2, ::2])
            grown = np.zeros((small.shape[0] + 2, small.shape[1] + 2), np.uint8)
            flags = 4 | cv2.FLOODFILL_MASK_ONLY | cv2.FLOODFILL_FIXED_RANGE | (1 << 8)
            for x, y in seeds // 2:
                if not grown[y + 1, x + 1] and small[y, x] > 0:
                    step = self.settings.grow_m
                    cv2.floodFill(small, grown, (int(x), int(y)), 0, step, step, flags)
            mask = cv2.resize(grown[1:-1, 1:-1], (width, height), interpolation=cv2.INTER_NEAREST)
            mask[depth <= 0] = 0
        mask[seeds[:, 1], seeds[:, 0]] = 1
        return dilate(mask.astype(bool), self.settings.dilation_px)


def _flat(depth: NDArray[np.float32], limit: float) -> NDArray[np.bool_]:
    """Bool ``[H, W]``: pixels whose 41x41 neighbourhood has a depth variance below the limit, m^2."""
    valid = (depth > 0).astype(np.float64)
    box = [cv2.boxFilter(image, -1, (41, 41), normalize=False) for image in (valid, depth * valid, depth**2 * valid)]
    count = np.maximum(box[0], 1)
    return np.asarray(box[2] / count - np.square(box[1] / count) < limit)
