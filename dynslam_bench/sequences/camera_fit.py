"""Focal length, principal point, depth scale, axes and lever arm at which a truth fits the images best."""

from __future__ import annotations

from collections.abc import Sequence as PySequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera

from .rgbd_motion import RgbdPair

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Fit:
    """Camera and mounting that make the truth's motion carry the corners from image to image.

    Attributes:
        value: ``focal`` and ``scale`` (of the depth) as natural logarithms of the factor, ``cx`` and ``cy`` as pixels
            to be added, ``turn`` the rotation vector ``[3]`` in rad and ``lever`` the position ``[3]`` in metres of the
            camera in the frame of the body that the truth tracks.
        sigma: Their standard deviations, each pair of frames being one observation.
        residual_px: Median reprojection error.
        cost: Mean robust cost of a corner.
    """

    value: dict[str, Array]
    sigma: dict[str, Array]
    residual_px: float
    cost: float

    def size(self, name: str) -> float:
        """Length of a value."""
        return float(np.linalg.norm(self.value[name]))

    def certainty(self, name: str) -> float:
        """Length of a value in standard deviations of it."""
        return self.size(name) / max(float(np.linalg.norm(self.sigma[name])), 1e-12)


_PARAMETERS = {"focal": slice(0, 1), "cx": slice(1, 2), "cy": slice(2, 3), "scale": slice(3, 4),
               "turn": slice(4, 7), "lever": slice(7, 10)}  # fmt: skip
_PRIOR = np.array([1.0, 200.0, 200.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
_SCALES = np.array([0.1, 10, 10, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1])
_STEPS = np.array([1e-4, 0.05, 0.05, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4])
_CORNERS_A_PAIR = 25
_OUTLIER_PX = 2.0


@dataclass(frozen=True, eq=False)
class _Corners:
    """Corners of all pairs, the pair of each, and the truth's motions back to the second frames."""

    camera: Camera
    pair: NDArray[np.intp]
    first: Array
    depth: Array
    second: Array
    back: Array

    def errors(self, x: Array) -> Array:
        """Reprojection errors ``[N, 2]`` in pixels under the values ``[10]``."""
        focal = np.exp(x[0]) * np.array([self.camera.fx, self.camera.fy])
        centre = np.array([self.camera.cx, self.camera.cy]) + x[1:3]
        rays = np.concatenate([(self.first - centre) / focal, np.ones((len(self.first), 1))], axis=1)
        mount = se3.exp(np.concatenate([np.zeros(3), x[4:7]]))
        mount[:3, 3] = x[7:10]
        moves = se3.inverse(mount) @ self.back @ mount
        points = np.exp(x[3]) * self.depth[:, None] * rays
        moved = np.einsum("nij,nj->ni", moves[self.pair, :3, :3], points) + moves[self.pair, :3, 3]
        return np.asarray(moved[:, :2] / np.maximum(moved[:, 2:], 0.05) * focal + centre - self.second)

    def deviations(self, x: Array, index: NDArray[np.intp], pairs: int) -> Array:
        """Standard deviations of the fitted values, each pair being one observation (a sandwich estimate)."""
        left = self.errors(x)
        weight = 1 / np.sqrt(1 + ((left / _OUTLIER_PX) ** 2).sum(axis=1))
        slopes = np.stack([(self.errors(x + s) - self.errors(x - s)) / (2 * s.sum()) for s in np.diag(_STEPS)], axis=-1)
        prior = np.diag(1 / _PRIOR**2) * _OUTLIER_PX**2
        curvature = np.einsum("npi,n,npj->ij", slopes, weight, slopes) + prior
        pulls = np.zeros((pairs, len(x)))
        np.add.at(pulls, self.pair, np.einsum("npi,n,np->ni", slopes, weight, left))
        chosen = np.ix_(index, index)
        inverse = np.linalg.inv(curvature[chosen])
        spread = inverse @ (pulls.T @ pulls + prior)[chosen] @ inverse
        return np.asarray(np.sqrt(np.maximum(np.diag(spread), 0)) * np.sqrt(pairs / max(pairs - len(index), 1)))


def fit_camera(pairs: PySequence[RgbdPair], relative: Array, camera: Camera, free: PySequence[str]) -> Fit:
    """Focal length, principal point, depth scale, axes and lever arm at which the truth fits the images best.

    Robust least squares of the reprojection errors of the corners of all pairs, with the truth's relative motions held.
    A weak prior keeps what the motion does not tell near what is stated.

    Args:
        pairs: Pairs of frames with a motion.
        relative: Motions of the truth between them ``[N, 4, 4]``, in the depth's units.
        camera: The stated camera.
        free: Names of what is fitted, of `Fit.value`; the rest stays as stated.
    """
    from scipy.optimize import least_squares

    chosen = [np.flatnonzero(pair.inliers) for pair in pairs]
    chosen = [index[:: max(1, len(index) // _CORNERS_A_PAIR)][:_CORNERS_A_PAIR] for index in chosen]
    first, depth, second = (
        np.concatenate([getattr(pair, name)[index] for pair, index in zip(pairs, chosen, strict=True)])
        for name in ("pixels_first", "depth_first", "pixels_second")
    )
    number = np.repeat(np.arange(len(pairs)), [len(index) for index in chosen])
    corners = _Corners(camera, number, first, depth, second, se3.inverse(relative))
    index = np.array([i for name in free for i in range(10)[_PARAMETERS[name]]], np.intp)

    def filled(part: Array) -> Array:
        x = np.zeros(10)
        x[index] = part
        return x

    def robust(part: Array) -> Array:
        raw = corners.errors(filled(part)) / _OUTLIER_PX
        square = (raw**2).sum(axis=1, keepdims=True)
        shrunk = raw * np.sqrt(2 * (np.sqrt(1 + square) - 1) / np.maximum(square, 1e-12))
        return np.concatenate([shrunk.ravel(), filled(part) / _PRIOR])

    part = np.zeros(len(index))
    if len(index):
        part = np.asarray(least_squares(robust, part, x_scale=_SCALES[index]).x, np.float64)
    x, deviation = filled(part), filled(corners.deviations(filled(part), index, len(pairs)))
    return Fit(
        {name: x[where] for name, where in _PARAMETERS.items()},
        {name: deviation[where] for name, where in _PARAMETERS.items()},
        float(np.median(np.linalg.norm(corners.errors(x), axis=1))),
        float((robust(part) ** 2).sum() / len(first)),
    )
