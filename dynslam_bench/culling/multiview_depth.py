"""B4 and B5: DynaSLAM's multi-view geometry: an object that hides points of earlier keyframes is dynamic."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import (
    FilterResult,
    FilterState,
    FlowResult,
    FrameBundle,
    KeyframeView,
    Need,
)
from dynslam_bench.core.compiled import kernel
from dynslam_bench.culling import BaseFilter
from dynslam_bench.culling.ego_motion import refine_prediction
from dynslam_bench.culling.settings import MultiViewSettings
from dynslam_bench.features.matching import CellGrid, Features, as_words, search_in_radius
from dynslam_bench.geometry import Camera, at_width, inside, se3
from dynslam_bench.segmentation.postprocess import dilate

MAX_REFERENCE_DEPTH_M = 6.0
"""Points that their keyframe measured farther away are not tested."""
MAX_PROJECTED_DEPTH_M = 7.0
"""Points that should be seen farther away in the frame are not tested."""
MIN_DEPTH_M = 0.1
"""Points nearer than this to the camera plane are not tested."""
MAX_DEPTH_M = 40.0
"""Measured depth beyond this counts as missing, as in the back end."""
GROW_M = 0.2
"""Largest depth difference to the mean of a region (our assumption)."""
MARGIN_PX = 20
"""Half side of the window around a projected point, at an image width of 640; points nearer to the image's border are
not tested."""


class MultiViewFilter(BaseFilter[MultiViewSettings]):
    """Drops the features on objects that hide points which earlier keyframes observed.

    A region of similar depth grows around every hidden point; features on it and within `border_px`
    of it are dropped. Difference from the authors' code: the parallax angle is taken between the
    camera centres (the code uses a translation in the wrong frame). Stats: ``dropped``,
    ``references``, ``seeds`` (hidden points), ``mask_fraction``.
    """

    name = "multiview"
    needs: frozenset[Need] = frozenset({"keyframes", "prediction", "depth"})
    stats_names = ("dropped", "references", "seeds", "mask_fraction")

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Project the references' points into the frame and find the objects that hide them."""
        keep = np.ones(len(frame.xy), dtype=bool)
        if state.T_world_pred is None or len(state.keyframes) < self.settings.min_keyframes:
            return self.verdict(keep)

        # low-cost tracking, and the keyframes that are compared
        pose = refine_by_matches(frame, state)
        assert pose is not None
        references = self._choose(state.keyframes, pose)

        # pixels at which an object hides the keyframes' points
        measured = (frame.depth > 0) & (frame.depth < MAX_DEPTH_M)
        depth = np.ascontiguousarray(np.where(measured, frame.depth, 0), dtype=np.float32)
        seeds = self._seeds(references, depth, pose, state.camera)
        if not len(seeds):
            return self.verdict(keep, references=len(references))

        # the objects: regions of similar depth around them
        region = np.zeros(depth.shape, np.uint8)
        if self.settings.grow:
            region = grow(depth, np.ascontiguousarray(seeds), GROW_M, BIN_M)
        region[seeds[:, 1], seeds[:, 0]] = 1
        width = depth.shape[1]
        mask = dilate(region.astype(bool), at_width(self.settings.dilation_px, width))
        border = at_width(self.settings.border_px, width)
        dropped = inside(dilate(mask, border), frame.keypoints.xy)
        return self.verdict(
            ~dropped,
            mask,
            references=len(references),
            seeds=len(seeds),
            mask_fraction=float(mask.mean()),
        )

    def _choose(
        self, views: tuple[KeyframeView, ...], pose: NDArray[np.float64]
    ) -> list[KeyframeView]:
        """At most `references` keyframes by 0.7 normalised distance + 0.3 normalised rotation."""
        # motion from each keyframe to the frame
        relative = np.stack([se3.inverse(view.T_world_cam) @ pose for view in views])
        distance = np.linalg.norm(relative[:, :3, 3], axis=1)
        angle = se3.rotation_angle(relative)
        score = 0.7 * distance / max(distance.max(), 1e-9) + 0.3 * angle / max(angle.max(), 1e-9)
        ranked = np.argsort(score if self.settings.order == "nearest" else -score, kind="stable")
        return [views[i] for i in ranked[: self.settings.references]]

    def _seeds(
        self,
        views: list[KeyframeView],
        depth: NDArray[np.float32],
        pose: NDArray[np.float64],
        camera: Camera,
    ) -> NDArray[np.int64]:
        """Pixels ``[M, 2]`` at which an object hides the references' points, reference by reference.

        Args:
            views: Keyframes whose features are projected into the frame.
            depth: float32 ``[H, W]`` metres, 0 missing.
            pose: Camera-to-world pose ``[4, 4]`` of the frame.
            camera: Intrinsics and distortion.
        """
        # the keyframes' points in the world, and the rays to them from both cameras
        world = []
        from_view = []
        for view in views:
            usable = (view.z > 0) & (view.z <= MAX_REFERENCE_DEPTH_M)
            local = camera.unproject(view.xy[usable], view.z[usable])
            world.append(se3.transform(view.T_world_cam, local))
            from_view.append(world[-1] - view.T_world_cam[:3, 3])
        from_frame = np.concatenate(world) - pose[:3, 3]
        from_reference = np.concatenate(from_view)
        norms = np.linalg.norm(from_reference, axis=1) * np.linalg.norm(from_frame, axis=1)
        cosine = (from_reference * from_frame).sum(axis=1) / np.maximum(norms, 1e-12)

        # points in view of the frame with a small parallax, not near the border
        local = from_frame @ pose[:3, :3]
        pixels = np.full((len(local), 2), -1.0)
        ahead = local[:, 2] > MIN_DEPTH_M
        pixels[ahead] = camera.distort_points(camera.project(local[ahead]))
        visible = ahead & (cosine > np.cos(np.deg2rad(self.settings.max_parallax_deg)))
        visible &= local[:, 2] < MAX_PROJECTED_DEPTH_M
        margin = window_margin(depth)
        size = (camera.width - margin - 2, camera.height - margin - 2)
        visible &= ((pixels >= margin) & (pixels <= size)).all(axis=1)

        # hidden by something nearer, where depth is even
        centre = np.ceil(pixels[visible]).astype(np.int64)
        is_hidden = hidden(depth, centre, local[visible, 2], self.settings.tau_m, margin)
        seeds = centre[is_hidden]
        return np.asarray(seeds[_depth_variance(depth, seeds) < self.settings.max_variance])


def window_margin(depth: NDArray[np.float32]) -> int:
    """`MARGIN_PX` at the width of a depth image ``[H, W]``, whole pixels."""
    return max(1, round(at_width(MARGIN_PX, depth.shape[1])))


def _depth_variance(depth: NDArray[np.float32], xy: NDArray[np.int64]) -> NDArray[np.float64]:
    """Variance ``[N]`` of the depth in the neighbourhoods of pixels ``[N, 2]``, m^2; of 41x41 at a width of 640.

    Missing depth counts as 0, as in the authors' code: no seed lies beside missing depth.
    """
    # the windows' corners, within the image, and their numbers of pixels
    height, width = depth.shape
    margin = window_margin(depth)
    x0, y0 = (xy - margin).clip(0).T
    x1, y1 = np.minimum(xy + margin + 1, (width, height)).T
    n = (x1 - x0) * (y1 - y0)

    def window_means(table: NDArray[np.generic]) -> NDArray[np.float64]:
        """Means ``[N]`` over the windows by an integral image."""
        total = table[y1, x1] - table[y0, x1] - table[y1, x0] + table[y0, x0]
        return np.asarray(np.asarray(total, dtype=np.float64) / n)

    # variance as the mean square less the squared mean
    sums, squared_sums = cv2.integral2(depth, sdepth=cv2.CV_64F, sqdepth=cv2.CV_64F)
    return np.asarray(window_means(squared_sums) - np.square(window_means(sums)))


# Compiled loops of DynaSLAM's multi-view geometry: which projected points are hidden, and what
# hides them.

BIN_M = 0.005
"""Depth resolution at which the next pixel of a region is chosen: the one nearest to the region's mean comes first."""


@kernel
def hidden(
    depth: NDArray[np.float32],
    centre: NDArray[np.int64],
    expected: NDArray[np.float64],
    tau: float,
    radius: int,
) -> NDArray[np.bool_]:
    """Flag points that a nearer object hides, robustly against small projection errors.

    A point is compared with the depth in the window that is nearest to the expected depth, among
    those in front of it. So a point beside an object is not hidden, only one well inside its
    outline is.

    Args:
        depth: float32 ``[H, W]`` metres, 0 missing.
        centre: int64 ``[N, 2]`` pixels (column, row) of the projected points, at least `radius`
            from the border.
        expected: float64 ``[N]`` depth at which the points should be seen, metres.
        tau: Least distance of all nearer depths in front of the point, metres.
        radius: Half side of the window, pixels.

    Returns:
        Bool ``[N]``; False also where the point's own pixel has no depth, or nothing in the window
        is nearer.
    """
    is_hidden = np.zeros(len(centre), np.bool_)
    for i in range(len(centre)):
        column, row = centre[i]
        if not depth[row, column] > 0:
            continue
        # something is nearer, and nothing that is nearer lies within tau of the point
        nearer = False
        all_far = True
        for y in range(row - radius, row + radius + 1):
            for x in range(column - radius, column + radius + 1):
                z = depth[y, x]
                if 0 < z < expected[i]:
                    nearer = True
                    if expected[i] - z <= tau:
                        all_far = False
                        break
            if not all_far:
                break
        is_hidden[i] = nearer and all_far
    return is_hidden


@kernel
def grow(
    depth: NDArray[np.float32], seeds: NDArray[np.int64], step: float, bin_m: float
) -> NDArray[np.uint8]:
    """Regions of similar depth around seeds: neighbours join while they are within `step` of the region's mean.

    Of all neighbours of a region the one nearest to its mean joins next (to `bin_m`), and the mean
    is updated. Pixels without depth never join. A seed within an earlier region starts no new
    region.

    Args:
        depth: float32 ``[H, W]`` metres, 0 missing, at most a few ten metres.
        seeds: int64 ``[N, 2]`` pixels (column, row).
        step: Largest distance to the mean, metres.
        bin_m: Resolution of the order, metres.

    Returns:
        uint8 ``[H, W]``, 1 in a region.
    """
    height, width = depth.shape
    mask = np.zeros((height, width), np.uint8)
    # number of the region that last touched the pixel
    visited = np.zeros(height * width, np.int32)
    # candidates by depth: a list of pixels for each bin, `head` its first and `following` the next
    following = np.empty(height * width, np.int64)
    bins = int(np.ceil(depth.max() / bin_m)) + 2
    head = np.full(bins, -1, np.int64)
    reach = int(np.ceil(step / bin_m)) + 1
    flat = depth.ravel()
    out = mask.ravel()
    for k in range(len(seeds)):
        # a region for each seed that has a depth and lies in no earlier region
        start = seeds[k, 1] * width + seeds[k, 0]
        if out[start] or not flat[start] > 0:
            continue

        # it begins with the seed alone, without candidates
        head[:] = -1
        mean = 0.0
        size = 0
        pixel = start
        visited[start] = k + 1
        while pixel >= 0:
            # the pixel joins, and its four neighbours become candidates
            out[pixel] = 1
            mean = (mean * size + flat[pixel]) / (size + 1)
            size += 1
            row = pixel // width
            column = pixel % width
            for side in range(4):
                r = row + (side == 0) - (side == 1)
                c = column + (side == 2) - (side == 3)
                if 0 <= r < height and 0 <= c < width:
                    other = r * width + c
                    if visited[other] != k + 1 and flat[other] > 0:
                        visited[other] = k + 1
                        b = int(flat[other] / bin_m)
                        following[other] = head[b]
                        head[b] = other

            # the candidate nearest to the mean is next, if it is near enough
            pixel = -1
            middle = int(mean / bin_m)
            for away in range(reach + 1):
                for b in (middle - away, middle + away):
                    if 0 <= b < bins and head[b] >= 0 and abs(flat[head[b]] - mean) < step:
                        pixel = head[b]
                        head[b] = following[pixel]
                        break
                if pixel >= 0:
                    break
    return mask


# DynaSLAM's low-cost tracking: a pose for the geometric test before the frame is really tracked.

MIN_MATCHES = 20
"""With fewer matches the search is repeated with twice the radius; after that the prediction is not refined."""
MAX_DISTANCE = 100
"""Largest Hamming distance of a match."""


def refine_by_matches(
    frame: FrameBundle, state: FilterState, radius_px: float = 15.0
) -> NDArray[np.float64] | None:
    """DynaSLAM's low-cost tracking: the predicted pose, refined on matches of features that earlier filters kept.

    The previous frame's features are projected under constant velocity and matched by descriptor
    within `radius_px`. The authors match the local map instead of the last frame.

    Args:
        frame: The current frame.
        state: With the previous frame, its pose and the predicted one.
        radius_px: Half side of the search windows (DynaSLAM: 15, doubled with too few matches).

    Returns:
        Camera-to-world pose ``[4, 4]``; the prediction itself (or None) where there are fewer than
        20 matches, or where an optical flow has refined it already.
    """
    previous = state.previous
    if (
        state.flow is not None
        or previous is None
        or state.T_world_prev is None
        or state.T_world_pred is None
    ):
        return state.T_world_pred
    # features of the previous frame with a depth, which its filters kept
    trusted = previous.z > 0
    if state.previous_keep is not None:
        trusted &= state.previous_keep
    rows = np.flatnonzero(trusted)
    if len(rows) < MIN_MATCHES or np.count_nonzero(state.keep) < MIN_MATCHES:
        return state.T_world_pred

    # where the previous frame's points are expected
    camera = state.camera
    xy = np.ascontiguousarray(frame.xy, dtype=np.float64)
    T_cur_prev = se3.inverse(state.T_world_pred) @ state.T_world_prev
    points = se3.transform(T_cur_prev, camera.unproject(previous.xy[rows], previous.z[rows]))
    rows = rows[points[:, 2] > MIN_DEPTH_M]
    points = points[points[:, 2] > MIN_DEPTH_M]
    expected = np.asarray(camera.project(points), dtype=np.float64)

    # match by descriptor around, in a wider window if few are found
    octave = frame.keypoints.octave.astype(np.int64)
    previous_octave = previous.keypoints.octave.astype(np.int64)
    grid = CellGrid.of(xy, camera.width, camera.height)
    descriptors = as_words(previous.keypoints.descriptors[rows])
    features = Features(
        xy, np.full(len(xy), np.nan), octave, as_words(frame.keypoints.descriptors), grid
    )
    for radius in (radius_px, 2 * radius_px):
        windows = expected, np.full(len(rows), np.nan), np.full(len(rows), radius)
        match = search_in_radius(
            features,
            state.keep,
            windows,
            previous_octave[rows],
            descriptors,
            max_distance=MAX_DISTANCE,
        )
        previous_matched = rows[match >= 0]
        current_matched = match[match >= 0]
        if len(current_matched) >= MIN_MATCHES:
            # refine the pose by the matches as if they were a flow
            ends = np.full((len(xy), 2), np.nan, np.float32)
            ends[current_matched] = previous.keypoints.xy[previous_matched]
            matches = FlowResult(ends, np.isfinite(ends[:, 0]), np.zeros(len(xy), np.float32))
            return refine_prediction(frame, replace(state, flow=matches))
    return state.T_world_pred
