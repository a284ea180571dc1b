"""B7: Dai et al. 2020: a Delaunay graph of point correlations, of which the largest rigid component is static."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, Delaunay, QhullError
from scipy.stats import chi2

from dynslam_bench.contracts import FilterResult, FilterState, FrameBundle, Need
from dynslam_bench.culling import BaseFilter
from dynslam_bench.culling.ego_motion import PATCH_3X3, depth_sigma
from dynslam_bench.culling.moving_probability import link_to_previous
from dynslam_bench.culling.settings import CorrelationSettings
from dynslam_bench.geometry import Camera, pixel_index, se3

Numbers = NDArray[np.floating]

MIN_POINTS = 20
"""Points without which no component counts as static."""
MIXTURE_WEIGHTS = np.array([1, 2, 1, 2, 4, 2, 1, 2, 1]) / 16
"""Weights of the 3x3 pixels around a point in the mixture of `depth_variance`."""


class CorrelationFilter(BaseFilter[CorrelationSettings]):
    """Drops the points outside the largest rigid component of a Delaunay graph.

    An edge compares the vector between its two points now with that in the oldest frame, at most
    `window` frames ago, in which both were observed. It is cut where the Mahalanobis distance of
    the difference exceeds the chi-square quantile. Vectors are compared in the world frame: only
    the rotations of the poses matter.

    Components are formed by settled points only, those observed over at least `settled` frames: a
    younger edge shows too little motion and could connect two bodies. A younger point is static if
    it agrees with at least as many of its settled neighbours as it contradicts. A point that
    continues a keypoint of the last frame takes over its observations; any other point was at the
    end of its flow, at the depth that the last frame has there.

    Stats: ``dropped``, ``tracked`` (points judged), ``settled``, ``edges``, ``cut``, ``components``
    (of the settled).
    """

    name = "correlation"
    needs: frozenset[Need] = frozenset({"flow", "previous", "prediction", "depth"})
    stats_names = ("dropped", "tracked", "settled", "edges", "cut", "components")

    def reset(self, camera: Camera | None = None) -> None:
        """Forget all tracks."""
        # [frames ago - 1, point of the previous frame, position and covariance]
        self._past = np.zeros((0, 0, 12))
        # the previous frame's points in its camera
        self._last = np.zeros((0, 12))

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Build the graph over the points that have been observed before."""
        # points of this frame, and where they were in earlier ones
        keep = np.ones(len(frame.xy), dtype=bool)
        local = self._observe(frame.xy, frame.keypoints.xy, frame.z, frame.depth, state.camera)
        past = self._past_observations(frame, state)
        self._past = past
        self._last = local
        if state.T_world_pred is None or not len(past):
            return self.verdict(keep)

        # points that were observed before; those observed long enough are settled
        current = _in_world(local, state.T_world_pred)
        observed = np.asarray(np.isfinite(past).all(axis=2) & np.isfinite(current).all(axis=1))
        rows = np.flatnonzero(observed.any(axis=0))
        if len(rows) < MIN_POINTS:
            return self.verdict(keep)
        age = len(past) - observed[::-1, rows].argmax(axis=0)
        settled = age >= min(self.settings.settled, len(past))
        current = current[rows]
        past = past[:, rows]
        observed = observed[:, rows]
        xy = frame.xy[rows]
        old = np.flatnonzero(settled)
        if len(old) < MIN_POINTS:
            return self.verdict(keep, tracked=len(rows), settled=len(old))

        # the largest component of the settled points is static
        is_static = np.ones(len(rows), dtype=bool)
        edges = _delaunay_edges(xy[old])
        uncut = self._agree(current[old], past[:, old], observed[:, old], edges)
        is_static[old], components = self._static_component(edges[uncut], current[old, :3])
        total = len(edges)
        cut = np.count_nonzero(~uncut)

        # younger points follow their settled neighbours
        if len(old) < len(rows):
            edges = _delaunay_edges(xy)
            edges = edges[settled[edges].sum(axis=1) == 1]
            # the younger point first
            edges = np.where(settled[edges[:, :1]], edges[:, ::-1], edges)
            uncut = self._agree(current, past, observed, edges)
            total = total + len(edges)
            cut = cut + np.count_nonzero(~uncut)
            # a static neighbour votes for or against, a moving one that agrees votes against
            by_static = np.where(uncut, 1, -1)
            by_moving = np.where(uncut, -1, 0)
            vote = np.where(is_static[edges[:, 1]], by_static, by_moving)
            is_static[~settled] = np.bincount(edges[:, 0], vote, len(rows))[~settled] >= 0
        keep[rows[~is_static]] = False
        return self.verdict(
            keep, tracked=len(rows), settled=len(old), edges=total, cut=cut, components=components
        )

    def _past_observations(self, frame: FrameBundle, state: FilterState) -> NDArray[np.float64]:
        """This frame's points as earlier frames saw them: world position and covariance ``[K, N, 3 + 9]``.

        Newest frame first; NaN where a point was not observed.
        """
        previous = state.previous
        pose = state.T_world_prev
        flow = state.flow
        if previous is None or pose is None or flow is None or len(self._last) != len(previous.xy):
            return np.zeros((0, len(frame.xy), 12))

        # a point that continues a keypoint of the last frame takes over its track: `_last` in camera axes,
        # `_past` in the world
        link = link_to_previous(frame, state)
        last = _in_world(self._last, pose)
        of_keypoints = np.concatenate([last[None], self._past])[: self.settings.window]
        past = np.full((len(of_keypoints), len(frame.xy), 12), np.nan)
        past[:, link >= 0] = of_keypoints[:, link[link >= 0]]

        # any other has one observation: its flow leads back to a pixel of the last frame,
        # where that frame's depth image gives the depth
        unlinked = np.flatnonzero((link < 0) & flow.valid & np.isfinite(flow.xy).all(axis=1))
        raw = flow.xy[unlinked]
        pixels, visible = pixel_index(raw, previous.depth.shape)
        z = np.where(visible, previous.depth[pixels], 0)
        observations = self._observe(
            state.camera.undistort_points(raw), raw, z, previous.depth, state.camera
        )
        past[0, unlinked] = _in_world(observations, pose)
        return past

    def _observe(
        self, xy: Numbers, raw: Numbers, z: Numbers, depth: NDArray[np.float32], camera: Camera
    ) -> NDArray[np.float64]:
        """Points of the camera frame and their covariances ``[N, 3 + 9]``; NaN without depth.

        Args:
            xy: Undistorted pixels ``[N, 2]``.
            raw: Raw pixels ``[N, 2]``, as the lens distorts them.
            z: Depths there ``[N]``, metres, 0 or NaN missing.
            depth: The whole depth image ``[H, W]``, whose scatter around each pixel gives the
                variance.
            camera: Intrinsics.
        """
        points = np.full((len(xy), 12), np.nan)
        valid = np.isfinite(z) & (z > 0)
        pixels = np.asarray(xy[valid], np.float64)
        z = z[valid]
        variance = depth_variance(depth, raw[valid])
        covariance = point_covariance(pixels, z, variance, camera, self.settings.pixel_sigma)
        points[valid] = np.column_stack([camera.unproject(pixels, z), covariance.reshape(-1, 9)])
        return points

    def _agree(
        self,
        current: NDArray[np.float64],
        past: NDArray[np.float64],
        observed: NDArray[np.bool_],
        edges: NDArray[np.intp],
    ) -> NDArray[np.bool_]:
        """Flags ``[E]`` of edges that keep their vector since the oldest frame in which both ends were observed.

        Args:
            current: World positions and covariances ``[N, 3 + 9]`` of this frame's points.
            past: World positions and covariances of the same points in the K frames before, newest
                first, ``[K, N, 3 + 9]``; NaN unobserved.
            observed: bool ``[K, N]``, in which of these each point was observed.
            edges: Pairs of points ``[E, 2]``.
        """
        both = observed[:, edges[:, 0]] & observed[:, edges[:, 1]]
        oldest = len(past) - 1 - both[::-1].argmax(axis=0)
        first, second = edges.T

        # change of the vector, and the sum of the four points' covariances
        first_then = past[oldest, first]
        second_then = past[oldest, second]
        change = current[first, :3] - current[second, :3] - first_then[:, :3] + second_then[:, :3]
        total = current[first, 3:] + current[second, 3:] + first_then[:, 3:] + second_then[:, 3:]
        covariance = total.reshape(-1, 3, 3)

        # squared Mahalanobis distance d^T C^-1 d; edges that cannot be compared are not cut
        comparable = both.any(axis=0)
        solved = np.linalg.solve(covariance[comparable], change[comparable, :, None])[:, :, 0]
        squared_distance = (change[comparable] * solved).sum(axis=1)
        cut = np.zeros(len(edges), bool)
        cut[comparable] = squared_distance > chi2.ppf(self.settings.quantile, 3)
        return ~cut

    def _static_component(
        self, edges: NDArray[np.intp], points: NDArray[np.float64]
    ) -> tuple[NDArray[np.bool_], int]:
        """Flags ``[N]`` of points in the largest component of the edges ``[E, 2]``, and the number of components."""
        graph = coo_matrix((np.ones(len(edges)), tuple(edges.T)), shape=(len(points), len(points)))
        _, label = connected_components(graph, directed=False)
        size = np.bincount(label)
        measure = size.astype(np.float64)
        if self.settings.largest == "volume":
            measure = np.array([_volume(points[label == body]) for body in range(len(size))])
        # with equal volumes the one with more points
        largest = int(np.lexsort((size, measure))[-1])
        return np.asarray(label == largest), len(size)


def _in_world(local: NDArray[np.float64], T_world_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points and covariances ``[N, 3 + 9]`` in the world, from those in a camera frame."""
    R = T_world_cam[:3, :3]
    covariance = R @ local[:, 3:].reshape(-1, 3, 3) @ R.T
    return np.column_stack([se3.transform(T_world_cam, local[:, :3]), covariance.reshape(-1, 9)])


def _delaunay_edges(xy: NDArray[np.float64]) -> NDArray[np.intp]:
    """Unique undirected edges ``[E, 2]`` of the Delaunay triangulation of pixels ``[N, 2]``."""
    try:
        simplices = Delaunay(xy, qhull_options="QJ").simplices
    except QhullError:
        return np.zeros((0, 2), np.intp)
    sides = [simplices[:, [0, 1]], simplices[:, [1, 2]], simplices[:, [0, 2]]]
    pairs = np.sort(np.concatenate(sides), axis=1)
    return np.asarray(np.unique(pairs, axis=0), dtype=np.intp)


def depth_variance(depth: NDArray[np.float32], xy: NDArray[np.floating]) -> NDArray[np.float64]:
    """Variance of the depth at pixels: that of a Gaussian mixture over the 3x3 neighbourhood.

    The mixture's weights are [1 2 1; 2 4 2; 1 2 1] / 16 over the pixels that have depth, its
    components' variances those of the sensor. Depth edges thus get a large variance, and with it the
    covariance of the unprojected point (`point_covariance`).

    Args:
        depth: Metres ``[H, W]``; 0 or nan where there is none.
        xy: Raw pixels ``[N, 2]`` that have depth.

    Returns:
        Square metres ``[N]``.
    """
    at, _ = pixel_index(np.rint(xy)[:, None] + PATCH_3X3, depth.shape)
    z = np.nan_to_num(depth[at].astype(np.float64), posinf=0.0, neginf=0.0)
    weight = np.where(z > 0, MIXTURE_WEIGHTS, 0.0)
    weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
    mean = (weight * z).sum(axis=1)
    # variance within each component and between them
    variance = np.square(depth_sigma(z)) + np.square(z - mean[:, None])
    return np.asarray((weight * variance).sum(axis=1))


def point_covariance(
    xy: NDArray[np.float64],
    z: NDArray[np.floating],
    variance: NDArray[np.float64],
    camera: Camera,
    pixel_sigma: float,
) -> NDArray[np.float64]:
    """Covariances ``[N, 3, 3]`` of unprojected points in the camera frame, m^2.

    Args:
        xy: Undistorted pixels ``[N, 2]``.
        z: Depths ``[N]``, metres.
        variance: Variances of the depths ``[N]``, m^2.
        camera: Intrinsics.
        pixel_sigma: Standard deviation of a pixel coordinate.
    """
    # derivative of the point by (u, v, z)
    depth = np.asarray(z, dtype=np.float64)
    jacobian = np.zeros((len(depth), 3, 3))
    jacobian[:, 0, 0] = depth / camera.fx
    jacobian[:, 1, 1] = depth / camera.fy
    jacobian[:, :2, 2] = (xy - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    jacobian[:, 2, 2] = 1.0
    noise = np.column_stack([np.full((len(depth), 2), pixel_sigma**2), np.maximum(variance, 1e-12)])
    return np.asarray((jacobian * noise[:, None]) @ jacobian.transpose(0, 2, 1))


def _volume(points: NDArray[np.float64]) -> float:
    """Volume of the convex hull of points ``[N, 3]``; 0 of too few."""
    try:
        return float(ConvexHull(points, qhull_options="QJ").volume)
    except QhullError:
        return 0.0
