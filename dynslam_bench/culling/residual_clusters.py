"""B14: image clusters with a high warped residual move, with a higher prior for people (DGS-SLAM of Yan 2022)."""

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import FilterResult, FilterState, FrameBundle, Need
from dynslam_bench.core.seeding import stream
from dynslam_bench.culling import ObjectFilter
from dynslam_bench.culling.settings import ResidualSettings
from dynslam_bench.geometry import at_width, inside, pixel_index, se3
from dynslam_bench.segmentation.postprocess import select

STEP = 8
"""Distance of the samples along both axes, at an image width of 640."""
CLUSTER_PX = 160.0
"""Distance in the image, at a width of 640, that counts as much as `CLUSTER_M` in depth."""
CLUSTER_M = 0.5
"""Difference in depth that counts as much as `CLUSTER_PX` in the image, metres."""
MIN_DEPTH_M = 0.1
"""Points nearer than this to the previous camera plane have no residual; depth errors are relative to this at least."""
RATIO = 4.0
"""A moving cluster's residual is expected to be this many times the static ones'."""
STATIC_PRIOR = 0.05
"""Prior probability that a cluster without people moves."""


class ResidualFilter(ObjectFilter[ResidualSettings]):
    """Drops the features on clusters that the camera's motion does not explain.

    The residual of a sample is ``|I - I'| / 255 + weight |Z - Z'| / Z`` after warping by the
    predicted motion; a cluster's mean residual is judged by a two-component exponential mixture
    with a semantic prior. Stats: ``dropped``, ``clusters``, ``moving``, ``mask_fraction``.
    """

    name = "residual"
    needs: frozenset[Need] = frozenset({"depth", "previous", "prediction", "masks"})
    stats_names = ("dropped", "clusters", "moving", "mask_fraction")

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Cluster the image, warp it, classify the clusters."""
        # the first frame, and a lost camera, have nothing to compare with
        keep = np.ones(len(frame.xy), dtype=bool)
        if state.previous is None or state.T_world_prev is None or state.T_world_pred is None:
            return self.verdict(keep)

        # sample the image where it has depth
        height, width = frame.depth.shape
        step = max(1, round(at_width(STEP, width)))
        rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
        z = np.nan_to_num(frame.depth[rows, columns]).ravel()
        valid = z > 0
        if np.count_nonzero(valid) < 4 * self.settings.clusters:
            return self.verdict(keep)
        xy = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)[valid]

        # residuals after warping, clusters in the image and in depth, and which of them move
        residual = self._residual(frame, state, xy, z[valid])
        label = self._cluster(xy / at_width(CLUSTER_PX, width), z[valid], state.seed)
        people = np.zeros(len(xy), bool)
        if frame.instances is not None:
            people = inside(select(frame.instances, self.segmentation).union(), xy)
        moving = self._moving_clusters(residual, label, people)

        # the moving clusters as a mask of the whole image
        sampled = np.zeros(rows.size, dtype=np.uint8)
        sampled[valid] = moving[label]
        resized = cv2.resize(
            sampled.reshape(rows.shape), (width, height), interpolation=cv2.INTER_NEAREST
        )
        mask = resized.astype(bool)
        keep = ~inside(mask, frame.keypoints.xy)
        moves = np.count_nonzero(moving)
        return self.verdict(
            keep, mask, clusters=len(moving), moving=moves, mask_fraction=float(mask.mean())
        )

    def _residual(
        self,
        frame: FrameBundle,
        state: FilterState,
        xy: NDArray[np.float64],
        z: NDArray[np.floating],
    ) -> NDArray[np.float64]:
        """Residuals ``[N]`` of raw pixels ``[N, 2]`` against the previous frame; NaN where they leave it.

        Args:
            frame: The current frame.
            state: With the previous frame, its pose and the predicted one.
            xy: Raw pixels of the samples.
            z: Their depths ``[N]``, metres.
        """
        assert state.previous is not None
        assert state.T_world_prev is not None
        assert state.T_world_pred is not None

        # the samples in the previous image, as the predicted motion takes them there
        camera = state.camera
        T_prev_cur = se3.inverse(state.T_world_prev) @ state.T_world_pred
        points = se3.transform(T_prev_cur, camera.unproject(camera.undistort_points(xy), z))
        pixels = camera.distort_points(camera.project(points))
        warped, visible = pixel_index(pixels, frame.gray.shape)

        # difference in grey levels and in depth
        x, y = xy.astype(np.intp).T
        gray = frame.gray[y, x].astype(np.float64)
        gray_residual = np.abs(gray - state.previous.gray[warped]) / 255
        previous_z = np.nan_to_num(state.previous.depth[warped])
        relative = np.abs(points[:, 2] - previous_z) / np.maximum(z, MIN_DEPTH_M)
        depth_residual = np.where(previous_z > 0, relative, 0.0)
        return np.where(
            visible & (points[:, 2] > MIN_DEPTH_M),
            gray_residual + self.settings.depth_weight * depth_residual,
            np.nan,
        )

    def _cluster(
        self, places: NDArray[np.float64], z: NDArray[np.floating], seed: int
    ) -> NDArray[np.intp]:
        """Cluster ``[N]`` of each sample by k-means over places ``[N, 2]`` and depth ``[N]``, from random centres.

        Places are in units of `CLUSTER_PX`.
        """
        # place and depth in comparable units
        features = np.column_stack([places, np.asarray(z) / CLUSTER_M]).astype(np.float32)
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 6, 0.05)
        # each sample begins with the nearest of the random centres
        centres = stream(seed, self.name).choice(
            len(features), self.settings.clusters, replace=False
        )
        distance = ((features[:, None] - features[None, centres]) ** 2).sum(axis=2)
        start = distance.argmin(axis=1).astype(np.int32)[:, None]
        _, label, _ = cv2.kmeans(
            features, self.settings.clusters, start, criteria, 1, cv2.KMEANS_USE_INITIAL_LABELS
        )
        return np.asarray(label.ravel(), dtype=np.intp)

    def _moving_clusters(
        self, residual: NDArray[np.float64], label: NDArray[np.intp], people: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Flags ``[K]`` of moving clusters: posterior of the two-component mixture above the threshold."""
        # without any residual nothing is known to move
        count = self.settings.clusters
        measured = np.isfinite(residual)
        if not measured.any():
            return np.zeros(count, dtype=bool)

        # mean residual of each cluster; that of most clusters is the static ones'
        members = np.bincount(label[measured], minlength=count)
        total = np.bincount(label[measured], weights=residual[measured], minlength=count)
        mean = total / np.maximum(members, 1)
        static_mean = max(float(np.median(mean[members > 0])), 1e-4)

        # prior by the share of the cluster that lies on people
        on_people = np.bincount(label, weights=people, minlength=count)
        share = on_people / np.maximum(np.bincount(label, minlength=count), 1)
        prior = STATIC_PRIOR + (self.settings.prior - STATIC_PRIOR) * share

        # exponential residuals, with a larger mean where the cluster moves
        likelihood = np.exp(-mean / (RATIO * static_mean)) / RATIO
        posterior = (
            prior * likelihood / (prior * likelihood + (1 - prior) * np.exp(-mean / static_mean))
        )
        return np.asarray((posterior > self.settings.threshold) & (members > 0))
