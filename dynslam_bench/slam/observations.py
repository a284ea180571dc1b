"""The features of one frame as tracking and mapping use them: undistorted, with depth, weights and a search grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import FrameBundle, Keypoints
from dynslam_bench.features.matching import CellGrid, Words, as_words
from dynslam_bench.geometry import Camera
from dynslam_bench.slam.pose_optimisation import Measurements

Array = NDArray[np.float64]

MAX_DEPTH_M = 40.0
"""Depth beyond this is treated as missing."""
RIGHT_SIGMA_PX = 1.5
"""Standard deviation of the right coordinate at octave 0, beside the depth sensor's noise."""
DEPTH_NOISE = 0.0025
"""Standard deviation of the depth over its square, 1/m (structured-light sensors)."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Features of one frame that no filter removed, one row each, ready for matching.

    Attributes:
        keypoints: Raw keypoints (distorted pixels).
        xy: float64 ``[N, 2]`` undistorted pixels.
        z: float64 ``[N]`` depth in metres, 0 missing.
        right: float64 ``[N]`` right coordinate ``u - fx * baseline / z``, NaN without depth.
        octave: int64 ``[N]``.
        angle: float64 ``[N]`` degrees.
        descriptors: uint64 ``[N, W]``, bits in words of 64.
        info: float64 ``[N]`` inverse variance of the pixel coordinates, 1/px^2, times the filters'
            weight.
        info_right: float64 ``[N]`` inverse variance of the right coordinate, times the weight; 0
            without depth.
        grid: Cells of the features.
        rgb: uint8 ``[N, 3]`` colour at the feature.
        mask: bool ``[H, W]``, dynamic pixels, behind which no map point is visible; None without
            masks.
    """

    keypoints: Keypoints
    xy: Array
    z: Array
    right: Array
    octave: NDArray[np.int64]
    angle: Array
    descriptors: Words
    info: Array
    info_right: Array
    grid: CellGrid
    rgb: NDArray[np.uint8]
    mask: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.xy)

    def measurements(self, features: NDArray[np.integer]) -> Measurements:
        """Measured places of some of the features ``[M]``, for the optimisation of poses."""
        return Measurements(
            self.xy[features],
            self.right[features],
            self.info[features],
            self.info_right[features],
        )


def observe(
    frame: FrameBundle,
    keep: NDArray[np.bool_],
    weight: NDArray[np.float32],
    camera: Camera,
    scales: Array,
) -> Observations:
    """Select and prepare the features of a frame.

    The right coordinate ``u - b f / z`` carries the depth (ORB-SLAM2, Eq. for RGB-D). Its variance
    is the pixel's plus that of the depth sensor, ``(b f / z^2 * c z^2)^2 = (b f c)^2``, constant in
    disparity.

    Args:
        frame: The frame with its keypoints.
        keep: bool ``[N]``, False rows are left out entirely.
        weight: float32 ``[N]`` in [0, 1], scales the information of a feature.
        camera: Intrinsics.
        scales: Pixels of the image in a pixel of each octave.
    """
    # features that the filters kept, with a finite pixel
    weight = np.clip(np.nan_to_num(np.asarray(weight, np.float64), nan=0.0), 0.0, 1.0)
    index = np.flatnonzero(
        np.asarray(keep, bool) & np.isfinite(frame.xy).all(axis=1) & (weight > 0)
    )

    # their pixels and depths, 0 beyond `MAX_DEPTH_M`
    xy = np.ascontiguousarray(frame.xy[index], dtype=np.float64)
    z = frame.z[index].astype(np.float64)
    z = np.where((z > 0) & (z < MAX_DEPTH_M), z, 0.0)

    # variances of pixel and right coordinate grow with the octave's scale
    keypoints = frame.keypoints.select(index)
    octave = np.clip(keypoints.octave.astype(np.int64), 0, len(scales) - 1)
    variance = scales[octave] ** 2
    noise = RIGHT_SIGMA_PX**2 * variance + (camera.fx * camera.baseline_m * DEPTH_NOISE) ** 2

    # where their colour is read
    height, width = frame.rgb.shape[:2]
    column, row = np.rint(keypoints.xy).astype(np.int64).T
    return Observations(
        keypoints,
        xy,
        z,
        right_coordinates(xy, z, camera),
        octave,
        keypoints.angle.astype(np.float64),
        as_words(keypoints.descriptors),
        weight[index] / variance,
        np.where(z > 0, weight[index] / noise, 0.0),
        CellGrid.of(xy, camera.width, camera.height),
        frame.rgb[row.clip(0, height - 1), column.clip(0, width - 1)],
        frame.mask,
    )


def right_coordinates(xy: Array, z: Array, camera: Camera) -> Array:
    """Right coordinates ``[N]`` of pixels ``[N, 2]`` with depths ``[N]`` in metres; NaN where the depth is 0."""
    has_depth = z > 0
    return np.where(
        has_depth, xy[:, 0] - camera.fx * camera.baseline_m / np.where(has_depth, z, 1.0), np.nan
    )
