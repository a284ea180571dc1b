"""Bundle adjustment of a window of frames whose camera moves continuously: every row and depth image has its own time.

Corners are tracked through the window. Kerl, Stueckler and Cremers, "Dense continuous-time tracking and mapping with
rolling shutter RGB-D cameras", ICCV 2015.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.se3 import hat
from dynslam_bench.sequences.rgbd_motion import follow_corners

Array = NDArray[np.float64]

POINTS = 110
"""So many corners are followed at a time."""


def track(images: list[NDArray[np.uint8]], allowed: list[NDArray[np.uint8]]) -> Array:
    """Corners followed from image to image by Lucas and Kanade, pixels ``[L, n, 2]``; NaN where they are not seen.

    A corner that is tracked back more than half a pixel off is lost. New ones are detected where few are left and
    `allowed` is not 0.
    """
    n, (height, width) = len(images), images[0].shape
    tracks = np.full((0, n, 2), np.nan)
    for i in range(n - 1):
        alive = np.isfinite(tracks[:, i, 0])
        if alive.sum() < POINTS and i < n - 3:
            fresh = corners(images[i], allowed[i], tracks[alive, i], POINTS - int(alive.sum()))
            new = np.full((len(fresh), n, 2), np.nan)
            new[:, i] = fresh
            tracks = np.concatenate([tracks, new])
            alive = np.isfinite(tracks[:, i, 0])
        here = tracks[alive, i].astype(np.float32)
        if not len(here):
            continue
        flow = here - tracks[alive, i - 1] if i else np.full(here.shape, np.nan)
        valid = np.isfinite(flow[:, 0])
        flow[~valid] = np.median(flow[valid], axis=0) if valid.any() else 0.0
        there, good = follow_corners(images[i], images[i + 1], here, (here + flow).astype(np.float32), 0.5)
        good &= (there >= 8).all(axis=1) & (there < (width - 8, height - 8)).all(axis=1)
        tracks[np.flatnonzero(alive)[good], i + 1] = there[good]
    return np.asarray(tracks[np.isfinite(tracks[..., 0]).sum(axis=1) >= 4])


def corners(image: NDArray[np.uint8], allowed: NDArray[np.uint8], taken: Array, count: int) -> NDArray[np.float32]:
    """Corners ``[N, 2]`` spread over the cells of a grid, away from those that there are."""
    height, width = image.shape
    free = allowed.copy()
    for x, y in taken:
        cv2.circle(free, (int(x), int(y)), 12, 0, -1)
    rows, columns = 4, 5
    per_cell = int(np.ceil(1.5 * count / (rows * columns)))
    pixels = [np.zeros((0, 2), np.float32)]
    for r in range(rows):
        for c in range(columns):
            ys = slice(r * height // rows, (r + 1) * height // rows)
            xs = slice(c * width // columns, (c + 1) * width // columns)
            in_cell = cv2.goodFeaturesToTrack(image[ys, xs], per_cell, 0.02, 12, mask=free[ys, xs])
            if in_cell is not None:
                pixels.append(np.asarray(in_cell.reshape(-1, 2) + np.array([xs.start, ys.start]), np.float32))
    return np.concatenate(pixels)


def inverse_depth(depth: NDArray[np.float32], pixels: Array) -> Array:
    """Mean inverse depth ``[N]`` of the 5x5 pixels around `pixels` ``[N, 2]``; NaN at edges, holes and outside."""
    height, width = depth.shape
    place: Array = np.asarray(np.round(pixels))
    ahead, before = (place >= 2).all(axis=1), (place < (width - 2, height - 2)).all(axis=1)
    inside = np.asarray(np.isfinite(place).all(axis=1) & ahead & before)
    u, v = np.where(inside[:, None], place, 2).astype(np.intp).T
    around = np.arange(-2, 3)
    patch = depth[v[:, None, None] + around[:, None], u[:, None, None] + around].reshape(len(u), 25).astype(np.float64)
    measured = patch > 0
    inverse = 1 / np.where(measured, patch, 1.0)
    count = measured.sum(axis=1)
    mean = (inverse * measured).sum(axis=1) / np.maximum(count, 1)
    spread = np.where(measured, inverse, -np.inf).max(axis=1) - np.where(measured, inverse, np.inf).min(axis=1)
    return np.where(inside & (count >= 20) & (spread < 0.12 * mean), mean, np.nan)


LEAST_POINTS = 15
LARGEST_NOISE_PX = 3.0
"""Before the rolling shutter is taken into account, which costs up to a pixel."""
STENCIL = 5
"""Poses that a pose between frames is interpolated from (a quartic in time)."""
CAUCHY = 2.5
"""Scale of the robust kernel in standard deviations."""
_DIFFERENCE_S = 0.004


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
        offsets: ``[n]`` seconds by which the depth images' stamps are later than the colour images'.

    Raises:
        Unusable: Too few points have depth, or do not move as one rigid body.
    """

    def __init__(
        self, camera: Camera, stamps: Array, pixels: Array, depth: NDArray[np.float32], offsets: Array
    ) -> None:
        self.camera, self.depth, self.offsets = camera, depth, offsets
        self.start, self.stamps = float(stamps[0]), stamps - stamps[len(stamps) // 2]
        self.raw = pixels
        self.xy = camera.undistort_points(pixels).reshape(pixels.shape)
        self.inverse_depth = np.stack([inverse_depth(image, pixels[:, i]) for i, image in enumerate(depth)], axis=1)
        self.depth_drift = np.zeros(pixels.shape[:2])
        self.R, self.centre = self._chain()
        with np.errstate(divide="ignore", invalid="ignore"):
            points = camera.unproject(self.xy, 1 / self.inverse_depth)
        world = np.einsum("nji,lnj->lni", self.R, points) + self.centre
        deep = np.isfinite(world[..., 0])
        keep = (np.isfinite(self.xy[..., 0]).sum(1) >= 4) & (deep.sum(1) >= 2)
        if keep.sum() < LEAST_POINTS:
            raise Unusable("too few points with depth can be followed")
        self.raw, self.xy, self.inverse_depth = self.raw[keep], self.xy[keep], self.inverse_depth[keep]
        self.depth_drift = self.depth_drift[keep]
        self.points = np.nanmedian(world[keep], axis=1)
        self.late = np.nan_to_num((self.raw[..., 1] + 0.5) / camera.height - 0.5)
        self.noise = 1.0, 0.01
        self.measure_noise(0.0)
        for _ in range(4):
            equations = self.normal_equations(0.0)
            self.update(*equations.steps(np.zeros(2), equations.shared()[2]))
        self.measure_noise(0.0)
        if not self.noise[0] < LARGEST_NOISE_PX:
            raise Unusable(f"the points fit one rigid scene to {self.noise[0]:.1f} px only")

    def _chain(self) -> tuple[Array, Array]:
        """Rotations world to camera ``[n, 3, 3]`` and centres ``[n, 3]``, frame by frame by PnP; drops what moves."""
        T = [np.eye(4)]
        matrix = self.camera.matrix
        for i in range(len(self.stamps) - 1):
            usable = np.isfinite(self.inverse_depth[:, i]) & np.isfinite(self.xy[:, i + 1, 0])
            if usable.sum() < LEAST_POINTS:
                raise Unusable("too few points with depth can be followed")
            points = self.camera.unproject(self.xy[usable, i], 1 / self.inverse_depth[usable, i])
            pixels = self.xy[usable, i + 1]
            success, turn, shift, inliers = cv2.solvePnPRansac(
                points, pixels, matrix, None, iterationsCount=200, reprojectionError=3.0, flags=cv2.SOLVEPNP_EPNP
            )
            if not success or inliers is None or len(inliers) < max(LEAST_POINTS // 2, 0.4 * len(points)):
                raise Unusable("the points do not move as one rigid scene")
            chosen = inliers[:, 0]
            turn, shift = cv2.solvePnPRefineLM(points[chosen], pixels[chosen], matrix, None, turn, shift)
            step = np.eye(4)
            step[:3, :3], step[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
            error = np.linalg.norm(self.camera.project(points @ step[:3, :3].T + step[:3, 3]) - pixels, axis=1)
            moving = np.flatnonzero(usable)[~(error < 6.0)]
            self.xy[moving, i + 1 :] = self.inverse_depth[moving, i + 1 :] = np.nan
            T.append(step @ T[-1])
        poses = np.array(T) @ np.linalg.inv(T[len(T) // 2])
        return poses[:, :3, :3], -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])

    def _at(self, offset: Array) -> _Moment:
        """The camera at times `offset` ``[L, n]`` seconds after the frames' stamps."""
        n = len(self.stamps)
        times = self.stamps + offset
        nearest = np.searchsorted((self.stamps[1:] + self.stamps[:-1]) / 2, times)
        nodes = np.clip(np.arange(n) - STENCIL // 2, 0, n - STENCIL)[:, None] + np.arange(STENCIL)
        spread = self.stamps[nodes] - self.stamps[:, None]
        turns = _rotvec(self.R[nodes] @ np.swapaxes(self.R, 1, 2)[:, None])
        weights, slopes = _lagrange(spread[nearest], times - self.stamps[nearest])
        turn, centres = turns[nearest], self.centre[nodes][nearest]
        R = _matrix((weights[..., None, :] @ turn)[..., 0, :]) @ self.R[nearest]
        return _Moment(
            R=R,
            centre=(weights[..., None, :] @ centres)[..., 0, :],
            turning=(slopes[..., None, :] @ turn)[..., 0, :],
            velocity=(slopes[..., None, :] @ centres)[..., 0, :],
            weights=weights,
            nodes=nodes[nearest],
            within=(times > 1.5 * self.stamps[0] - 0.5 * self.stamps[1])
            & (times < 1.5 * self.stamps[-1] - 0.5 * self.stamps[-2]),
        )

    def _in_camera(self, moment: _Moment) -> Array:
        """The points ``[L, n, 3]`` in the camera at a moment."""
        return np.asarray((moment.R @ (self.points[:, None] - moment.centre)[..., None])[..., 0])

    def _residuals(self, points: Array) -> Array:
        """Pixels and inverse depth ``[L, n, 3]``: predicted less observed."""
        inverse = 1 / np.maximum(points[..., 2:], 1e-3)
        pixels = points[..., :2] * inverse * (self.camera.fx, self.camera.fy) + (self.camera.cx, self.camera.cy)
        return np.concatenate([pixels - self.xy, inverse - self.inverse_depth[..., None]], axis=-1)

    def measure_noise(self, readout_s: float) -> None:
        """Take the noise of pixels and of inverse depth from the median residuals."""
        residuals = self._residuals(self._in_camera(self._at(self.late * readout_s)))
        error, depth = np.hypot(residuals[..., 0], residuals[..., 1]), np.abs(residuals[..., 2])
        valid, deep = np.isfinite(error), np.isfinite(depth)
        if valid.any() and deep.any():
            self.noise = max(np.median(error[valid]) / 1.177, 0.05), max(1.4826 * np.median(depth[deep]), 1e-6)

    def turning_change(self) -> float:
        """Root mean square change of the turning rate within the window, rad/s."""
        rates = _rotvec(self.R[1:] @ np.swapaxes(self.R[:-1], 1, 2)) / np.diff(self.stamps)[:, None]
        return float(np.sqrt(((rates - rates.mean(0)) ** 2).sum(1).mean()))

    def move_depth(self, readout_s: float, delay_s: float) -> None:
        """Carry each depth from its image's time to its pixel's, with the motion as estimated so far.

        Args:
            readout_s: Readout time; the depth image's rows are taken to be read as the colour image's are.
            delay_s: By which the depth images are exposed later than their stamps say.
        """
        now = self._in_camera(self._at(self.late * readout_s))
        self.inverse_depth, before, after = (
            self._depth_at(now, readout_s, delay_s + step) for step in (0.0, -_DIFFERENCE_S, _DIFFERENCE_S)
        )
        drift = (after - before) / (2 * _DIFFERENCE_S)
        self.inverse_depth[~np.isfinite(drift)] = np.nan
        self.depth_drift = np.nan_to_num(drift)

    def _depth_at(self, now: Array, readout_s: float, delay_s: float) -> Array:
        """Inverse depth ``[L, n]`` at the pixels' time of images exposed `delay_s` after their stamps."""
        moment = self._at(self.late * readout_s + self.offsets + delay_s)
        then = self._in_camera(moment)
        inverse_now, inverse_then = 1 / np.maximum(now[..., 2:], 1e-3), 1 / np.maximum(then[..., 2:], 1e-3)
        shift = (then[..., :2] * inverse_then - now[..., :2] * inverse_now) * (self.camera.fx, self.camera.fy)
        place = np.where(moment.within[..., None] & np.isfinite(self.xy), self.raw + shift, np.nan)
        observed = np.stack([inverse_depth(image, place[:, i]) for i, image in enumerate(self.depth)], axis=1)
        return np.asarray(observed - (inverse_then - inverse_now)[..., 0])

    def depth_cost(self, readout_s: float, delay_s: float) -> tuple[float, int]:
        """Robust cost of the depth images under a delay, and how many depths it sums."""
        now = self._in_camera(self._at(self.late * readout_s))
        error = (1 / np.maximum(now[..., 2], 1e-3) - self._depth_at(now, readout_s, delay_s)) / self.noise[1]
        valid = np.isfinite(error)
        return float(np.log1p((error[valid] / CAUCHY) ** 2).sum()), int(valid.sum())

    def normal_equations(self, readout_s: float) -> _Reduced:
        """Gauss-Newton's normal equations about the state, the points eliminated."""
        L, n = len(self.xy), len(self.stamps)
        moment = self._at(self.late * readout_s)
        points = self._in_camera(moment)
        residuals = self._residuals(points)
        pixels, depth = self.noise
        error = np.hypot(residuals[..., 0], residuals[..., 1]) / pixels
        weight = np.empty((L, n, 3))
        weight[..., :2] = (1 / (pixels * np.sqrt(1 + (error / CAUCHY) ** 2)))[..., None]
        weight[..., 2] = 1 / (depth * np.sqrt(1 + (residuals[..., 2] / depth / CAUCHY) ** 2))
        weight = np.nan_to_num(weight)
        x, y, z = np.moveaxis(points, -1, 0)
        z = np.maximum(z, 1e-3)
        by_point = np.zeros((L, n, 3, 3))
        by_point[..., 0, 0], by_point[..., 0, 2] = self.camera.fx / z, -self.camera.fx * x / z**2
        by_point[..., 1, 1], by_point[..., 1, 2] = self.camera.fy / z, -self.camera.fy * y / z**2
        by_point[..., 2, 2] = -1 / z**2
        by_point *= weight[..., None]
        by_world = by_point @ moment.R
        by_pose = np.concatenate([-by_point @ hat(points), -by_world], axis=-1)  # rotation, centre
        moving = np.cross(moment.turning, points) - (moment.R @ moment.velocity[..., None])[..., 0]
        poses = np.zeros((L, n, 3, n, 6))
        for i in range(n):  # a pixel's nearest pose is its own frame's: readout times are below the frame interval
            for k in range(STENCIL):
                own = moment.nodes[:, i, k]
                poses[np.arange(L), i, :, own] += moment.weights[:, i, k, None, None] * by_pose[:, i]
        jacobian = np.zeros((L, n, 3, 6 * (n - 1) + 2))
        middle = n // 2
        jacobian[..., : 6 * middle] = poses[..., :middle, :].reshape(L, n, 3, -1)
        jacobian[..., 6 * middle : -2] = poses[..., middle + 1 :, :].reshape(L, n, 3, -1)
        jacobian[..., -2] = (by_point @ moving[..., None])[..., 0] * self.late[..., None]
        jacobian[..., 2, -1] = -self.depth_drift * weight[..., 2]
        return _Reduced.of(
            jacobian.reshape(L, 3 * n, -1),
            by_world.reshape(L, 3 * n, 3),
            (np.nan_to_num(residuals) * weight).reshape(L, 3 * n),
        )

    def update(self, poses: Array, points: Array) -> None:
        """Move the state.

        Args:
            poses: ``[n - 1, 6]`` rotation vector (from the left) and centre of all poses but the middle one.
            points: ``[L, 3]``.
        """
        others = np.delete(np.arange(len(self.stamps)), len(self.stamps) // 2)
        self.R, self.centre = self.R.copy(), self.centre.copy()
        self.R[others] = _matrix(poses[:, :3]) @ self.R[others]
        self.centre[others] += poses[:, 3:]
        self.points = self.points + points


@dataclass(frozen=True, eq=False)
class _Moment:
    """The camera at times between frames, ``[L, n, ...]``.

    Attributes:
        R: World to camera.
        centre: In the world.
        turning: Rotation a second, in the camera.
        velocity: Of the centre, in the world.
        weights: Of the `nodes`, the frames that the pose is interpolated from.
        nodes: See `weights`.
        within: Whether the time is at most half a frame outside of the window.
    """

    R: Array
    centre: Array
    turning: Array
    velocity: Array
    weights: Array
    nodes: NDArray[np.intp]
    within: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class _Reduced:
    """Normal equations of a window without its points: those of its poses, then readout time and delay.

    Attributes:
        H: ``[m + 2, m + 2]``.
        b: ``[m + 2]``.
        inverse: ``[L, 3, 3]`` of the points' own blocks.
        mixed: ``[L, 3, m + 2]``.
        slope: ``[L, 3]``.
    """

    H: Array
    b: Array
    inverse: Array
    mixed: Array
    slope: Array

    @classmethod
    def of(cls, J: Array, by_point: Array, r: Array) -> _Reduced:
        """Of Jacobians ``[L, k, m + 2]`` and ``[L, k, 3]`` and residuals ``[L, k]``, all weighted."""
        turned = np.swapaxes(by_point, 1, 2)
        own = turned @ by_point
        own += (1e-6 * np.trace(own, axis1=1, axis2=2)[:, None, None] + 1e-9) * np.eye(3)
        inverse, mixed, slope = np.linalg.inv(own), turned @ J, (turned @ r[..., None])[..., 0]
        flat, m = J.reshape(-1, J.shape[-1]), J.shape[-1]
        carried = (inverse @ mixed).reshape(-1, m)
        H = flat.T @ flat - mixed.reshape(-1, m).T @ carried
        b = flat.T @ r.ravel() - carried.T @ slope.ravel()
        return cls(H, b, np.asarray(inverse, np.float64), mixed, slope)

    def shared(self) -> tuple[Array, Array, Array]:
        """Information ``[2, 2]`` and slope ``[2]`` of readout and delay, the poses eliminated; the poses' response."""
        m = len(self.b) - 2
        damped = self.H[:m, :m] + 1e-9 * np.trace(self.H[:m, :m]) / m * np.eye(m)
        response = np.linalg.solve(damped, np.column_stack([self.H[:m, m:], self.b[:m]]))
        information = self.H[m:, m:] - self.H[m:, :m] @ response[:, :2]
        return information, self.b[m:] - self.H[m:, :m] @ response[:, 2], response

    def steps(self, shared: Array, response: Array) -> tuple[Array, Array]:
        """Steps of the poses ``[n - 1, 6]`` and the points ``[L, 3]`` that go with steps ``[2]`` of what is shared."""
        poses = -response[:, 2] - response[:, :2] @ shared
        change = self.slope + self.mixed @ np.concatenate([poses, shared])
        return poses.reshape(-1, 6), -(self.inverse @ change[..., None])[..., 0]


def _matrix(turns: Array) -> Array:
    return Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(*turns.shape, 3)


def _rotvec(R: Array) -> Array:
    return Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(R.shape[:-1])


def _lagrange(nodes: Array, at: Array) -> tuple[Array, Array]:
    """Weights ``[..., k]`` of the nodes ``[..., k]`` of the interpolating polynomial at ``[...]``, and their slopes."""
    k = nodes.shape[-1]
    weights, slopes = np.ones_like(nodes), np.zeros_like(nodes)
    for j in range(k):
        for m in range(k):
            if m != j:
                span = nodes[..., j] - nodes[..., m]
                slopes[..., j] = (slopes[..., j] * (at - nodes[..., m]) + weights[..., j]) / span
                weights[..., j] *= (at - nodes[..., m]) / span
    return weights, slopes
