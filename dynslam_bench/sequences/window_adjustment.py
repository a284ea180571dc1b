"""Bundle adjustment of a window of frames whose camera moves continuously: every row and depth image has its own time.

The camera's pose between frames is interpolated by a polynomial in time. Readout time and the delay
of the depth images are unknowns that the windows share; each window gives its normal equations for
them, with its points and poses eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, permutations, product

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dynslam_bench.geometry import Array, Camera, se3
from dynslam_bench.sequences.rgbd_motion import follow_corners

POINTS = 110
"""So many corners are followed at a time."""
LEAST_POINTS = 15
"""Points that a window needs."""
LARGEST_NOISE_PX = 3.0
"""Before the rolling shutter is taken into account, which costs up to a pixel."""
STENCIL = 5
"""Poses that a pose between frames is interpolated from (a quartic in time)."""
CAUCHY = 2.5
"""Scale of the robust kernel in standard deviations."""
_DIFFERENCE_S = 0.004
"""Step of the depths' numeric derivative by the delay."""
_NEAREST_M = 1e-3
"""Smaller depths are taken as this one, so that their inverse is finite."""
_MOVING_PX = 6.0
"""A point with a larger error under the motion between two frames moves by itself."""
_BORDER_PX = 8
"""Corners that come nearer to the image's border are lost."""


def track(images: list[NDArray[np.uint8]], allowed: list[NDArray[np.uint8]]) -> Array:
    """Corners followed from image to image by Lucas and Kanade, pixels ``[L, n, 2]``; NaN where they are not seen.

    A corner that is tracked back more than half a pixel off is lost. New ones are detected where
    few are left and `allowed` is not 0.
    """
    n = len(images)
    height, width = images[0].shape
    tracks = np.full((0, n, 2), np.nan)
    for i in range(n - 1):
        # detect new corners where few are left.
        alive = np.isfinite(tracks[:, i, 0])
        if alive.sum() < POINTS and i < n - 3:
            fresh = corners(images[i], allowed[i], tracks[alive, i], POINTS - int(alive.sum()))
            tracks = np.pad(tracks, ((0, len(fresh)), (0, 0), (0, 0)), constant_values=np.nan)
            tracks[len(alive) :, i] = fresh
            alive = np.isfinite(tracks[:, i, 0])
        pixels = tracks[alive, i].astype(np.float32)
        if not len(pixels):
            continue

        # each corner is looked for where its last motion leads; new ones by the median motion.
        flow = pixels - tracks[alive, i - 1] if i else np.full(pixels.shape, np.nan)
        has_flow = np.isfinite(flow[:, 0])
        flow[~has_flow] = np.median(flow[has_flow], axis=0) if has_flow.any() else 0.0
        guess = (pixels + flow).astype(np.float32)
        next_pixels, good = follow_corners(images[i], images[i + 1], pixels, guess, 0.5)
        good &= (next_pixels >= _BORDER_PX).all(axis=1)
        good &= (next_pixels < (width - _BORDER_PX, height - _BORDER_PX)).all(axis=1)
        tracks[np.flatnonzero(alive)[good], i + 1] = next_pixels[good]

    # corners that were seen in four images at least
    long = np.isfinite(tracks[..., 0]).sum(axis=1) >= 4
    return np.asarray(tracks[long])


def corners(
    image: NDArray[np.uint8], allowed: NDArray[np.uint8], taken: Array, count: int
) -> NDArray[np.float32]:
    """Corners ``[N, 2]`` spread over the cells of a grid, away from those that there are."""
    # not within 12 pixels of those that there are
    height, width = image.shape
    free = allowed.copy()
    for x, y in taken:
        cv2.circle(free, (int(x), int(y)), 12, 0, -1)

    # the best of each cell, 4 rows by 5 columns
    rows = np.linspace(0, height, 5).astype(int).tolist()
    columns = np.linspace(0, width, 6).astype(int).tolist()
    pixels = [np.zeros((0, 2), np.float32)]
    cells = list(product(pairwise(rows), pairwise(columns)))
    per_cell = int(np.ceil(1.5 * count / len(cells)))
    for (top, bottom), (left, right) in cells:
        cell = np.s_[top:bottom, left:right]
        in_cell = cv2.goodFeaturesToTrack(image[cell], per_cell, 0.02, 12, mask=free[cell])
        if in_cell is not None:
            pixels.append(np.asarray(in_cell.reshape(-1, 2) + np.array([left, top]), np.float32))
    return np.concatenate(pixels)


def inverse_depth(depth: NDArray[np.float32], pixels: Array) -> Array:
    """Mean inverse depth ``[N]`` of the 5x5 pixels around `pixels` ``[N, 2]``; NaN at edges, holes and outside."""
    height, width = depth.shape
    place: Array = np.asarray(np.round(pixels))
    above_least = (place >= 2).all(axis=1)
    below_most = (place < (width - 2, height - 2)).all(axis=1)
    inside = np.asarray(np.isfinite(place).all(axis=1) & above_least & below_most)

    # the 5x5 pixels around each place, flat ``[N, 25]``.
    u, v = np.where(inside[:, None], place, 2).astype(np.intp).T
    around = np.arange(-2, 3)
    rows = v[:, None, None] + around[:, None]
    columns = u[:, None, None] + around
    patch = depth[rows, columns].reshape(len(u), 25).astype(np.float64)

    # mean and range of the measured ones
    measured = patch > 0
    inverse = 1 / np.where(measured, patch, 1.0)
    count = measured.sum(axis=1)
    mean = (inverse * measured).sum(axis=1) / np.maximum(count, 1)
    largest = np.where(measured, inverse, -np.inf).max(axis=1)
    smallest = np.where(measured, inverse, np.inf).min(axis=1)

    # a hole has fewer measurements, an edge has a wide spread.
    valid = inside & (count >= 20) & (largest - smallest < 0.12 * mean)
    return np.where(valid, mean, np.nan)


class Unusable(Exception):
    """A window that cannot be used, and why."""


class Window:
    """Keypoints tracked through consecutive frames, and the state of their bundle adjustment.

    L points, n frames; what was not observed is NaN. The world is the camera of the middle frame.

    Args:
        camera: Intrinsics; distorted pixels are those of its images.
        stamps: ``[n]`` seconds, when the middle row of each colour image was exposed.
        pixels: ``[L, n, 2]`` tracked pixels of the colour images, as they are (distorted).
        depth: ``[n, H, W]`` depth images in metres, 0 = missing.
        offsets: ``[n]`` seconds by which the depth images' stamps are later than the colour
            images'.

    Raises:
        Unusable: Too few points have depth, or do not move as one rigid body.
    """

    def __init__(
        self,
        camera: Camera,
        stamps: Array,
        pixels: Array,
        depth: NDArray[np.float32],
        offsets: Array,
    ) -> None:
        self.camera = camera
        self.depth = depth
        self.offsets = offsets
        self.raw = pixels
        self.start = float(stamps[0])
        self.stamps = stamps - stamps[len(stamps) // 2]
        self.xy = camera.undistort_points(pixels).reshape(pixels.shape)
        observed = [inverse_depth(image, pixels[:, i]) for i, image in enumerate(depth)]
        self.inverse_depth = np.stack(observed, axis=1)

        # initial poses by PnP from frame to frame; initial points by the median over the frames.
        self.R, self.centre = self._chain_poses()
        with np.errstate(divide="ignore", invalid="ignore"):
            points = camera.unproject(self.xy, 1 / self.inverse_depth)
        world = np.einsum("nji,lnj->lni", self.R, points) + self.centre
        deep = np.isfinite(world[..., 0])
        keep = (np.isfinite(self.xy[..., 0]).sum(1) >= 4) & (deep.sum(1) >= 2)
        if keep.sum() < LEAST_POINTS:
            raise Unusable("too few points with depth can be followed")
        self.raw = self.raw[keep]
        self.xy = self.xy[keep]
        self.inverse_depth = self.inverse_depth[keep]
        self.points = np.nanmedian(world[keep], axis=1)

        # slope of the inverse depths by the delay, and each pixel's row as a share of the readout.
        self.depth_drift = np.zeros(self.raw.shape[:2])
        self.late = np.nan_to_num((self.raw[..., 1] + 0.5) / camera.height - 0.5)

        # adjustment with a global shutter and no delay.
        self.noise = 1.0, 0.01
        self.measure_noise(0.0)
        for _ in range(4):
            self.update(*self.normal_equations(0.0).steps(np.zeros(2)))
        self.measure_noise(0.0)
        if not self.noise[0] < LARGEST_NOISE_PX:
            raise Unusable(f"the points fit one rigid scene to {self.noise[0]:.1f} px only")

    def _chain_poses(self) -> tuple[Array, Array]:
        """Rotations world to camera ``[n, 3, 3]`` and centres ``[n, 3]``, frame by frame by PnP; drops what moves."""
        T_cam_first = [np.eye(4)]
        for i in range(len(self.stamps) - 1):
            T_cam_first.append(self._step_by_pnp(i) @ T_cam_first[-1])

        # the world is the middle frame's camera.
        middle = len(T_cam_first) // 2
        T_cam_world = np.array(T_cam_first) @ np.linalg.inv(T_cam_first[middle])
        R = T_cam_world[:, :3, :3]
        return R, -np.einsum("nji,nj->ni", R, T_cam_world[:, :3, 3])

    def _step_by_pnp(self, i: int) -> Array:
        """Pose ``[4, 4]`` of frame `i`'s camera in the next one's, by PnP; drops the points that do not follow it."""
        # points with depth in this frame that were followed to the next one
        usable = np.isfinite(self.inverse_depth[:, i]) & np.isfinite(self.xy[:, i + 1, 0])
        if usable.sum() < LEAST_POINTS:
            raise Unusable("too few points with depth can be followed")

        # PnP with RANSAC, refined on its inliers
        matrix = self.camera.matrix
        points = self.camera.unproject(self.xy[usable, i], 1 / self.inverse_depth[usable, i])
        pixels = self.xy[usable, i + 1]
        success, turn, shift, inliers = cv2.solvePnPRansac(
            points,
            pixels,
            matrix,
            None,
            iterationsCount=200,
            reprojectionError=3.0,
            flags=cv2.SOLVEPNP_EPNP,
        )
        enough = max(LEAST_POINTS // 2, 0.4 * len(points))
        if not success or inliers is None or len(inliers) < enough:
            raise Unusable("the points do not move as one rigid scene")
        chosen = inliers[:, 0]
        turn, shift = cv2.solvePnPRefineLM(
            points[chosen], pixels[chosen], matrix, None, turn, shift
        )
        step = se3.from_matrix(shift[:, 0], cv2.Rodrigues(turn)[0])

        # points that move otherwise are not followed any further
        predicted = self.camera.project(points @ step[:3, :3].T + step[:3, 3])
        error = np.linalg.norm(predicted - pixels, axis=1)
        moving = np.flatnonzero(usable)[~(error < _MOVING_PX)]
        self.xy[moving, i + 1 :] = np.nan
        self.inverse_depth[moving, i + 1 :] = np.nan
        return step

    def _at(self, offset: Array) -> _InterpolatedPoses:
        """The camera at times `offset` ``[L, n]`` seconds after the frames' stamps."""
        n = len(self.stamps)
        times = self.stamps + offset

        # the frame nearest to each time, and the `STENCIL` frames around every frame.
        nearest = np.searchsorted((self.stamps[1:] + self.stamps[:-1]) / 2, times)
        first = np.clip(np.arange(n) - STENCIL // 2, 0, n - STENCIL)
        nodes = first[:, None] + np.arange(STENCIL)

        # interpolate rotation vectors from the nearest frame, and centres, as polynomials in time.
        spread = self.stamps[nodes] - self.stamps[:, None]
        turns = _rotation_vectors(self.R[nodes] @ np.swapaxes(self.R, 1, 2)[:, None])
        weights, slopes = _lagrange(spread[nearest], times - self.stamps[nearest])
        turn = turns[nearest]
        centres = self.centre[nodes][nearest]

        # half an interval beyond the first and the last frame the poses are known
        first_time = 1.5 * self.stamps[0] - 0.5 * self.stamps[1]
        last_time = 1.5 * self.stamps[-1] - 0.5 * self.stamps[-2]
        return _InterpolatedPoses(
            R=_matrices((weights[..., None, :] @ turn)[..., 0, :]) @ self.R[nearest],
            centre=(weights[..., None, :] @ centres)[..., 0, :],
            angular_velocity=(slopes[..., None, :] @ turn)[..., 0, :],
            velocity=(slopes[..., None, :] @ centres)[..., 0, :],
            weights=weights,
            nodes=nodes[nearest],
            within=(times > first_time) & (times < last_time),
        )

    def _in_camera(self, poses: _InterpolatedPoses) -> Array:
        """The points ``[L, n, 3]`` in the camera at interpolated poses."""
        return np.asarray((poses.R @ (self.points[:, None] - poses.centre)[..., None])[..., 0])

    def _residuals(self, points: Array) -> Array:
        """Pixels and inverse depth ``[L, n, 3]``: predicted less observed."""
        camera = self.camera
        inverse = 1 / np.maximum(points[..., 2:], _NEAREST_M)
        pixels = points[..., :2] * inverse * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        return np.concatenate([pixels - self.xy, inverse - self.inverse_depth[..., None]], axis=-1)

    def measure_noise(self, readout_s: float) -> None:
        """Take the noise of pixels and of inverse depth from the median residuals."""
        residuals = self._residuals(self._in_camera(self._at(self.late * readout_s)))
        error = np.hypot(residuals[..., 0], residuals[..., 1])
        depth = np.abs(residuals[..., 2])
        valid = np.isfinite(error)
        deep = np.isfinite(depth)
        if valid.any() and deep.any():
            # 1.177: median length of a normal vector in the plane; 1.4826: of the median deviation
            self.noise = (
                max(np.median(error[valid]) / 1.177, 0.05),
                max(1.4826 * np.median(depth[deep]), 1e-6),
            )

    def turning_change(self) -> float:
        """Root mean square change of the turning rate within the window, rad/s."""
        turns = _rotation_vectors(self.R[1:] @ np.swapaxes(self.R[:-1], 1, 2))
        rates = turns / np.diff(self.stamps)[:, None]
        return float(np.sqrt(((rates - rates.mean(0)) ** 2).sum(1).mean()))

    def move_depth(self, readout_s: float, delay_s: float) -> None:
        """Carry each depth from its image's time to its pixel's, with the motion as estimated so far.

        Args:
            readout_s: Readout time; the depth image's rows are taken to be read as the colour
                image's are.
            delay_s: Seconds by which the depth images are exposed later than their stamps say.
        """
        # inverse depths ``[L, n]`` under this delay
        points = self._in_camera(self._at(self.late * readout_s))
        self.inverse_depth = self._depth_at(points, readout_s, delay_s)

        # how they change with the delay, by central differences
        earlier = self._depth_at(points, readout_s, delay_s - _DIFFERENCE_S)
        later = self._depth_at(points, readout_s, delay_s + _DIFFERENCE_S)
        drift = (later - earlier) / (2 * _DIFFERENCE_S)
        self.inverse_depth[~np.isfinite(drift)] = np.nan
        self.depth_drift = np.nan_to_num(drift)

    def _depth_at(self, points: Array, readout_s: float, delay_s: float) -> Array:
        """Inverse depth ``[L, n]`` at the pixels' time of images exposed `delay_s` after their stamps.

        Args:
            points: ``[L, n, 3]`` in the camera when the pixels were exposed, metres.
            readout_s: Readout time.
            delay_s: The delay.
        """
        # the points in the camera when the depth was exposed
        poses = self._at(self.late * readout_s + self.offsets + delay_s)
        delayed = self._in_camera(poses)
        inverse = 1 / np.maximum(points[..., 2:], _NEAREST_M)
        delayed_inverse = 1 / np.maximum(delayed[..., 2:], _NEAREST_M)

        # read the depth where the point was then, and carry it to the pixels' time
        moved = delayed[..., :2] * delayed_inverse - points[..., :2] * inverse
        shift = moved * (self.camera.fx, self.camera.fy)
        is_known = poses.within[..., None] & np.isfinite(self.xy)
        place = np.where(is_known, self.raw + shift, np.nan)
        observed = [inverse_depth(image, place[:, i]) for i, image in enumerate(self.depth)]
        return np.asarray(np.stack(observed, axis=1) - (delayed_inverse - inverse)[..., 0])

    def depth_cost(self, delay_s: float) -> tuple[float, int]:
        """Robust cost of the depth images under a delay without a rolling shutter, and how many depths it sums."""
        points = self._in_camera(self._at(np.zeros_like(self.late)))
        predicted = 1 / np.maximum(points[..., 2], _NEAREST_M)
        error = (predicted - self._depth_at(points, 0.0, delay_s)) / self.noise[1]
        valid = np.isfinite(error)
        return float(np.log1p((error[valid] / CAUCHY) ** 2).sum()), int(valid.sum())

    def normal_equations(self, readout_s: float) -> ReducedEquations:
        """Gauss-Newton's normal equations about the state, the points eliminated."""
        L = len(self.xy)
        n = len(self.stamps)
        poses = self._at(self.late * readout_s)
        points = self._in_camera(poses)
        residuals = self._residuals(points)
        weight = self._weights(residuals)

        # Weighted Jacobians ``[L, n, 3, ...]``: by the point in the camera and in the world, then by
        # the interpolated pose (rotation, centre).
        by_point = self._projection_jacobian(points) * weight[..., None]
        by_world = by_point @ poses.R
        by_pose = np.concatenate([-by_point @ se3.hat(points), -by_world], axis=-1)

        # By the poses of the frames that it is interpolated from; the middle one is the world's.
        share = np.zeros((L, n, n))
        np.put_along_axis(share, poses.nodes, poses.weights, axis=2)
        by_poses = np.delete(share, n // 2, axis=2)[:, :, None, :, None] * by_pose[:, :, :, None, :]

        # By the readout time, with which the camera moves on, and by the delay of the depth.
        turning = np.cross(poses.angular_velocity, points)
        moving = turning - (poses.R @ poses.velocity[..., None])[..., 0]
        by_shared = np.zeros((L, n, 3, 2))
        by_shared[..., 0] = (by_point @ moving[..., None])[..., 0] * self.late[..., None]
        by_shared[..., 2, 1] = -self.depth_drift * weight[..., 2]

        jacobian = np.concatenate([by_poses.reshape(L, n, 3, -1), by_shared], axis=-1)
        return ReducedEquations(
            jacobian.reshape(L, 3 * n, -1),
            by_world.reshape(L, 3 * n, 3),
            (np.nan_to_num(residuals) * weight).reshape(L, 3 * n),
        )

    def _weights(self, residuals: Array) -> Array:
        """Square roots of the robust (Cauchy) weights ``[L, n, 3]`` of residuals; 0 where nothing was observed."""
        pixels, depth = self.noise
        error = np.hypot(residuals[..., 0], residuals[..., 1]) / pixels
        by_pixels = 1 / (pixels * np.sqrt(1 + (error / CAUCHY) ** 2))
        by_depth = 1 / (depth * np.sqrt(1 + (residuals[..., 2] / depth / CAUCHY) ** 2))
        return np.nan_to_num(np.stack([by_pixels, by_pixels, by_depth], axis=-1))

    def _projection_jacobian(self, points: Array) -> Array:
        """Slopes ``[L, n, 3, 3]`` of pixels and inverse depth by points in the camera ``[L, n, 3]``."""
        camera = self.camera
        x = points[..., 0]
        y = points[..., 1]
        z = np.maximum(points[..., 2], _NEAREST_M)
        slopes = np.zeros((*points.shape, 3))
        slopes[..., 0, 0] = camera.fx / z
        slopes[..., 0, 2] = -camera.fx * x / z**2
        slopes[..., 1, 1] = camera.fy / z
        slopes[..., 1, 2] = -camera.fy * y / z**2
        slopes[..., 2, 2] = -1 / z**2
        return slopes

    def update(self, poses: Array, points: Array) -> None:
        """Move the state.

        Args:
            poses: ``[n - 1, 6]`` rotation vector (from the left) and centre of all poses but the
                middle one.
            points: ``[L, 3]``, to be added.
        """
        others = np.delete(np.arange(len(self.stamps)), len(self.stamps) // 2)
        self.R = self.R.copy()
        self.centre = self.centre.copy()
        self.R[others] = _matrices(poses[:, :3]) @ self.R[others]
        self.centre[others] += poses[:, 3:]
        self.points = self.points + points


@dataclass(frozen=True, eq=False)
class _InterpolatedPoses:
    """The camera at times between frames, ``[L, n, ...]``.

    Attributes:
        R: Rotations from the world to the camera.
        centre: The camera's places in the world, metres.
        angular_velocity: Rotation vectors a second, rad/s in the camera.
        velocity: Velocities of the centre, m/s in the world.
        weights: Weights of the `nodes`.
        nodes: Indices of the frames that the pose is interpolated from.
        within: Whether the time is at most half a frame outside of the window.
    """

    R: Array
    centre: Array
    angular_velocity: Array
    velocity: Array
    weights: Array
    nodes: NDArray[np.intp]
    within: NDArray[np.bool_]


class ReducedEquations:
    """Normal equations of a window by its poses, readout time and delay; its points are eliminated (Schur complement).

    Args:
        J: Jacobian ``[L, k, m + 2]`` by the poses, readout time and delay, weighted.
        by_point: Jacobian ``[L, k, 3]`` by the points, weighted.
        r: Residuals ``[L, k]``, weighted.

    Attributes:
        information: Information ``[2, 2]`` of readout time and delay, the poses eliminated.
        slope: Slope ``[2]`` of the cost by readout time and delay, the poses eliminated.
    """

    def __init__(self, J: Array, by_point: Array, r: Array) -> None:
        # Eliminate the points, each with a block of its own.
        transposed = np.swapaxes(by_point, 1, 2)
        own = transposed @ by_point
        own += (1e-6 * np.trace(own, axis1=1, axis2=2)[:, None, None] + 1e-9) * np.eye(3)
        self._inverse = np.linalg.inv(own)
        self._mixed = transposed @ J
        self._gradient = (transposed @ r[..., None])[..., 0]
        columns = J.shape[-1]
        flat = J.reshape(-1, columns)
        carried = (self._inverse @ self._mixed).reshape(-1, columns)
        H = flat.T @ flat - self._mixed.reshape(-1, columns).T @ carried
        b = flat.T @ r.ravel() - carried.T @ self._gradient.ravel()

        # Eliminate the poses: their response to readout time and delay, and to the residuals.
        m = columns - 2
        damped = H[:m, :m] + 1e-9 * np.trace(H[:m, :m]) / m * np.eye(m)
        self._response = np.linalg.solve(damped, np.column_stack([H[:m, m:], b[:m]]))
        self.information = H[m:, m:] - H[m:, :m] @ self._response[:, :2]
        self.slope = b[m:] - H[m:, :m] @ self._response[:, 2]

    def steps(self, shared: Array) -> tuple[Array, Array]:
        """Steps of the poses ``[n - 1, 6]`` and the points ``[L, 3]`` that go with steps ``[2]`` of what is shared."""
        poses = -self._response[:, 2] - self._response[:, :2] @ shared
        change = self._gradient + self._mixed @ np.concatenate([poses, shared])
        return poses.reshape(-1, 6), -(self._inverse @ change[..., None])[..., 0]


def _matrices(vectors: Array) -> Array:
    """Rotation matrices ``[..., 3, 3]`` of rotation vectors ``[..., 3]``."""
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)


def _rotation_vectors(R: Array) -> Array:
    """Rotation vectors ``[..., 3]`` of rotation matrices ``[..., 3, 3]``."""
    return Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(R.shape[:-1])


def _lagrange(nodes: Array, at: Array) -> tuple[Array, Array]:
    """Weights ``[..., k]`` of the nodes ``[..., k]`` of the interpolating polynomial at ``[...]``, and their slopes."""
    weights = np.ones_like(nodes)
    slopes = np.zeros_like(nodes)
    for j, m in permutations(range(nodes.shape[-1]), 2):
        span = nodes[..., j] - nodes[..., m]
        slopes[..., j] = (slopes[..., j] * (at - nodes[..., m]) + weights[..., j]) / span
        weights[..., j] *= (at - nodes[..., m]) / span
    return weights, slopes
