"""Focal length, principal point, depth scale, axes and lever arm at which a ground truth fits the images best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from dynslam_bench.geometry import Array, Camera, se3
from dynslam_bench.sequences.rgbd_motion import RgbdPair


@dataclass(frozen=True)
class Fit:
    """Camera and mounting that make the truth's motion carry the corners from image to image.

    Attributes:
        value: ``focal`` and ``scale`` (of the depth) as natural logarithms of the factor, ``cx``
            and ``cy`` as pixels to be added, ``turn`` the rotation vector ``[3]`` in rad and
            ``lever`` the position ``[3]`` in metres of the camera in the frame of the body that the
            truth tracks.
        sigma: Standard deviations of these values, each pair of frames being one observation.
        residual_px: Median reprojection error.
        cost: Mean robust cost of a corner.
    """

    value: dict[str, Array]
    sigma: dict[str, Array]
    residual_px: float
    cost: float

    def size(self, group: str) -> float:
        """Length of the vector of a group's values."""
        return float(np.linalg.norm([self.value[name] for name in GROUPS[group]]))

    def size_sigma(self, group: str) -> float:
        """Standard deviation of `size`."""
        return float(np.linalg.norm([self.sigma[name] for name in GROUPS[group]]))


GROUPS = {
    "focal": ("focal",),
    "centre": ("cx", "cy"),
    "scale": ("scale",),
    "turn": ("turn",),
    "lever": ("lever",),
}
"""Parameters that are fitted together, each group alone."""

# the ten parameters in one vector, in the units of `Fit.value`, and beside it what is constant for each
_PARAMETERS = {
    "focal": slice(0, 1),
    "cx": slice(1, 2),
    "cy": slice(2, 3),
    "scale": slice(3, 4),
    "turn": slice(4, 7),
    "lever": slice(7, 10),
}
_COUNT = 10
"""Parameters in all."""
_PRIOR = np.array([1.0, 200.0, 200.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
"""Standard deviations of the weak prior about the stated values."""
_SCALES = np.array([0.1, 10, 10, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1])
"""Typical sizes, for the solver."""
_STEPS = np.array([1e-4, 0.05, 0.05, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4])
"""Steps of the numeric derivatives."""
_CORNERS_A_PAIR = 25
"""So many corners of a pair are used at most, spread over all of its inliers."""
_OUTLIER_PX = 2.0
"""Scale of the robust kernel."""


@dataclass(frozen=True, eq=False)
class _Corners:
    """The corners of all pairs, one after the other, and what carries them.

    Attributes:
        camera: The stated camera.
        pair: Number of each corner's pair ``[N]``.
        first: Its pixels in the first frame ``[N, 2]``.
        depth: Its depth there ``[N]``.
        second: Its pixels in the second frame ``[N, 2]``.
        T_second_first: The truth's motions, of all pairs ``[M, 4, 4]``.
    """

    camera: Camera
    pair: NDArray[np.intp]
    first: Array
    depth: Array
    second: Array
    T_second_first: Array

    def reprojection_errors(self, x: Array) -> Array:
        """Reprojection errors ``[N, 2]`` in pixels under the values ``[10]``, in the order of `_PARAMETERS`."""
        # rays of the corners in the first frame, by the fitted intrinsics
        camera = self.camera
        focal = np.exp(x[0]) * np.array([camera.fx, camera.fy])
        centre = np.array([camera.cx, camera.cy]) + x[1:3]
        rays = np.concatenate(
            [(self.first - centre) / focal, np.ones((len(self.first), 1))], axis=1
        )

        # the truth moves the body, on which the camera is mounted: T_cam = T_body_cam^-1 T_body T_body_cam
        T_body_cam = se3.exp(np.concatenate([np.zeros(3), x[4:7]]))
        T_body_cam[:3, 3] = x[7:10]
        motions = (se3.inverse(T_body_cam) @ self.T_second_first @ T_body_cam)[self.pair]

        # points at the scaled depth, moved to the second frame and projected
        points = np.exp(x[3]) * self.depth[:, None] * rays
        moved = np.einsum("nij,nj->ni", motions[:, :3, :3], points) + motions[:, :3, 3]
        z = np.maximum(moved[:, 2:], 0.05)
        return np.asarray(moved[:, :2] / z * focal + centre - self.second)


def fit_camera(
    pairs: list[RgbdPair], relative: Array, camera: Camera, free: tuple[str, ...]
) -> Fit:
    """Focal length, principal point, depth scale, axes and lever arm at which the truth fits the images best.

    Robust least squares of the reprojection errors of the corners of all pairs, with the truth's
    relative motions held. A weak prior keeps values that the motion does not determine near the
    stated ones.

    Args:
        pairs: Pairs of frames with a motion.
        relative: Motions of the truth between them ``[N, 4, 4]``, in the depth's units.
        camera: The stated camera.
        free: Names of what is fitted, of `Fit.value`; the rest stays as stated.
    """
    # the corners, and which of the ten values are fitted
    corners = _gather_corners(pairs, relative, camera)
    index: list[int] = []
    for name in free:
        index += np.arange(_COUNT)[_PARAMETERS[name]].tolist()

    def filled(part: Array) -> Array:
        """All ten values, of which the fitted ones are given."""
        x = np.zeros(_COUNT)
        x[index] = part
        return x

    def residuals(part: Array) -> Array:
        """Robust reprojection errors, then the prior's."""
        errors = corners.reprojection_errors(filled(part))
        return np.concatenate([_robust(errors), filled(part) / _PRIOR])

    # least squares, begun at the stated values
    part = np.zeros(len(index))
    if index:
        solution = least_squares(residuals, part, x_scale=_SCALES[index])
        part = np.asarray(solution.x, np.float64)

    # errors and standard deviations at the solution
    x = filled(part)
    errors = corners.reprojection_errors(x)
    deviation = filled(_deviations(corners, x, errors, index))
    return Fit(
        value={name: x[where] for name, where in _PARAMETERS.items()},
        sigma={name: deviation[where] for name, where in _PARAMETERS.items()},
        residual_px=float(np.median(np.linalg.norm(errors, axis=1))),
        cost=float((residuals(part) ** 2).sum() / len(corners.first)),
    )


def _gather_corners(pairs: list[RgbdPair], relative: Array, camera: Camera) -> _Corners:
    """The corners of all pairs that agree with their pair's motion, `_CORNERS_A_PAIR` of each."""
    chosen = []
    for pair in pairs:
        index = np.flatnonzero(pair.inliers)
        every = max(1, len(index) // _CORNERS_A_PAIR)
        chosen.append(index[::every][:_CORNERS_A_PAIR])
    of_pairs = list(zip(pairs, chosen, strict=True))
    return _Corners(
        camera=camera,
        pair=np.repeat(np.arange(len(pairs)), [len(index) for index in chosen]),
        first=np.concatenate([pair.pixels_first[index] for pair, index in of_pairs]),
        depth=np.concatenate([pair.depth_first[index] for pair, index in of_pairs]),
        second=np.concatenate([pair.pixels_second[index] for pair, index in of_pairs]),
        T_second_first=se3.inverse(relative),
    )


def _robust(errors: Array) -> Array:
    """Errors ``[N, 2]`` in units of `_OUTLIER_PX`, shrunk so that their squares are the pseudo-Huber loss, flat."""
    scaled = errors / _OUTLIER_PX
    square = (scaled**2).sum(axis=1, keepdims=True)
    shrink = np.sqrt(2 * (np.sqrt(1 + square) - 1) / np.maximum(square, 1e-12))
    return np.asarray((scaled * shrink).ravel())


def _deviations(corners: _Corners, x: Array, errors: Array, index: list[int]) -> Array:
    """Standard deviations of the fitted values by a sandwich estimate, each pair of frames being one observation.

    Args:
        corners: The corners.
        x: The solution ``[10]``.
        errors: The reprojection errors there ``[N, 2]``.
        index: Which of the values were fitted.
    """
    pairs = len(corners.T_second_first)
    weight = 1 / np.sqrt(1 + ((errors / _OUTLIER_PX) ** 2).sum(axis=1))
    prior = np.diag(1 / _PRIOR**2) * _OUTLIER_PX**2

    # derivatives of the errors ``[N, 2, 10]`` by central differences.
    differences = []
    for step in np.diag(_STEPS):
        later = corners.reprojection_errors(x + step)
        earlier = corners.reprojection_errors(x - step)
        differences.append((later - earlier) / (2 * step.sum()))
    slopes = np.stack(differences, axis=-1)

    # the sandwich: the inverse information on either side of the scatter of the pairs' gradients.
    fitted = np.ix_(index, index)
    information = np.einsum("npi,n,npj->ij", slopes, weight, slopes) + prior
    inverse = np.linalg.inv(information[fitted])
    gradients = np.zeros((pairs, _COUNT))
    np.add.at(gradients, corners.pair, np.einsum("npi,n,np->ni", slopes, weight, errors))
    scatter = (gradients.T @ gradients + prior)[fitted]
    covariance = inverse @ scatter @ inverse
    small_sample = np.sqrt(pairs / max(pairs - len(index), 1))
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0)) * small_sample)
