"""B7: Dai et al. 2020: points that keep their mutual vectors over time belong together; the largest body is static."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, Delaunay, QhullError
from scipy.stats import chi2

from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera

from .baseline_settings import CorrelationSettings
from .ego_motion import depth_sigma
from .filter import DynamicFilter, FilterResult, FilterState, FrameBundle, Need, Provenance
from .links import link_to_previous

MIN_POINTS = 20
_NEAR = np.array([(dx, dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
_WEIGHT = np.array([1, 2, 1, 2, 4, 2, 1, 2, 1]) / 16


class CorrelationFilter(DynamicFilter):
    """Drops the points outside the largest rigid component of a Delaunay graph.

    An edge compares the vector between its two points now with the one `window` frames ago; it is cut where the
    Mahalanobis distance of the difference exceeds the chi-square quantile. Vectors are compared in the world frame
    under the predicted pose: only its rotation matters. Stats: ``dropped``, ``tracked``, ``edges``, ``cut``,
    ``components``.
    """

    name = "correlation"
    needs: frozenset[Need] = frozenset({"flow", "previous", "prediction", "depth"})
    provenance: Provenance = "faithful-paper"

    def __init__(self, settings: CorrelationSettings) -> None:
        self.settings = settings
        self.reset(None)

    def reset(self, camera: Camera | None) -> None:
        """Forget all tracks."""
        self._history: deque[NDArray[np.float64]] = deque()

    def apply(self, frame: FrameBundle, state: FilterState) -> FilterResult:
        """Build the graph over the points that were tracked for the whole window."""
        keep = np.ones(len(frame), dtype=bool)
        stats = dict.fromkeys(("tracked", "edges", "cut", "components"), 0.0)
        now = self._observe(frame, state)  # positions and their covariances
        link = link_to_previous(frame, state)
        if self._history and (state.previous is None or len(self._history[-1]) != len(state.previous)):
            self._history.clear()
        carried = deque(_follow(past, link) for past in self._history)
        self._history = carried
        self._history.append(now)
        while len(self._history) > self.settings.window + 1:
            self._history.popleft()
        then = self._history[0]
        rows = np.flatnonzero(np.isfinite(now).all(axis=1) & np.isfinite(then).all(axis=1))
        stats["tracked"] = float(len(rows))
        if len(self._history) < 2 or len(rows) < MIN_POINTS:
            return FilterResult.of(keep, stats)
        edges = _delaunay_edges(frame.xy[rows])
        change = _edge(now[rows], edges) - _edge(then[rows], edges)
        covariance = (now[rows, 3:] + then[rows, 3:]).reshape(-1, 3, 3)
        total = covariance[edges[:, 0]] + covariance[edges[:, 1]]
        distance = (change * np.linalg.solve(total, change[:, :, None])[:, :, 0]).sum(axis=1)
        whole = distance <= chi2.ppf(self.settings.quantile, 3)
        stats |= {"edges": float(len(edges)), "cut": float(np.count_nonzero(~whole))}
        kept, stats["components"] = self._static_component(edges[whole], now[rows, :3])
        keep[rows[~kept]] = False
        return FilterResult.of(keep, stats)

    def _observe(self, frame: FrameBundle, state: FilterState) -> NDArray[np.float64]:
        """World points and their covariances ``[N, 3 + 9]`` under the predicted pose; NaN without depth or pose."""
        pose = np.eye(4) if state.T_world_pred is None and state.previous is None else state.T_world_pred
        seen = np.full((len(frame), 12), np.nan)
        valid = frame.z > 0
        if pose is not None and valid.any():
            seen[valid, :3] = se3.transform(pose, state.camera.unproject(frame.xy[valid], frame.z[valid]))
            variance = depth_variance(frame.depth, frame.keypoints.xy[valid])
            local = point_covariance(frame.xy[valid], frame.z[valid], variance, state.camera, self.settings.pixel_sigma)
            seen[valid, 3:] = (pose[:3, :3] @ local @ pose[:3, :3].T).reshape(-1, 9)
        return seen

    def _static_component(
        self, edges: NDArray[np.intp], points: NDArray[np.float64]
    ) -> tuple[NDArray[np.bool_], float]:
        count = len(points)
        graph = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
        _, label = connected_components(graph, directed=False)
        size = np.bincount(label)
        if self.settings.largest == "count":
            measure = size.astype(np.float64)
        else:
            measure = np.array([_volume(points[label == body]) for body in range(len(size))])
        static = int(np.lexsort((size, measure))[-1])  # the one with more points where neither has a volume
        return np.asarray(label == static), float(len(size))


def _follow(past: NDArray[np.float64], link: NDArray[np.intp]) -> NDArray[np.float64]:
    carried = np.full((len(link), past.shape[1]), np.nan)
    carried[link >= 0] = past[link[link >= 0]]
    return carried


def _delaunay_edges(xy: NDArray[np.float64]) -> NDArray[np.intp]:
    """Unique undirected edges ``[E, 2]`` of the Delaunay triangulation of pixels ``[N, 2]``."""
    try:
        simplices = Delaunay(xy, qhull_options="QJ").simplices
    except QhullError:
        return np.zeros((0, 2), np.intp)
    pairs = np.sort(np.concatenate([simplices[:, [0, 1]], simplices[:, [1, 2]], simplices[:, [0, 2]]]), axis=1)
    return np.asarray(np.unique(pairs, axis=0), dtype=np.intp)


def _edge(points: NDArray[np.float64], edges: NDArray[np.intp]) -> NDArray[np.float64]:
    return points[edges[:, 0], :3] - points[edges[:, 1], :3]


def depth_variance(depth: NDArray[np.float32], xy: NDArray[np.floating]) -> NDArray[np.float64]:
    """Variance of the depth at raw pixels ``[N, 2]``, m^2: a Gaussian mixture over the 3x3 neighbourhood.

    The mixture's weights are [1 2 1; 2 4 2; 1 2 1] / 16 over the pixels that have depth, its components' variances
    those of the sensor; depth edges get a large variance by it.
    """
    height, width = depth.shape
    column, row = np.rint(xy).astype(np.intp).T
    columns = (column[:, None] + _NEAR[:, 0]).clip(0, width - 1)
    rows = (row[:, None] + _NEAR[:, 1]).clip(0, height - 1)
    z = np.nan_to_num(depth[rows, columns].astype(np.float64), posinf=0.0, neginf=0.0)
    weight = np.where(z > 0, _WEIGHT, 0.0)
    weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
    mean = (weight * z).sum(axis=1)
    return np.asarray((weight * (np.square(depth_sigma(z)) + np.square(z - mean[:, None]))).sum(axis=1))


def point_covariance(
    xy: NDArray[np.float64], z: NDArray[np.floating], variance: NDArray[np.float64], camera: Camera, pixel_sigma: float
) -> NDArray[np.float64]:
    """Covariances ``[N, 3, 3]`` of unprojected points in the camera frame, m^2.

    Args:
        xy: Undistorted pixels ``[N, 2]``.
        z: Depths ``[N]``, metres.
        variance: Variances of the depths ``[N]``, m^2.
        camera: Intrinsics.
        pixel_sigma: Standard deviation of a pixel coordinate.
    """
    depth = np.asarray(z, dtype=np.float64)
    jacobian = np.zeros((len(depth), 3, 3))
    jacobian[:, 0, 0], jacobian[:, 1, 1] = depth / camera.fx, depth / camera.fy
    jacobian[:, 0, 2], jacobian[:, 1, 2] = ((xy - (camera.cx, camera.cy)) / (camera.fx, camera.fy)).T
    jacobian[:, 2, 2] = 1.0
    noise = np.column_stack([np.full((len(depth), 2), pixel_sigma**2), np.maximum(variance, 1e-12)])
    return np.asarray((jacobian * noise[:, None]) @ jacobian.transpose(0, 2, 1))


def _volume(points: NDArray[np.float64]) -> float:
    if len(points) < 4:
        return 0.0
    try:
        return float(ConvexHull(points, qhull_options="QJ").volume)
    except QhullError:
        return 0.0
